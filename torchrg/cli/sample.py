"""``torchrg sample``: a synthetic room with ground truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from torchrg.cli.arguments import Argument, parse
from torchrg.cli.ending import print_lines
from torchrg.io import check_output, write_cloud
from torchrg.scenes import make_room
from torchrg.structures import Cloud


@dataclass(frozen=True)
class Arguments:
    """Generate a furnished room with exact labels and normals; deterministic for a seed.

    Examples:
        torchrg sample room.npz
        torchrg sample room.ply --num-points 1000000 --noise 0.005 --seed 7
    """

    out: Annotated[Path, Argument("OUT", is_positional=True)]
    """Output file; the extension selects the format."""
    num_points: int = 100_000
    """Number of points."""
    noise: float = 0.003
    """Standard deviation of the sensor noise, in meters."""
    seed: int = 0
    """Random seed."""


def run(argv: list[str]) -> int:
    """Parse the arguments and write a room."""
    arguments = parse(Arguments, argv, prog="torchrg sample")
    check_output(arguments.out)
    room = make_room(arguments.num_points, arguments.noise, arguments.seed)
    fields = {"labels": room.labels.numpy(), "normals": room.normals.numpy()}
    write_cloud(arguments.out, Cloud(room.points.numpy(), fields))
    num_faces = int(room.labels.max()) + 1
    print_lines(f"{arguments.out}: {len(room.points):,} points, {num_faces} planes")
    return 0
