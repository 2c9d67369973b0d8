"""A pretend accelerator for machines without one; ``pretend.cpp`` says what it refuses."""

import ctypes
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import types
from collections import Counter
from pathlib import Path

import torch

SOURCE = Path(__file__).with_name("pretend.cpp")
TORCH = "2.13"
"""The version whose internals the source uses."""
KINDS = ("operators", "to_cpu", "to_device", "items", "waits", "cpu_scalars")
"""Names of the events that the device reports, in the order of their numbers."""
HOOK = ctypes.CFUNCTYPE(
    None, ctypes.c_int, ctypes.c_char_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int
)


def missing_requirement():
    """Return what this machine lacks to build the device, or None."""
    if sys.platform != "linux":
        return "Linux"
    if not torch.__version__.startswith(f"{TORCH}."):
        return f"torch {TORCH}, whose internals it uses"
    return None if shutil.which(compiler()) else "a C++ compiler"


def compiler():
    return os.environ.get("CXX", "c++")


def build():
    """Return the library, compiled once for each source and version of torch."""
    key = hashlib.sha256(SOURCE.read_bytes() + torch.__version__.encode()).hexdigest()[:12]
    library = Path(tempfile.gettempdir()) / f"torchrg-pretend-{os.getuid()}" / f"{key}.so"
    if not library.exists():
        from torch.utils import cpp_extension  # It takes long to load.

        library.parent.mkdir(mode=0o700, exist_ok=True)
        unfinished = library.with_suffix(f".{os.getpid()}")
        command = [compiler(), "-std=c++20", "-O0", "-fPIC", "-shared", "-w", str(SOURCE)]
        command += [f"-I{path}" for path in cpp_extension.include_paths()]
        command += [f"-L{path}" for path in cpp_extension.library_paths()]
        command += ["-lc10", "-ltorch_cpu", "-o", str(unfinished)]
        subprocess.run(command, check=True, timeout=300)
        unfinished.replace(library)
    return library


def load():
    """Register the device ``pretend`` with torch, for the rest of this process."""
    torch.ops.load_library(str(build()))
    library().pretend_register()
    torch.utils.rename_privateuse1_backend("pretend")
    module = types.ModuleType("torch.pretend")
    module.is_available = module.is_initialized = lambda: True
    module._is_in_bad_fork = lambda: False
    module.current_device = lambda: 0
    module.device_count = lambda: 1
    module.get_amp_supported_dtype = lambda: [torch.float16, torch.bfloat16]
    torch._register_device_module("pretend", module)
    torch.utils.generate_methods_for_privateuse1_backend()


def library():
    handle = ctypes.CDLL(str(build()))
    handle.pretend_peak.restype = handle.pretend_live.restype = ctypes.c_int64
    return handle


class Watch:
    """Count what a block asks of the device: copies, items, waits, operators, bytes.

    ``counts`` are by kind and name, or with ``lines`` by kind and line of torchrg; ``bytes`` by
    kind. A wait is an operator that reads values of the device before it knows its size in CUDA.
    ``peak`` is the largest number of bytes of the block on the device.
    """

    def __init__(self, *, lines=False):
        self.counts, self.bytes, self.peak = Counter(), Counter(), 0
        self._lines, self._hook = lines, HOOK(self._report)

    def __enter__(self):
        self._library = library()
        self._start = self._library.pretend_live()
        self._library.pretend_peak(1)
        self._library.pretend_hook(self._hook)
        return self

    def __exit__(self, *error):
        self._library.pretend_hook(None)
        self.peak = self._library.pretend_peak(0) - self._start

    def _report(self, kind, name, num_bytes, numel, dtype):
        self.counts[KINDS[kind], caller() if self._lines else name.decode()] += 1
        self.bytes[KINDS[kind]] += num_bytes

    def total(self, *kinds):
        return sum(number for (kind, _), number in self.counts.items() if kind in kinds)

    @property
    def round_trips(self):
        """Number of copies, items and waits."""
        return self.total("to_cpu", "to_device", "items", "waits")

    @property
    def operators(self):
        return self.total("operators")


def caller():
    """Return the innermost line of torchrg on the stack."""
    frame = sys._getframe(2)
    while frame is not None:
        _, found, path = frame.f_code.co_filename.rpartition("/torchrg/")
        if found:
            return f"{path}:{frame.f_lineno}"
        frame = frame.f_back
    return ""
