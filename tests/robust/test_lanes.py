"""Smallest values of each lane."""

import torch

from torchrg.robust.lanes import smallest_points


def test_subsets_of_tied_distances_have_exactly_h_points(rng):
    distances = torch.randint(0, 4, (50, 300), generator=rng).float()
    for size in (1, 25, 27, 49, 50):
        marked = smallest_points(distances, size)
        assert (marked.sum(dim=0) == size).all()
        kept = torch.where(marked > 0, distances, -1).amax(dim=0)
        left = torch.where(marked > 0, torch.inf, distances).amin(dim=0)
        assert (kept <= left).all()
        if size < 50:
            # Of the points at the limit the first ones are taken.
            indices = torch.arange(50)[:, None]
            tied = distances == kept
            last_in = torch.where(tied & (marked > 0), indices, -1).amax(dim=0)
            first_out = torch.where(tied & (marked == 0), indices, 50).amin(dim=0)
            assert (last_in < first_out).all()
