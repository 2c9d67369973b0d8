"""Run one of the benchmarks in ``benchmarks/``.

python scripts/bench.py                  # list of benchmarks
python scripts/bench.py peers --help     # options of a benchmark
python scripts/bench.py steady --out steady.json --minutes 8    # repeat until complete
"""

import ast
import importlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # The scenes of tests.made.

from benchmarks import harness

from torchrg.cli.arguments import parse

FOLDER = Path(harness.__file__).parent
NAMES = sorted(
    path.stem
    for path in FOLDER.glob("*.py")
    if path.stem not in ("__init__", "harness", "patches", "protocols")
)


def title_of(name: str) -> str:
    """Return the first line of a benchmark's docstring."""
    module = ast.parse((FOLDER / f"{name}.py").read_text(encoding="utf-8"))
    return (ast.get_docstring(module) or "").partition("\n")[0]


def main(arguments: Sequence[str]) -> int:
    """Run a benchmark, or list all."""
    if arguments[:1] == ["--serve"]:
        harness.serve(arguments[1], json.loads(arguments[2]))
        return 0
    if arguments and arguments[0] in NAMES:
        module = importlib.import_module(f"benchmarks.{arguments[0]}")
        if not {"-h", "--help"}.isdisjoint(arguments):
            print(module.__doc__)
        harness.run(parse(module.Case, arguments[1:], prog=f"bench.py {arguments[0]}"))
        return 0
    print(*(f"{name:12} {title_of(name)}" for name in NAMES), sep="\n")
    return 2 if arguments else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
