"""How long a page takes to write, how large it is, and how fluently a browser turns it.

Frames a second are those of requestAnimationFrame in Chromium without a screen, whose drawing is
done in software (SwiftShader) unless ``--gpu`` leaves the choice to it: with the strata that the
page chooses while it turns, and with all points. Without Playwright and a Chromium on the path the
page is only written.

    python scripts/bench.py page --sizes 100000 1000000 10000000
"""

import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from benchmarks.harness import Benchmark, Figures
from torchrg.render import make_page, write_page
from torchrg.result import Result
from torchrg.scenes import make_room
from torchrg.structures import Cloud

SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Flags of Chromium."""
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
"""Turns a page for some milliseconds."""


@dataclass(frozen=True)
class Case(Benchmark):
    sizes: tuple[int, ...] = (100_000, 1_000_000)
    """Points of the rooms."""
    seconds: float = 5.0
    """How long to turn each page."""
    gpu: bool = False
    """Let Chromium draw as it likes."""

    def clouds(self) -> Mapping[str, Callable[[], Cloud]]:
        return {f"{size:,} points": partial(_make_cloud, size) for size in self.sizes}

    def contenders(self) -> Mapping[str, Callable[[Cloud], Figures]]:
        has_browser = find_spec("playwright") and shutil.which("chromium")
        return {"written": _write, **({"in Chromium": self._turn} if has_browser else {})}

    def _turn(self, cloud: Cloud) -> Figures:
        from playwright.sync_api import sync_playwright

        flags = ["--no-sandbox", *(() if self.gpu else SOFTWARE)]
        with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "page.html"
            write_page(path, make_page(Result(cloud)))
            browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
            tab = browser.new_page(viewport={"width": 1280, "height": 800})
            begin = time.perf_counter()
            tab.goto(path.as_uri())
            while not tab.evaluate("!!globalThis.torchrg?.page.ready"):
                time.sleep(0.05)
            opened = time.perf_counter() - begin
            script = TURN % (1000 * self.seconds)
            some, every = (tab.evaluate(f"({script})({points})") for points in ("false", "true"))
            version = browser.version
            browser.close()
        return {
            "Chromium": version,
            "drawn after, s": opened,
            "frames a second": some,
            "with all points": every,
        }


def _make_cloud(num_points: int) -> Cloud:
    room = make_room(num_points=num_points, noise=0.004, seed=3)
    random = np.random.default_rng(0)
    fields = {
        "labels": np.unique(room.labels.numpy(), return_inverse=True)[1],
        "normals": room.normals.numpy(),
        "curvature": (0.2 * random.random(num_points) ** 4).astype(np.float32),
        "sharp": random.random(num_points) < 0.02,
    }
    return Cloud(room.points.numpy(), fields, source=f"room of {num_points:,}")


def _write(cloud: Cloud) -> Figures:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.html"
        begin = time.process_time()
        write_page(path, make_page(Result(cloud)))
        seconds = time.process_time() - begin
        return {"CPU seconds": seconds, "MB": path.stat().st_size / 1e6}
