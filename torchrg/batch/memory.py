"""Memory needed by a scan, and available memory."""

import os
from pathlib import Path

PROCESS_BYTES = 400_000_000
"""Memory of a process without points: Python, torch, scipy."""
_BYTES_PER_POINT = {(False, False): 500, (True, False): 1000, (False, True): 350, (True, True): 600}
"""Peak memory per point or pixel with any preset, by whether there are superpoints and whether the
large arrays are on disk."""
_CGROUP = Path("/sys/fs/cgroup")
"""Linux control groups, which limit containers."""
_CGROUP_FILES = (
    ("memory.max", "memory.current"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
)
"""Limit and usage of a control group, in versions 2 and 1."""
_MEMORY_FRACTION = 0.8
"""Fraction of the available memory for a batch; the remainder is for the parent process and other
programs."""


def scan_memory(num_points: int, *, superpoints: bool = False, on_disk: bool = False) -> int:
    """Return the memory that a process needs for a cloud or a depth image, in bytes.

    ``superpoints``: the cloud is also partitioned; ``on_disk``: large arrays are spilled to disk.

    Example:
        >>> scan_memory(1_000_000), scan_memory(10_000_000, on_disk=True)
        (900000000, 3900000000)
    """
    return PROCESS_BYTES + _BYTES_PER_POINT[superpoints, on_disk] * num_points


def spare_memory() -> int:
    """Return the default memory limit of a batch in bytes, a fraction of the available memory."""
    return int(_MEMORY_FRACTION * available_memory())


def available_memory() -> int:
    """Return the bytes that this process and its children can still allocate.

    It is the smaller of the machine's available memory and the remainder of a control group limit.
    """
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    free = [_read_entry("/proc/meminfo", "MemAvailable", default=total)]
    for limit, used in _CGROUP_FILES:
        try:
            free.append(int((_CGROUP / limit).read_text()) - int((_CGROUP / used).read_text()))
        except (OSError, ValueError):
            continue  # No such group, or no limit, which is the word "max".
    return max(0, min(free))


def reset_peak_memory() -> None:
    """Reset the peak memory of this process, if the system supports it (Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return


def peak_memory(process: int | str = "self") -> int:
    """Return the largest resident memory of a process since its last reset, in bytes.

    Except on Linux, it is the peak of this process since its start.
    """
    import resource

    usage = resource.getrusage(resource.RUSAGE_SELF)
    return _read_entry(f"/proc/{process}/status", "VmHWM", default=usage.ru_maxrss * 1024)


def _read_entry(path: str, name: str, *, default: int) -> int:
    """Return an entry of a Linux status file (in kibibytes), in bytes."""
    try:
        lines = Path(path).read_text(encoding="ascii").splitlines()
        table = dict(line.split(":", 1) for line in lines if ":" in line)
        return int(table[name].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return default
