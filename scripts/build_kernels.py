"""Compiles torchrg/kernels/*.cpp while a wheel is built; without a compiler the wheel is pure.

The variable TORCHRG_KERNELS asks for something else: 0 for a pure wheel, and a platform of WHEELS
for the kernels of that one, compiled by ziglang, which the build then depends on. Where what it
asks for cannot be had, the build fails.
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
"""The last keeps products and sums apart, so that the bits are the same on every processor."""
ZIG = "ziglang==0.17.1"
WHEELS = {
    "x86_64-linux-gnu.2.17": "manylinux_2_17_x86_64",
    "aarch64-linux-gnu.2.17": "manylinux_2_17_aarch64",
    "x86_64-linux-musl": "musllinux_1_2_x86_64",
    "aarch64-linux-musl": "musllinux_1_2_aarch64",
    "aarch64-macos.11.0": "macosx_11_0_arm64",
}
"""What wheels call the platforms that ziglang compiles for."""
ASKED = os.environ.get("TORCHRG_KERNELS", "")


def find_compiler() -> tuple[list[str], str]:
    """Return the command that compiles, empty if there is none, and the platform of the wheel."""
    if ASKED in WHEELS:
        command = [sys.executable, "-m", "ziglang", "c++", "-nostdlib++", "-target", ASKED]
        return command, WHEELS[ASKED]
    system = {"Linux": "linux", "Darwin": "macosx_11_0"}.get(platform.system(), "")
    command = (os.environ.get("CXX") or "c++").split()
    if ASKED or not system or not shutil.which(command[0]):
        return [], ""
    oldest = ["-mmacosx-version-min=11.0"] if system != "linux" else []
    return command + oldest, f"{system}_{platform.machine()}"


class KernelsHook(BuildHookInterface[Any]):
    """Puts a library for any processor, and on x86-64 one for those with AVX2, into the wheel."""

    def dependencies(self) -> list[str]:
        """Return what the build needs beside hatchling."""
        return [ZIG] if ASKED in WHEELS else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile in place, where an editable install looks too.

        With their usual names Python would take the libraries for modules.
        """
        folder = Path(self.root, "torchrg", "kernels")
        for old in folder.glob("libkernels-*"):
            old.unlink()
        command, wheel = find_compiler()
        kinds = {"base": []} | ({"avx2": ["-mavx2"]} if wheel.endswith("x86_64") else {})
        libraries = {kind: folder / f"libkernels-{kind}.library" for kind in kinds}
        error = "" if command else "there is no C++ compiler"
        if ASKED not in ("", "0", *WHEELS):
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
        if ASKED not in ("", "0"):
            self.app.abort(f"torchrg cannot be built with the kernels asked for: {error}")
        if not ASKED:
            self.app.display_warning(f"torchrg is built without kernels and slower: {error}")
