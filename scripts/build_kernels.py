"""Build hook that compiles torchrg/kernels/*.cpp; without a compiler the wheel is pure Python.

Set TORCHRG_KERNELS=0 for a pure wheel, or to a platform of WHEELS to cross-compile with ziglang,
which then becomes a build dependency. The build fails if the requested kernels cannot be compiled.
"""

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FLAGS = [
    "-O3",
    "-std=c++17",
    "-shared",
    "-fPIC",
    "-fvisibility=hidden",
    "-fno-exceptions",
    "-fno-rtti",
    "-s",
    "-Wno-psabi",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=off",
]
"""The last flag forbids fused multiply-add, so results are bit-identical on all processors."""
ZIG = "ziglang==0.17.1"
WHEELS = {
    "x86_64-linux-gnu.2.17": "manylinux_2_17_x86_64",
    "aarch64-linux-gnu.2.17": "manylinux_2_17_aarch64",
    "x86_64-linux-musl": "musllinux_1_2_x86_64",
    "aarch64-linux-musl": "musllinux_1_2_aarch64",
    "aarch64-macos.11.0": "macosx_11_0_arm64",
}
"""Wheel platform tags of ziglang targets."""
REQUESTED = os.environ.get("TORCHRG_KERNELS", "")


def find_compiler() -> tuple[list[str], str]:
    """Return the compiler command, empty without a compiler, and the wheel platform."""
    if REQUESTED in WHEELS:
        command = [sys.executable, "-m", "ziglang", "c++", "-nostdlib++", "-target", REQUESTED]
        return command, WHEELS[REQUESTED]
    system = {"Linux": "linux", "Darwin": "macosx_11_0"}.get(platform.system(), "")
    command = (os.environ.get("CXX") or "c++").split()
    if REQUESTED or not system or not shutil.which(command[0]):
        return [], ""
    oldest = ["-mmacosx-version-min=11.0"] if system != "linux" else []
    return command + oldest, f"{system}_{platform.machine()}"


class KernelsHook(BuildHookInterface[Any]):
    """Add a library for any processor and, on x86-64, one for AVX2 to the wheel."""

    def dependencies(self) -> list[str]:
        """Return build dependencies in addition to hatchling."""
        return [ZIG] if REQUESTED in WHEELS else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile in place, where editable installs also find the libraries.

        The suffix ``.library`` prevents Python from importing them as modules.
        """
        folder = Path(self.root, "torchrg", "kernels")
        for old in folder.glob("libkernels-*"):
            old.unlink()
        command, wheel = find_compiler()
        kinds = {"base": []} | ({"avx2": ["-mavx2"]} if wheel.endswith("x86_64") else {})
        libraries = {kind: folder / f"libkernels-{kind}.library" for kind in kinds}
        error = "" if command else "no C++ compiler found"
        if REQUESTED not in ("", "0", *WHEELS):
            error = f"TORCHRG_KERNELS is none of 0, {', '.join(WHEELS)}"
        with tempfile.TemporaryDirectory() as cache:
            for kind, library in libraries.items() if command else ():
                sources = map(str, sorted(folder.glob("*.cpp")))
                run = [*command, *FLAGS, *kinds[kind], *sources, "-o", str(library)]
                env = os.environ | {"ZIG_GLOBAL_CACHE_DIR": cache}
                done = subprocess.run(run, env=env, capture_output=True, text=True, check=False)
                if done.returncode:
                    error = " ".join([command[0], "fails:", *done.stderr.splitlines()[:2]])
        if not error:
            build_data |= {"pure_python": False, "tag": f"py3-none-{wheel}"}
            build_data["artifacts"] += [f"/torchrg/kernels/{x.name}" for x in libraries.values()]
            return
        for library in libraries.values():
            library.unlink(missing_ok=True)
        if REQUESTED not in ("", "0"):
            self.app.abort(f"torchrg cannot be built with the requested kernels: {error}")
        if not REQUESTED:
            self.app.display_warning(f"torchrg is built without kernels and slower: {error}")
