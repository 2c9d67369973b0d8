"""Environment of a measurement: versions, commit, processor, cores and threads.

As a script it prints the minimum and installed versions of the dependencies.
"""

import os
import platform
import re
import subprocess
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from pathlib import Path

PACKAGES = ("torchrg", "torch", "numpy", "scipy")


def describe(threads: int) -> dict[str, str | int | None]:
    """Return the environment of the current process and its number of threads."""
    git = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    versions = {name: version(name) for name in PACKAGES}
    return {
        "torchrg": versions.pop("torchrg"),
        "commit": git.stdout.strip() or "unknown",
        "python": platform.python_version(),
        **versions,
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": threads,
    }


def _processor() -> str:
    """Return the name of the processor."""
    listing = Path("/proc/cpuinfo")
    if listing.exists():
        for line in listing.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def oldest_and_here() -> str:
    """Return the minimum and installed versions as a Markdown table."""
    needs = [f"python{metadata('torchrg')['Requires-Python']}", *sorted(requires("torchrg") or ())]
    found = (re.match(r"([\w-]+)(?:\[.*\])?>=([\d.]+)", need) for need in needs)
    rows = {f"| {row[1]} | {row[2]} | {_installed(row[1])} |": None for row in found if row}
    return "\n".join(["| package | oldest | here |", "|---|---|---|", *rows])


def _installed(package: str) -> str:
    """Return the version of a package."""
    try:
        return platform.python_version() if package == "python" else version(package)
    except PackageNotFoundError:
        return "none"


if __name__ == "__main__":
    print(oldest_and_here())
