"""How much memory a scan takes, and how much there is."""

import os
from pathlib import Path

from torchrg.pipeline import BYTES_PER_POINT, BYTES_PER_POINT_ON_DISK

PROCESS_BYTES = 400_000_000
"""Memory of a process before the first point: Python, torch, scipy."""
_CGROUP = Path("/sys/fs/cgroup")
"""Where Linux shows control groups, with which containers are limited."""
_CGROUP_FILES = (
    ("memory.max", "memory.current"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
)
"""Limit and use of a control group, of versions 2 and 1."""
_FRACTION = 0.8
"""Share of the free memory that a batch may take. The rest is for the process that starts the
others, and for what else the machine does."""


def memory_of_scan(num_points: int, *, on_disk: bool = False) -> int:
    """Return the memory that a process needs for a cloud or a depth image, in bytes.

    ``on_disk`` is for a cloud whose large arrays are on a disk.

    Example:
        >>> memory_of_scan(1_000_000), memory_of_scan(10_000_000, on_disk=True)
        (1300000000, 3900000000)
    """
    return PROCESS_BYTES + (BYTES_PER_POINT_ON_DISK if on_disk else BYTES_PER_POINT) * num_points


def spare_memory() -> int:
    """Return the bytes that a batch may take when no limit is given: a share of what is free."""
    return int(_FRACTION * available_memory())


def available_memory() -> int:
    """Return the bytes that this process and its children can still take.

    The smaller of what the machine has free and what a control group (a container) leaves.
    """
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    free = [_read_entry("/proc/meminfo", "MemAvailable", otherwise=whole)]
    for limit, used in _CGROUP_FILES:
        try:
            free.append(int((_CGROUP / limit).read_text()) - int((_CGROUP / used).read_text()))
        except (OSError, ValueError):
            continue  # No such group, or one without a limit, which is the word "max".
    return max(0, min(free))


def reset_peak_memory() -> None:
    """Start a new measurement of this process's peak memory, where the system can (Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return


def peak_memory(process: int | str = "self") -> int:
    """Return the largest resident memory of a process since its last reset, in bytes.

    Where the system does not say it (only Linux does), that of this process since its start.
    """
    import resource

    usage = resource.getrusage(resource.RUSAGE_SELF)
    return _read_entry(f"/proc/{process}/status", "VmHWM", otherwise=usage.ru_maxrss * 1024)


def _read_entry(path: str, name: str, *, otherwise: int) -> int:
    """Return an entry, in kibibytes, of a table that Linux shows as a file, in bytes."""
    try:
        lines = Path(path).read_text(encoding="ascii").splitlines()
        table = dict(line.split(":", 1) for line in lines if ":" in line)
        return int(table[name].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return otherwise
