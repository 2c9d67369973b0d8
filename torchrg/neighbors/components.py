"""Connected components of signed graphs."""

import torch
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import nonzero_rows


def connected_components(
    num_nodes: int, starts: Tensor, ends: Tensor, is_flipped: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the component of each node, in the order of first nodes, and its sign, 1 or -1.

    Links join the nodes ``starts`` and ``ends``, shape ``(L,)``. The signs of two nodes agree along
    a link, or differ along a flipped one, ``(L,)``, bool, default none. If links contradict each
    other, every node of their component remains single. Components ``(n,)`` are int32.
    """
    links = starts.cpu().int(), ends.cpu().int()
    flips = torch.zeros_like(links[0], dtype=torch.bool) if is_flipped is None else is_flipped
    marks = torch.zeros(2, num_nodes, dtype=torch.bool)
    forest = torch.arange(num_nodes, dtype=torch.int32), marks[0], marks[1]
    if kernels.serve():
        kernels.call("link_nodes", *links, flips, *forest)
        kernels.call("flatten_nodes", *forest)
    else:
        forest = _double_cover(num_nodes, *links, flips)
    roots, differs, is_contradictory = forest
    # Single nodes of contradictory components come last.
    roots, single = roots.long(), nonzero_rows(is_contradictory)
    roots[single] = num_nodes + single
    is_used = torch.zeros(2 * num_nodes, dtype=torch.bool).index_fill_(0, roots, True)
    signs = torch.where(differs & ~is_contradictory, -1.0, 1.0)
    components = is_used.cumsum(0, dtype=torch.int32)[roots].sub_(1)
    return components.to(starts.device), signs.to(starts.device)


def _double_cover(
    num_nodes: int, starts: Tensor, ends: Tensor, flips: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return each node's first connected node, whether it is flipped, and whether links disagree.

    The double cover contains each node with both signs.
    """
    other = num_nodes * flips
    starts = torch.cat([starts, starts + num_nodes]).long()
    ends = torch.cat([ends + other, ends + num_nodes - other]).long()
    first, last = torch.arange(2 * num_nodes), None
    while last is None or not torch.equal(first, last):
        last, low = first, torch.minimum(first[starts], first[ends])
        for side in (starts, ends):
            first = first.scatter_reduce(0, side, low, "amin")
        first = first[first]
    upright, opposite = first.view(2, num_nodes)
    return torch.minimum(upright, opposite), upright > opposite, upright == opposite
