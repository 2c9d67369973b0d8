"""The wheel and the sdist install and run without the repository."""

import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def distributions(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, REPOSITORY],
        check=True,
        capture_output=True,
    )
    return {path.suffix: path for path in folder.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".whl", ".gz"])
def test_built_package_runs_in_a_fresh_environment(distributions, tmp_path, suffix):
    environment = tmp_path / "fresh"
    venv.create(environment, with_pip=False)
    binaries = environment / ("Scripts" if os.name == "nt" else "bin")
    target = sysconfig.get_path("purelib", vars={"base": str(environment)})
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-build-isolation"]
    subprocess.run(
        [*install, "--quiet", "--target", target, str(distributions[suffix])],
        check=True,
        capture_output=True,
    )
    for asset in ("page.js", "page.html.jinja", "gallery.html.jinja"):
        assert Path(target, "torchrg", "render", asset).is_file()
    # The dependencies are those of this environment; torchrg itself must come from the package.
    folders = [folder for folder in sys.path if folder.endswith("site-packages")]
    Path(target, "dependencies.pth").write_text("\n".join(folders))
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    options = {"cwd": tmp_path, "check": True, "capture_output": True, "text": True, "env": clean}
    script = (
        "import runpy, sys, torchrg, torchrg.cli as cli\n"
        "cli.main(['sample', 'room.npz', '--num-points', '2000'])\n"
        "cli.main(['segment', 'room.npz', '--out', 'seg.npz'])\n"
        "print(torchrg.__file__)\n"
        "sys.argv[1:] = ['score', 'seg.npz', 'room.npz', '--json']\n"
        "runpy.run_module('torchrg', run_name='__main__')"
    )
    done = subprocess.run([binaries / "python", "-c", script], **options)
    assert '"f1"' in done.stdout
    assert str(target / Path("torchrg")) in done.stdout
