"""Connected components of graphs."""

import numpy as np
import torch
from torch import Tensor

from torchrg import kernels
from torchrg._parallel import nonzero_rows


def connected_components(num_nodes: int, starts: Tensor, ends: Tensor) -> Tensor:
    """Return the component of each node, in the order of first nodes, shape ``(n,)``, int64.

    Links between nodes are ``starts`` and ``ends``, shape ``(L,)``.
    """
    components, links = Components(num_nodes), (starts.cpu().int(), ends.cpu().int())
    components.link(*links, torch.zeros(len(starts), dtype=torch.bool))
    return components.find()[0].to(starts.device, torch.int64)


class Components:
    """Connected components of a signed graph.

    The signs of two nodes agree along a link, or differ along a flipped one. If links contradict
    each other, every node of their component remains single.
    """

    def __init__(self, num_nodes: int) -> None:
        self.parents = torch.arange(num_nodes, dtype=torch.int32)
        self.is_flipped = torch.zeros(num_nodes, dtype=torch.bool)
        self.is_contradictory = torch.zeros(num_nodes, dtype=torch.bool)
        self.links: list[tuple[Tensor, Tensor, Tensor]] = []

    def link(self, starts: Tensor, ends: Tensor, is_flipped: Tensor) -> None:
        """Add links between nodes ``(L,)``, int32; ``is_flipped`` ``(L,)`` marks flipped links."""
        if kernels.serve():
            forest = self.parents, self.is_flipped, self.is_contradictory
            kernels.call("link_nodes", starts, ends, is_flipped, *forest)
        else:
            self.links.append((starts, ends, is_flipped))

    def find(self) -> tuple[Tensor, Tensor]:
        """Return the component of each node, in the order of first nodes, and its sign, 1 or -1."""
        if kernels.serve():
            kernels.call("flatten_nodes", self.parents, self.is_flipped, self.is_contradictory)
        elif self.links:
            self._search()
        # Single nodes of contradictory components come last.
        roots, single = self.parents.long(), nonzero_rows(self.is_contradictory)
        roots[single] = len(roots) + single
        is_used = torch.zeros(2 * len(roots), dtype=torch.bool).index_fill_(0, roots, True)
        signs = torch.where(self.is_flipped & ~self.is_contradictory, -1.0, 1.0)
        return is_used.cumsum(0, dtype=torch.int32)[roots].sub_(1), signs

    def _search(self) -> None:
        """Find components of the double cover, which contains each node with both signs."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        count = len(self.parents)
        starts, ends, is_flipped = (
            torch.cat(parts).numpy() for parts in zip(*self.links, strict=True)
        )
        other = count * is_flipped.astype(np.int32)
        pairs = np.append(starts, starts + count), np.append(ends + other, ends + count - other)
        cover = coo_array((np.ones(2 * len(starts)), pairs), shape=(2 * count, 2 * count))
        upright, opposite = connected_components(cover, directed=False)[1].reshape(2, count)
        _, first, inverse = np.unique(
            np.minimum(upright, opposite), return_index=True, return_inverse=True
        )
        self.parents = torch.from_numpy(first[inverse].astype(np.int32))
        self.is_flipped, self.is_contradictory = map(
            torch.from_numpy, (upright > opposite, upright == opposite)
        )
