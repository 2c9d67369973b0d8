"""One depth frame: where it is, and what its numbers mean."""

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from torchrg._checks import check_shapes
from torchrg.errors import ConfigError


@dataclass(frozen=True, eq=False)
class RGBDFrame:
    """A depth frame on disk.

    Args:
        depth: Depth image: 16-bit gray PNG, or ``.npy`` of shape ``(H, W)``.
        intrinsics: Camera matrix, shape ``(3, 3)``; the middle of the first pixel is at (0, 0).
        depth_scale: Stored value of one metre: 1000 for millimetres, 5000 for TUM, 1 for metres.
        name: Unique within a data set and fit for a path below an output folder, with forward
            slashes: ``scene0000_00/12``.
        color: Colour image registered to the depth, if there is one: PNG or JPEG.
        pose: Matrix from camera to world coordinates, shape ``(4, 4)``, if it is known.
        no_depth: Stored value that means "no depth" beside 0, if there is one.
        sources: Further files that intrinsics and pose were read from.

    Raises:
        ShapeError: If a matrix has another shape.
        ConfigError: If ``depth_scale`` is not positive.
    """

    depth: Path
    intrinsics: Tensor
    depth_scale: float
    name: str = ""
    color: Path | None = None
    pose: Tensor | None = None
    no_depth: int | None = None
    sources: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        check_shapes("RGBDFrame", intrinsics=(self.intrinsics, "3 3"), pose=(self.pose, "4 4"))
        if not 0 < self.depth_scale < float("inf"):
            raise ConfigError(
                f"RGBDFrame: expected depth_scale > 0, the stored value of one metre, got "
                f"{self.depth_scale}."
            )

    @property
    def files(self) -> tuple[Path, ...]:
        """Every input file: depth, colour if there is one, and those of intrinsics and pose."""
        color = () if self.color is None else (self.color,)
        return (self.depth, *color, *self.sources)
