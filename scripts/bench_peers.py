"""Time torchrg beside PCL, CGAL and Open3D on the same clouds, in turn, on one machine.

    python scripts/bench_peers.py --peers FOLDER --out peers
    python scripts/bench_peers.py --peers FOLDER --sizes 100000 --only pclrg torchrg-classic

FOLDER holds the programs ``pclrg`` (PCL's normals and region growing) and ``cgaln`` (CGAL's PCA and
jet normals); what is missing there, or not installed, is left out. ``torchrg-*`` and ``open3d-*``
are warm calls in one process, ``*-command`` the whole command, which is compared with PCL's whole
process. Contenders run one after the other, round by round; ratios are taken within a round.
"""

import argparse
import json
import os
import platform
from importlib.metadata import version
from pathlib import Path

from peers.contenders import Run, available, run_once, write_cloud_files
from peers.tables import markdown, plot, summarize
from tqdm import tqdm


def main() -> None:
    """Run all rounds, and write ``peers.json``, ``peers.md`` and ``peers.png``."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--peers", type=Path, help="folder of the programs pclrg and cgaln")
    parser.add_argument("--scan", type=Path, nargs="*", default=[], help="scans to run on too")
    parser.add_argument("--sizes", type=int, nargs="*", default=[100_000, 1_000_000, 4_000_000])
    parser.add_argument("--only", nargs="*", help="names of contenders; default: all there are")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=Path("peers"))
    arguments = parser.parse_args()
    names = available(arguments.peers)
    if arguments.only:
        unknown = set(arguments.only) - set(names)
        if unknown:
            parser.error(f"expected --only among {', '.join(names)}, got {', '.join(unknown)}.")
        names = [name for name in names if name in arguments.only]
    arguments.out.mkdir(parents=True, exist_ok=True)
    runs: dict[str, dict[str, list[Run]]] = {}
    for cloud in [*map(str, arguments.scan), *_room_names(arguments.sizes)]:
        folder = arguments.out / "clouds" / Path(cloud).stem.replace(" ", "-")
        write_cloud_files(cloud, folder)
        title = Path(cloud).stem
        runs[title] = {name: [] for name in names}
        for _ in range(arguments.rounds):
            for name in tqdm(names, desc=title, leave=False, disable=None):
                run = run_once(name, folder, arguments.peers, arguments.threads)
                runs[title][name].append(run)
        summary = summarize(runs)
        machine = {
            "processor": platform.machine(),
            "threads": arguments.threads,
            "python": platform.python_version(),
            **{name: version(name) for name in ("torchrg", "torch", "numpy", "scipy")},
        }
        result = {"machine": machine, "rounds": arguments.rounds, "clouds": summary}
        (arguments.out / "peers.json").write_text(json.dumps(result, indent=1))
        (arguments.out / "peers.md").write_text(markdown(summary))
        plot(summary, arguments.out / "peers.png")
    print(markdown(summarize(runs)))


def _room_names(sizes: list[int]) -> list[str]:
    return [f"room {size} {order}" for size in sizes for order in ("random", "sorted")]


if __name__ == "__main__":
    main()
