"""Memory needed by a scan, and available memory."""

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

PROCESS_BYTES = 400_000_000
"""Memory of a process without points: Python, torch, scipy."""
_BYTES_PER_POINT = {(False, False): 500, (True, False): 1000, (False, True): 100, (True, True): 600}
"""Peak memory per point or pixel with any preset, by whether there are superpoints and whether the
large arrays are on disk, for at most ``_K`` neighbors and ``_NUM_LEVELS`` levels. On disk, pages of
files do not count: the system can reclaim them."""
_K, _NUM_LEVELS = 50, 4
_BYTES_PER_NEIGHBOR, _BYTES_PER_LEVEL, _BYTES_PER_PAIR = {False: 14, True: 8}, 24, 40
"""Memory per point of each further neighbor (False: not on disk) and level, and of ``k * k``."""
_CGROUP, _PROCESS_CGROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
"""Linux control groups, which limit containers and cluster jobs, and those of this process."""
_CGROUP_FILES = {
    "": ("memory.max", "memory.current", "inactive_file"),
    "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
}
"""Limit, usage and reclaimable cache of a control group by controller: "" is version 2."""


def scan_memory(num_points: int, *, k: int = _K, num_levels: int = 0, on_disk: bool = False) -> int:
    """Return the memory that a process needs for a cloud or a depth image, in bytes.

    ``k``: number of neighbors; ``num_levels``: levels of superpoints, 0 without superpoints;
    ``on_disk``: large arrays are spilled to disk.
    """
    more = max(min(k, num_points) - _K, 0)
    per_point = _BYTES_PER_POINT[num_levels > 0, on_disk] + _BYTES_PER_NEIGHBOR[on_disk] * more
    per_point += _BYTES_PER_LEVEL * max(num_levels - _NUM_LEVELS, 0)
    return PROCESS_BYTES + per_point * num_points + _BYTES_PER_PAIR * more * more


def available_memory() -> int:
    """Return the bytes that this process may allocate on its machine and in its control groups."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    free = _read_entry("/proc/meminfo", "MemAvailable", default=total)
    return max(0, min([free, *_group_remainders()]))


def _group_remainders() -> Iterator[int]:
    """Yield what each control group of this process, and each parent, can still allocate."""
    # A container may see a path of its host, of which only the root exists in its own tree.
    for line in _PROCESS_CGROUPS.read_text().splitlines() if _PROCESS_CGROUPS.exists() else []:
        _, controllers, path = line.split(":", 2)
        for controller in set(controllers.split(",")) & _CGROUP_FILES.keys():
            limit, used, cached = _CGROUP_FILES[controller]
            group = _CGROUP / controller / path.lstrip("/")
            for folder in (group, *group.parents):
                with suppress(OSError, ValueError):  # No group, or no limit: the word "max".
                    remainder = int((folder / limit).read_text()) - int((folder / used).read_text())
                    yield remainder + _read_entry(folder / "memory.stat", cached, default=0, unit=1)


def reset_peak_memory() -> None:
    """Reset the peak memory of this process, if the system supports it (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_memory(process: int | str = "self") -> int:
    """Return the largest resident memory of a process since its last reset, in bytes.

    Except on Linux, it is the peak of this process since its start.
    """
    import resource

    usage = resource.getrusage(resource.RUSAGE_SELF)
    return _read_entry(f"/proc/{process}/status", "VmHWM", default=usage.ru_maxrss * 1024)


def _read_entry(path: str | Path, name: str, *, default: int, unit: int = 1024) -> int:
    """Return an entry of a Linux status file in bytes."""
    try:
        text = Path(path).read_text(encoding="ascii", errors="replace")
    except OSError:
        return default
    found = re.search(rf"^{name}:?\s+(\d+)", text, re.MULTILINE)
    return int(found[1]) * unit if found else default
