"""The pictures of the README: a room before, its planes, its superpoints, and the page.

    python scripts/pictures.py

``rooms.png`` and ``page.png`` beside this file are written again; the latter needs Chromium and
playwright, and stays as it is where they are missing.
"""

import dataclasses
import io
import shutil
import tempfile
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

import torchrg
from torchrg.config import PlanesConfig, SuperpointsConfig
from torchrg.render import color_planes, make_page, render_cloud, write_page
from torchrg.result import Result

FOLDER = Path(__file__).parent
NUM_POINTS = 600_000
NOISE, SEED = 0.003, 4
NUM_PARTS = 300
WIDTH = 620
"""Pixels of one of the three pictures."""
AZIMUTH_DEG = 60.0
COLORS = 128
"""Colours of the files, which keeps them small."""
PAGE = {"width": 1200, "height": 640}
_GREY = 205


def draw_rooms(path: Path) -> Result:
    """Draw a room before, with its planes, and with its superpoints; return the result."""
    room = torchrg.scenes.make_room(NUM_POINTS, noise=NOISE, seed=SEED)
    upright = dataclasses.replace(torchrg.load_config(), planes=PlanesConfig(up="z"))
    seg = torchrg.segment_planes(room.points, upright)
    parts = torchrg.make_superpoints(room.points, seg, SuperpointsConfig(counts=(NUM_PARTS,)))
    grey = torch.full((NUM_POINTS, 3), _GREY, dtype=torch.uint8)
    pictures = [
        render_cloud(
            room.points,
            colors,
            normals=seg.normals,
            labels=seg.labels,
            azimuth_deg=AZIMUTH_DEG,
            width=WIDTH,
        ).numpy()
        for colors in (
            grey,
            color_planes(seg.labels, room.points),
            color_planes(parts.labels, room.points),
        )
    ]
    _write(path, np.concatenate(pictures, axis=1))
    return Result.of(torchrg.Cloud(room.points.numpy(), source="room.ply"), seg)


def draw_page(path: Path, result: Result) -> bool:
    """Take a picture of the page of a result; return whether a browser was there."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    if chromium is None:
        return False
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        page = Path(folder) / "page.html"
        write_page(page, make_page(result, max_points=200_000))
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = driver.chromium.launch(executable_path=chromium, args=flags)
        tab = browser.new_page(viewport=PAGE)
        tab.goto(page.as_uri())
        ready = "globalThis.torchrg?.page?.ready && torchrg.state.share === 1"
        for _ in range(600):
            tab.wait_for_timeout(200)
            if tab.evaluate(ready):
                break
        tab.wait_for_timeout(2000)
        shot = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
        browser.close()
    _write(path, np.asarray(shot))
    return True


def _write(path: Path, pixels: NDArray[np.uint8]) -> None:
    image = Image.fromarray(np.ascontiguousarray(pixels)).quantize(COLORS)
    image.save(path, optimize=True)
    print(f"{path}: {image.width} x {image.height} pixels, {path.stat().st_size / 1000:.0f} kB")


def main() -> None:
    """Write both pictures."""
    result = draw_rooms(FOLDER / "rooms.png")
    if not draw_page(FOLDER / "page.png", result):
        print("page.png stays as it is: no Chromium")


if __name__ == "__main__":
    main()
