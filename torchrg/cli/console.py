"""What the commands share: settings, places of results, lines on a terminal."""

import contextlib
import dataclasses
import os
import re
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import torch
from tqdm import tqdm

from torchrg.cli.arguments import Argument
from torchrg.cli.ending import USAGE_ERROR as USAGE_ERROR
from torchrg.cli.ending import printable as printable
from torchrg.cli.ending import say as say
from torchrg.cli.ending import warn as warn
from torchrg.config import DEFAULT_PRESET, PipelineConfig, SuperpointsConfig, load_config
from torchrg.datasets.folder import folded_name
from torchrg.errors import ConfigError, FormatError
from torchrg.io import FORMATS, RESULT_FIELDS, check_output, takes_columns
from torchrg.io.fields import COLUMNS_RULE, notes_on_results
from torchrg.io.files import check_place, make_folder
from torchrg.render.page import check_library
from torchrg.structures import Cloud


@contextlib.contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Print warnings as single lines."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield
    for warning in caught:
        warn(" ".join(str(warning.message).split()))


@dataclass(frozen=True)
class PlaneSettings:
    """How planes are found: what the preset or the file says, where no flag says otherwise."""

    preset: str = DEFAULT_PRESET
    """Settings to start from: those of a method (classic, classic_increment, detmm, paper,
    algorithm2, consensus), or those for a kind of data (s3dis, scannet, laser, rgbd). Flags change
    them one by one."""
    config: Path | None = None
    """YAML file with settings, in place of a preset; what it does not name has its default."""
    angle_deg: float | None = None
    """The one threshold of the paper, in degrees: that of sharp points and of growth. The flags
    --normals.sharp-angle-deg and --growing.max-angle-deg win where they are given."""
    resolved: Annotated[PipelineConfig, Argument(is_inline=True)] = dataclasses.field(
        default_factory=PipelineConfig
    )

    @classmethod
    def asked_for(cls, argv: list[str], preset: str = DEFAULT_PRESET) -> "PlaneSettings":
        """Return the settings of the preset or the file in the arguments: defaults of the flags.

        ``preset`` is that of commands which name none.

        Example:
            >>> PlaneSettings.asked_for(["scan.pcd", "--preset=classic"]).resolved.normals.method
            'pca'
        """
        values = {"--preset": preset, "--config": "", "--angle-deg": ""}
        for argument, following in pairwise((*argv, "")):
            name, equals, value = argument.partition("=")
            name = name.replace("_", "-")
            if name in values:
                values[name] = value if equals else following
        resolved = load_config(values["--config"] or values["--preset"])
        try:
            angle = float(values["--angle-deg"])
        except ValueError:  # It is not given, or a word that the parser refuses.
            return cls(preset, resolved=resolved)
        return cls(preset, resolved=resolved.at_angle(angle))


CloudsFlag = Annotated[
    tuple[Path, ...],
    Argument(
        metavar="CLOUD",
        is_positional=True,
        text=f"Clouds to read, files that end in {' '.join(FORMATS)}. For depth images, and for "
        "organised clouds taken as images, there is torchrg depth.",
    ),
]
"""Type of the argument that names clouds."""
ColumnsFlag = Annotated[
    str | None,
    Argument(
        metavar="X,Y,Z,...",
        text="Names of the columns of text and of bare .npy arrays, in their order, as "
        f"x,y,z,intensity,r,g,b; _ leaves one out. {COLUMNS_RULE} What was taken is printed.",
    ),
]
"""Type of the argument --columns."""


_MOST_THREADS = 1024
"""More than any machine has cores; many more cannot be started, and torch ends with the process."""
_MOST_GIGABYTES = 1_000_000
"""A petabyte, more than any machine has memory."""


OrientFlag = Annotated[
    Literal["auto", "interior", "viewpoint", "up", "none"],
    Argument(
        text="To which side normals point: to the front of the faces where the file is a mesh, "
        "else to the scanner where it names its places, as E57 does, else into the free space of "
        "rooms (auto); always into rooms (interior), to the scanner (viewpoint) or along +z (up); "
        "or to that side where the first of z, y, x that is not zero is positive (none).",
    ),
]
"""Type of the argument --orient of clouds."""
ImageOrientFlag = Annotated[
    Literal["auto", "interior", "viewpoint", "up", "none"],
    Argument(
        text="To which side normals point: to the camera (auto, viewpoint, none), into the free "
        "space of rooms (interior), or along +z (up), which is the optical axis where no pose of "
        "the camera is known.",
    ),
]
"""Type of the argument --orient of depth images."""


Layout = Literal["pointcept", "scannet", "mmdet3d", "spformer", "isbnet", "mask3d", "npy"]
"""Type of the argument --layout."""


@dataclass(frozen=True)
class ColumnNames:
    """What the flag --columns says: names for the columns of files that have none of their own.

    Example:
        >>> names = ColumnNames.parse("x,y,z,_", ["a.txt", "b.ply"])
        >>> names.of("a.txt"), names.of("b.ply")
        (('x', 'y', 'z', '_'), None)
    """

    names: tuple[str, ...] | None = None

    @classmethod
    def parse(
        cls, text: str | None, paths: Iterable[str | os.PathLike[str]] | None
    ) -> "ColumnNames":
        """Return the names in a text, which are for some of the files, if these are known."""
        if text is None:
            return cls()
        if paths is not None and not any(map(takes_columns, paths)):
            raise ConfigError("expected text or .npy for --columns, got files that name their own.")
        return cls(tuple(name.strip() for name in text.split(",")))

    def of(self, path: str | os.PathLike[str]) -> tuple[str, ...] | None:
        """Return the names for the columns of a file; None for one that says them itself."""
        return self.names if takes_columns(path) else None


SettingsFlags = Annotated[PlaneSettings, Argument(is_inline=True)]
"""Type of an argument whose flags are ``--preset``, ``--config``, ``--normals.k`` and so on."""


def spell_counts(argv: Sequence[str], flag: str) -> list[str]:
    """Return arguments in which numbers after a flag of superpoints have a flag of their own.

    Example:
        >>> spell_counts(["a.ply", "--superpoints", "1000,300", "--merge"], "--superpoints")
        ['a.ply', '--superpoints', '--partition.counts', '1000', '300', '--merge']
    """
    spelled: list[str] = []
    for argument in argv:
        is_after = spelled[-1:] == [flag]
        given, _, numbers = argument.rpartition("=") if "=" in argument else ("", "", argument)
        if re.fullmatch(r"\d+(,\d+)*", numbers) and (is_after or given == flag):
            spelled += [given] * bool(given) + ["--partition.counts", *numbers.split(",")]
        else:
            spelled.append(argument)
    return spelled


def check_level(level: int, config: SuperpointsConfig) -> None:
    """Refuse a level that superpoints do not have."""
    if not 0 <= level < config.num_levels:
        most = config.num_levels - 1
        raise ConfigError(f"expected --level from 0 to {most}, the levels there are, got {level}.")


def parse_intrinsics(text: str) -> tuple[float, float, float, float]:
    """Return the four numbers of ``fx,fy,cx,cy``, or say that they are none."""
    try:
        fx, fy, cx, cy = map(float, text.split(","))
    except ValueError:
        raise ConfigError(
            f"expected --intrinsics fx,fy,cx,cy, four numbers without blanks, got {text!r}."
        ) from None
    return fx, fy, cx, cy


def note_input(
    source: str, cloud: Cloud, target: Path, results: Collection[str] = RESULT_FIELDS
) -> None:
    """Warn of what reading took for granted, and of own fields that results take the names of."""
    written = () if _is_archive(target) else notes_on_results(cloud.fields, results)
    for note in (*cloud.notes, *written):
        warn(f"{source}: {note}.")


def without(target: Path, fields: Collection[str]) -> str:
    """Return the words for a report on which fields of a cloud its result does not hold."""
    return f" (without its own {', '.join(fields)})" if fields and _is_archive(target) else ""


def _is_archive(target: Path) -> bool:
    """Whether a result goes to the format that holds it alone, without fields of the cloud."""
    return target.suffix.lower() == ".npz"


def use_threads(threads: int | None) -> None:
    """Let torch use so many threads; None leaves it to torch."""
    if threads is None:
        return
    if not 1 <= threads <= _MOST_THREADS:
        raise ConfigError(f"expected --threads from 1 to {_MOST_THREADS:,}, got {threads}.")
    torch.set_num_threads(threads)


def check_memory(limit_memory: float | None) -> None:
    """Refuse a limit of memory that is none."""
    if limit_memory is not None and not 0 < limit_memory <= _MOST_GIGABYTES:
        raise ConfigError(
            f"expected --limit-memory above 0 and at most {_MOST_GIGABYTES:,} GB, got "
            f"{limit_memory}."
        )


@contextlib.contextmanager
def stage_bar(name: str, stages: Sequence[str]) -> Iterator[Callable[[str], None]]:
    """Show a progress bar on a terminal; what is yielded is called as each stage begins."""
    with tqdm(
        total=len(stages), desc=printable(name), unit="stage", leave=False, disable=None
    ) as bar:

        def advance(stage: str) -> None:
            bar.set_postfix_str(stage)
            bar.update(stage != stages[0])

        yield advance


def format_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return rows of text as aligned columns, numbers to the right.

    Example:
        >>> print(format_table(["scan", "points"], [["hall", "1,000"], ["office", "20"]]))
        scan    points
        hall     1,000
        office      20
    """
    columns = []
    for cells in zip(*(map(printable, row) for row in (head, *rows)), strict=True):
        width = max(map(len, cells))
        numeric = all(cell[:1].isdigit() or not cell for cell in cells[1:])
        columns.append([cell.rjust(width) if numeric else cell.ljust(width) for cell in cells])
    return "\n".join("  ".join(row).rstrip() for row in zip(*columns, strict=True))


def output_paths(inputs: tuple[Path, ...], out: Path, *, suffix: str = ".npz") -> list[Path]:
    """Return where the result of each input goes.

    One input goes to the file ``out``, a cloud or of the given suffix, or under its own name into
    an existing directory; several need a directory, which is made. With an empty suffix each result
    is a directory.

    Raises:
        FormatError: If there is no input, two results would share a name, or one cannot be
            written.
    """
    if not inputs:
        raise FormatError("expected at least one input file, got none.")
    given = out.suffix.lower()
    if suffix and len(inputs) == 1 and not out.is_dir():
        check_place(out) if given == suffix else check_output(out)
        return [out]
    if given and given in (suffix, *FORMATS) and not out.is_dir():
        raise FormatError(f"{out}: expected a directory for {len(inputs)} inputs, got a file name.")
    results = [out / f"{path.stem}{suffix}" for path in inputs]
    first: dict[str, Path] = {}
    for result, source in zip(results, inputs, strict=True):
        other = first.setdefault(folded_name(result.name), source)
        if other is not source:
            raise FormatError(
                f"{source}: another input has the same name, {other}, and {out / result.name} is "
                "one place; give them different directories."
            )
    make_folder(out)
    for result in results if suffix else []:
        check_place(result)
    return results


def check_apart(results: Sequence[Path], inputs: Sequence[Path]) -> None:
    """Raise FormatError if a result would take the place of an input or of another result."""
    taken = {str(path.resolve()) for path in inputs}
    files = {_file_number(path) for path in inputs} - {None}
    for path in results:
        place = str(path.resolve())
        if not taken.isdisjoint((place, folded_name(place))) or _file_number(path) in files:
            raise FormatError(
                f"{path}: expected a place of its own for each result, got one of an input or of "
                "another result; choose another."
            )
        taken.add(folded_name(place))


def _file_number(path: Path) -> tuple[int, int] | None:
    """Return what tells a file from others, whatever the case of its name; None without a file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


DRAWINGS = (".png", ".html")
"""Suffixes of pictures and pages."""


def picture_paths(
    results: Sequence[Path], picture: Path | None, *, suffixes: Sequence[str] = DRAWINGS
) -> Sequence[Path | None]:
    """Return where the picture of each result goes, by the rules of :func:`output_paths`."""
    if picture is None:
        return [None] * len(results)
    if not picture.is_dir():
        if len(results) == 1 and picture.suffix:
            check_drawing(picture, suffixes=suffixes)
            return [picture]
        if picture.suffix.lower() in suffixes:
            raise FormatError(
                f"{picture}: expected a directory for {len(results)} pictures, got a file name."
            )
    make_folder(picture)
    pictures = [picture / f"{path.stem}.png" for path in results]
    for path in pictures:
        check_place(path)
    return pictures


def check_drawing(path: Path, *, suffixes: Sequence[str] = DRAWINGS) -> None:
    """Raise before long work if a picture or page has no place, or cannot be made."""
    if path.suffix.lower() not in suffixes:
        raise FormatError(f"{path}: expected a file that ends in {' or '.join(suffixes)}.")
    check_place(path)
    if is_page(path):
        check_library()


def is_page(path: Path) -> bool:
    """Return whether a drawing is a page."""
    return path.suffix.lower() == ".html"
