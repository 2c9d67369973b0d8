"""Flags that several commands share, and what their values mean."""

import dataclasses
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import torch

from torchrg.cli.arguments import ALSO, Argument
from torchrg.cli.ending import warn, warnings_as_lines
from torchrg.config import (
    DEFAULT_PRESET,
    WHITENESS,
    PipelineConfig,
    SelectionConfig,
    SuperpointsConfig,
    load_config,
)
from torchrg.datasets.camera_files import SUFFIXES, read_camera
from torchrg.depth.camera import Pinhole
from torchrg.errors import ConfigError
from torchrg.io import FORMATS, takes_columns
from torchrg.io.fields import COLUMNS_RULE
from torchrg.normals import Orientation
from torchrg.structures import FARTHEST, Sampling

_MAX_THREADS = 1024
"""More than any machine has cores; many more cannot be started, and torch ends with the process."""
_MAX_GIGABYTES = 1_000_000
"""A petabyte, more than any machine has memory."""

CloudsFlag = Annotated[
    tuple[Path, ...],
    Argument(
        metavar="CLOUD",
        is_positional=True,
        text=f"Clouds to read, files that end in {' '.join(FORMATS)}. For depth images, and for "
        "organised clouds taken as images, there is torchrg depth.",
    ),
]
OutFlag = Annotated[
    Path,
    Argument(text="File to write, its format by suffix; for several inputs a directory."),
]
ColumnsFlag = Annotated[
    str | None,
    Argument(
        metavar="X,Y,Z,...",
        text="Names of the columns of text and of bare .npy arrays, in their order, as "
        f"x,y,z,intensity,r,g,b; _ leaves one out. {COLUMNS_RULE} What was taken is printed.",
    ),
]
ThreadsFlag = Annotated[
    int | None,
    Argument(text="Number of threads. Default: as torch decides, usually one for each core."),
]
OrientFlag = Annotated[
    Orientation,
    Argument(
        text="Side to which normals point. auto: the front of the faces of a mesh, else the "
        "scanner if the file names its place, as E57 does, else interior. interior: the free space "
        "of rooms. viewpoint: the scanner. consistent: as their neighbors. up, +x ... -z: along an "
        "axis. none: as estimated, which is fastest.",
    ),
]
ViewpointFlag = Annotated[
    tuple[float, float, float] | None,
    Argument(
        text="Place of the scanner in the coordinates of the input, for --orient viewpoint. "
        "Default: the places that the file names.",
    ),
]
IntrinsicsFlag = Annotated[
    str | None,
    Argument(
        metavar="CAMERA",
        text="Camera, as fx,fy,cx,cy in pixels, where the middle of the first pixel is 0,0, or its "
        "file: a matrix of 3 x 3 or 4 x 4 numbers, JSON, YAML, info.txt, COLMAP's cameras.txt. A "
        "camera file that names a larger image size is scaled. Default: the camera file of the "
        "folder.",
    ),
]
DepthScaleFlag = Annotated[
    float | None,
    Argument(text="Stored value of one metre: 1000 for millimetres. Default: that of the folder."),
]
ImageOrientFlag = Annotated[
    Orientation,
    Argument(
        text="Side to which normals point. auto, viewpoint, none: the camera. interior: the free "
        "space of rooms. consistent: as their neighbors. up, +x ... -z: along an axis, in camera "
        "coordinates if the pose is unknown.",
    ),
]
TableFlag = Annotated[
    Path | None,
    Argument(
        metavar="PLANES.csv",
        text="Table of the planes to write too, .csv or .json; for several inputs a directory. CSV "
        "has a line for each plane, in the coordinates of the input: class, normal, offset, "
        "centroid, area, dip, root mean square distance, outline as WKT POLYGON Z. Up is z. Of "
        "clouds it asks for classes and outlines (pip install 'torchrg[outline]').",
    ),
]
WithinFlag = Annotated[
    str | None,
    Argument(
        metavar="FIELD",
        text="Field with the object of each point, as instance or segment: no plane has points of "
        "two of them, and the table of planes names the object of each. Points that have none, "
        "-1, are an object too. Default: planes go across.",
    ),
]
Layout = Literal["pointcept", "scannet", "mmdet3d", "spformer", "isbnet", "mask3d", "nag", "npy"]


@dataclass(frozen=True)
class PlaneSettings:
    """How planes are found: what the preset or the file says, where no flag says otherwise."""

    preset: str = DEFAULT_PRESET
    """Settings to start from: consensus, which measures what kind of data it has, or those of
    another method (classic, classic_increment, detmm, paper, algorithm2). Flags change them one by
    one."""
    config: Path | None = None
    """YAML file with settings, in place of a preset; what it does not name has its default."""
    angle_deg: float | None = None
    """The one threshold of the paper, in degrees: that of sharp points and of growth. The flags
    --normals.sharp-angle-deg and --growing.max-angle-deg win where they are given."""
    resolved: Annotated[PipelineConfig, Argument(is_inline=True)] = dataclasses.field(
        default_factory=PipelineConfig
    )

    @classmethod
    def asked_for(cls, argv: list[str]) -> "PlaneSettings":
        """Return the settings of the preset or the file in the arguments: defaults of the flags.

        The axis z points up unless the file names another. A table of planes has outlines as far as
        they can be known.

        Example:
            >>> PlaneSettings.asked_for(["scan.pcd", "--preset=classic"]).resolved.normals.method
            'pca'
        """
        values = {"--preset": "", "--config": "", "--angle-deg": ""}
        for argument, following in pairwise((*argv, "")):
            name, equals, value = argument.partition("=")
            name = name.replace("_", "-")
            if name in values:
                values[name] = value if equals else following
        resolved = load_config(values["--config"] or values["--preset"] or DEFAULT_PRESET)
        planes = dataclasses.replace(resolved.planes, up=resolved.planes.up or "z")
        if any(argument.partition("=")[0] == "--table" for argument in argv):
            outline = planes.outline or find_spec("shapely") is not None
            planes = dataclasses.replace(planes, outline=outline)
        resolved = dataclasses.replace(resolved, planes=planes)
        try:
            angle = float(values["--angle-deg"])
        except ValueError:  # It is not given, or a word that the parser refuses.
            return cls(resolved=resolved)
        return cls(resolved=resolved.at_angle(angle))


def choice_of(sampling: Sampling, settings: Mapping[str, Any]) -> str:
    """Return in words what was measured of a cloud, and the settings that it chose.

    Example:
        >>> choice_of(Sampling(0.06, 0.5, 0.6, 4000.0, 2.7), {"growing.min_size": 173})
        'faces in facets or bent (whiteness 0.06): min_size 173'
    """
    low, high = WHITENESS
    kind = "faces partly bent, noise partly white"
    if sampling.whiteness <= low:
        kind = "faces in facets or bent"
    elif sampling.whiteness >= high:
        kind = "white noise"
    chosen = ", ".join(
        f"{name.partition('.')[2]} {'none' if value is None else value}"
        for name, value in settings.items()
    )
    return f"{kind} (whiteness {sampling.whiteness:g}): {chosen}"


def reason_for_no_plane(settings: SelectionConfig) -> str:
    """Return why a result has no plane.

    Example:
        >>> reason_for_no_plane(SelectionConfig(min_area=9.0))
        'no plane passes --min-area and --kinds'
    """
    is_chosen = settings.min_area > 0 or settings.kinds is not None
    return "no plane passes --min-area and --kinds" if is_chosen else "no region is large enough"


SettingsFlags = Annotated[PlaneSettings, Argument(is_inline=True)]
"""Type of an argument whose flags are ``--preset``, ``--config``, ``--normals.k`` and so on."""


def split_columns(columns: str | None) -> tuple[str, ...] | None:
    """Return the names in the value of ``--columns``.

    Example:
        >>> split_columns("x, y,z,_")
        ('x', 'y', 'z', '_')
    """
    return None if columns is None else tuple(name.strip() for name in columns.split(","))


def columns_of(path: str | os.PathLike[str], columns: str | None) -> tuple[str, ...] | None:
    """Return the names that ``--columns`` gives a file; None for one that names its own."""
    return split_columns(columns) if takes_columns(path) else None


def check_viewpoint(viewpoint: tuple[float, float, float] | None, orient: str) -> None:
    """Refuse a viewpoint that normals do not point to."""
    if viewpoint is not None and orient != "viewpoint":
        raise ConfigError(
            f"expected --viewpoint X Y Z with --orient viewpoint, got --orient {orient}; add it."
        )


def check_columns(columns: str | None, paths: Iterable[str | os.PathLike[str]]) -> None:
    """Refuse names of columns where every file names its own."""
    if columns is not None and not any(map(takes_columns, paths)):
        raise ConfigError("expected text or .npy for --columns, got files that name their own.")


def spell_counts(argv: Sequence[str]) -> list[str]:
    """Return arguments in which numbers after ``--superpoints`` have a flag of their own.

    Example:
        >>> spell_counts(["a.ply", "--superpoints", "1000,300", "--merge"])
        ['a.ply', '--superpoints', '--partition.counts', '1000', '300', '--merge']
    """
    spelled: list[str] = []
    for argument in argv:
        names = ("--superpoints", *ALSO["--superpoints"])
        is_after = spelled[-1:] and spelled[-1] in names
        name, _, numbers = argument.rpartition("=")
        if re.fullmatch(r"\d+(,\d+)*", numbers) and (name in names or (is_after and not name)):
            spelled += [name] * bool(name) + ["--partition.counts", *numbers.split(",")]
        else:
            spelled.append(argument)
    return spelled


def check_level(level: int, config: SuperpointsConfig) -> None:
    """Refuse a level that superpoints do not have."""
    if not 0 <= level < config.num_levels:
        most = config.num_levels - 1
        raise ConfigError(f"expected --level from 0 to {most}, the levels there are, got {level}.")


def parse_intrinsics(text: str | None) -> Pinhole | None:
    """Return the camera of ``fx,fy,cx,cy`` or of a file; None where none is given."""
    if text is None:
        return None
    numbers: list[float] = []
    with suppress(ValueError):
        numbers = [*map(float, text.split(","))]
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        if 0 in (fx, fy) or not all(abs(number) <= FARTHEST for number in numbers):
            raise ConfigError(
                f"expected finite --intrinsics with fx and fy not 0, got {text}; pass pixels."
            )
        if min(fx, fy) < 0:
            warn(
                f"--intrinsics {text}: a negative focal length turns the image over; leave out the "
                "minus unless that is meant."
            )
        return Pinhole(fx, fy, cx, cy)
    is_file = False
    with suppress(OSError):
        is_file = Path(text).is_file()
    if is_file or text.lower().endswith(SUFFIXES[1:]):
        with warnings_as_lines():
            return read_camera(Path(text))
    raise ConfigError(
        "expected --intrinsics fx,fy,cx,cy, four numbers without blanks, or a camera file, got "
        f"{text!r}."
    )


def use_threads(threads: int | None) -> None:
    """Let torch use so many threads; None leaves it to torch."""
    if threads is None:
        return
    if not 1 <= threads <= _MAX_THREADS:
        raise ConfigError(f"expected --threads from 1 to {_MAX_THREADS:,}, got {threads}.")
    torch.set_num_threads(threads)


def bytes_of_limit(limit_memory: float | None, usual: int = 0) -> int:
    """Return the limit of memory in bytes, the usual one where none is set; refuse a wrong one."""
    if limit_memory is None:
        return usual
    if not 0 < limit_memory <= _MAX_GIGABYTES:
        raise ConfigError(
            f"expected --limit-memory above 0 and at most {_MAX_GIGABYTES:,} GB, got "
            f"{limit_memory}."
        )
    return int(limit_memory * 1e9)
