"""Pictures of segmentations beside the results of a command."""

from collections.abc import Sequence
from pathlib import Path

from torchrg.errors import FormatError
from torchrg.io.files import check_place
from torchrg.render import color_planes, render_cloud, write_png
from torchrg.structures import Cloud, Segmentation


def picture_paths(results: Sequence[Path], picture: Path | None) -> list[Path | None]:
    """Return where the picture of each result goes.

    One picture goes to the file ``picture``, or under the name of the result into an existing
    directory; several need a directory, which is made.

    Raises:
        FormatError: If a picture cannot be written there.
    """
    if picture is None:
        return [None] * len(results)
    if len(results) == 1 and not picture.is_dir():
        check_picture(picture)
        return [picture]
    if picture.suffix.lower() == ".png" and not picture.is_dir():
        raise FormatError(
            f"{picture}: expected a directory for {len(results)} pictures, got a file name."
        )
    picture.mkdir(parents=True, exist_ok=True)
    return [picture / f"{path.stem}.png" for path in results]


def check_picture(path: Path) -> None:
    """Check before long work that a picture has a place.

    Raises:
        FormatError: If the file does not end in .png, or cannot be put there.
    """
    if path.suffix.lower() != ".png":
        raise FormatError(f"{path}: expected a file that ends in .png.")
    check_place(path)


def draw_segmentation(path: Path, cloud: Cloud, segmentation: Segmentation) -> None:
    """Write a picture of a cloud, each plane in a colour of its own."""
    colors = color_planes(segmentation.labels, cloud.points)
    write_png(path, render_cloud(cloud.points, colors, normals=segmentation.normals))
