"""One call of the script: its clouds, loaded once, and where its results go."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from torch import Tensor

from reproduction.cells import Folder
from reproduction.clouds import EvalCloud, load_cloud
from reproduction.faces import find_edges
from torchrg import estimate_normals, load_config, search_knn, segment_planes
from torchrg.config import NormalsConfig
from torchrg.scenes import make_room
from torchrg.structures import Neighbors, NormalFit

_WARM_UP = 2000


@dataclass(frozen=True)
class Run:
    """One call of the script.

    Args:
        folder: Where results go.
        quick: Whether small clouds will do.
        paths: The paper's own clouds, by key.
    """

    folder: Folder
    quick: bool
    paths: Mapping[str, Path | None] = field(default_factory=dict)
    _clouds: dict[str, "LoadedCloud"] = field(default_factory=dict)
    _warm: set[str] = field(default_factory=set)

    def cloud(self, key: str) -> "LoadedCloud":
        """Return a cloud, loaded once."""
        if key not in self._clouds:
            # Neighbours of a million points are large: those of other clouds are let go.
            for other in self._clouds.values():
                other.forget()
            cloud = load_cloud(key, self.paths.get(key), quick=self.quick)
            self._clouds[key] = LoadedCloud(cloud)
        return self._clouds[key]

    def warm_up(self, method: str) -> None:
        """Segment a small cloud first, so that no time includes the loading of code."""
        if method not in self._warm:
            segment_planes(make_room(_WARM_UP).points, load_config(method))
            self._warm.add(method)


@dataclass(frozen=True)
class LoadedCloud:
    """A cloud, and its neighbours and normals once they are asked for."""

    cloud: EvalCloud
    _fits: dict[NormalsConfig, NormalFit] = field(default_factory=dict)

    @cached_property
    def neighbors(self) -> Neighbors:
        """The neighbours that all methods use."""
        return search_knn(self.cloud.points, load_config().normals.k)

    @cached_property
    def at_edges(self) -> Tensor:
        """The points with true faces of two kinds among their neighbours, shape ``(N,)``."""
        return find_edges(self.cloud.labels, self.neighbors)

    def fit(self, settings: NormalsConfig) -> NormalFit:
        """Return normals by some settings; those of the last ones asked for are kept."""
        if settings not in self._fits:
            self._fits.clear()
            self._fits[settings] = estimate_normals(
                self.cloud.points, config=settings, neighbors=self.neighbors
            )
        return self._fits[settings]

    def forget(self) -> None:
        """Let go what is large and can be computed again."""
        self.__dict__.pop("neighbors", None)
        self._fits.clear()
