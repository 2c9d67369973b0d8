"""The build takes the kernels that it can have, and fails where others were asked for."""

import pytest

pytest.importorskip("hatchling", reason="needs the extra dev")
import build_kernels
from hatchling.bridge.app import Application

AARCH64 = "aarch64-linux-gnu.2.17"


@pytest.fixture
def build(tmp_path, monkeypatch):
    """``build(asked, compiler)``: what the hook makes of a folder with an old library."""
    folder = tmp_path / "torchrg" / "kernels"
    folder.mkdir(parents=True)

    def run(asked, compiler):
        (folder / "libkernels-base.library").touch()
        monkeypatch.setattr(build_kernels, "REQUESTED", asked)
        monkeypatch.setattr(build_kernels.sys, "executable", compiler)
        monkeypatch.setenv("CXX", compiler)
        app = Application().get_safe_application()
        hook = build_kernels.KernelsHook(str(tmp_path), {}, None, None, "", "wheel", app)
        made = {"artifacts": []}
        try:
            hook.initialize("standard", made)
        finally:
            made["left"] = list(folder.iterdir())
        return made

    return run


@pytest.mark.parametrize("compiler", ["false", "no-such-compiler"])
def test_without_a_compiler_the_wheel_is_pure_and_says_why(build, compiler, capfd):
    assert build("", compiler) == {"artifacts": [], "left": []}
    assert "built without kernels and slower" in capfd.readouterr().err


def test_no_kernels_are_no_fault_where_none_were_asked_for(build, capfd):
    assert build("0", "true") == {"artifacts": [], "left": []}
    assert not capfd.readouterr().err


@pytest.mark.parametrize(
    ("asked", "fault"), [(AARCH64, "false fails"), ("mips-linux-gnu", "is none of 0, x86_64")]
)
def test_kernels_that_were_asked_for_and_cannot_be_had_end_the_build(build, asked, fault, capfd):
    with pytest.raises(SystemExit, match="1"):
        build(asked, "false")
    assert fault in capfd.readouterr().err


def test_the_wheel_is_named_after_the_platform_that_was_asked_for(build):
    made = build(AARCH64, "true")
    assert made["tag"] == "py3-none-manylinux_2_17_aarch64"
    assert made["artifacts"] == ["/torchrg/kernels/libkernels-base.library"]
    assert not made["pure_python"]
