"""How long a page takes to write, how large it is, and how fluently a browser turns it.

    python scripts/bench_page.py 100000 1000000 10000000

Frames a second are those of requestAnimationFrame in Chromium without a screen, whose drawing is
done in software (SwiftShader) unless ``--gpu`` leaves the choice to it: with the strata that the
page chooses while it turns, and with all points.
"""

import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from playwright.sync_api import Browser, sync_playwright

from torchrg.render import make_page, write_page
from torchrg.result import Result
from torchrg.scenes import make_room
from torchrg.structures import Cloud

SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
TURN = """async (all) => {
  torchrg.state.share = 1;
  let frames = 0;
  const start = performance.now();
  while (performance.now() - start < %d) {
    if (all) torchrg.state.share = 1;
    torchrg.turn(3, 0);
    await new Promise(requestAnimationFrame);
    frames += 1;
  }
  return (1000 * frames) / (performance.now() - start);
}"""


@dataclass(frozen=True)
class Arguments:
    """Measure pages of made rooms."""

    sizes: Annotated[tuple[int, ...], tyro.conf.Positional] = (100_000, 1_000_000)
    """Points of the rooms."""
    seconds: float = 5.0
    """How long to turn each page."""
    gpu: bool = False
    """Let Chromium draw as it likes."""


def make_cloud(num_points: int) -> Cloud:
    """Return a room with its truth for a result."""
    room = make_room(num_points=num_points, noise=0.004, seed=3)
    random = np.random.default_rng(0)
    fields = {
        "labels": np.unique(room.labels.numpy(), return_inverse=True)[1],
        "normals": room.normals.numpy(),
        "curvature": (0.2 * random.random(num_points) ** 4).astype(np.float32),
        "sharp": random.random(num_points) < 0.02,
    }
    return Cloud(room.points.numpy(), fields, source=f"room of {num_points:,}")


def frames_a_second(browser: Browser, path: Path, seconds: float) -> tuple[float, float, float]:
    """Return seconds until a page is drawn, and its frames a second: of strata, of all points."""
    tab = browser.new_page(viewport={"width": 1280, "height": 800})
    begin = time.perf_counter()
    tab.goto(path.as_uri())
    while not tab.evaluate("!!globalThis.torchrg?.page.ready"):
        time.sleep(0.05)
    opened = time.perf_counter() - begin
    script = TURN % (1000 * seconds)
    rates = [tab.evaluate(f"({script})({every})") for every in ("false", "true")]
    tab.close()
    return opened, rates[0], rates[1]


def main(arguments: Arguments) -> None:
    """Measure and print one line for each size."""
    flags = ["--no-sandbox", *(() if arguments.gpu else SOFTWARE)]
    with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        print(f"Chromium {browser.version}, {'as it likes' if arguments.gpu else 'software'}")
        for num_points in arguments.sizes:
            cloud, path = make_cloud(num_points), Path(folder) / "page.html"
            begin = time.process_time()
            write_page(path, make_page(Result(cloud)))
            seconds = time.process_time() - begin
            opened, some, every = frames_a_second(browser, path, arguments.seconds)
            print(
                f"{num_points:>11,} points: written in {seconds:.1f} s of CPU, "
                f"{path.stat().st_size / 1e6:.1f} MB, drawn after {opened:.1f} s, "
                f"{some:.1f} frames a second, with all points {every:.1f}",
                flush=True,
            )
        browser.close()


if __name__ == "__main__":
    main(tyro.cli(Arguments))
