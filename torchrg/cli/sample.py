"""``torchrg sample``: a synthetic room with its truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from torchrg.cli.arguments import Argument, parse
from torchrg.cli.ending import say
from torchrg.io import check_output, write_cloud
from torchrg.scenes import make_room
from torchrg.structures import Cloud


@dataclass(frozen=True)
class Arguments:
    """Make a furnished room with exact labels and normals; the same seed gives the same room.

    Examples:
        torchrg sample room.npz
        torchrg sample room.ply --num-points 1000000 --noise 0.005 --seed 7
    """

    out: Annotated[Path, Argument("OUT", is_positional=True)]
    """File to write, its format by suffix."""
    num_points: int = 100_000
    """Number of points."""
    noise: float = 0.003
    """Standard deviation of the sensor's noise, in metres."""
    seed: int = 0
    """Seed of the random numbers."""


def run(argv: list[str]) -> int:
    """Parse the arguments and write a room."""
    arguments = parse(Arguments, argv, prog="torchrg sample")
    check_output(arguments.out)
    room = make_room(arguments.num_points, arguments.noise, arguments.seed)
    fields = {"labels": room.labels.numpy(), "normals": room.normals.numpy()}
    write_cloud(arguments.out, Cloud(room.points.numpy(), fields))
    num_faces = int(room.labels.max()) + 1
    say(f"{arguments.out}: {len(room.points):,} points, {num_faces} faces")
    return 0
