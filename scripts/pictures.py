"""README images: a scan with its planes and superpoints, and the viewer.

    python scripts/pictures.py room_scan1.pcd

Writes ``rooms.png`` and ``page.png`` next to this file; the latter needs Chromium and playwright,
and is unchanged without them. The scan shows an office, from the folder tutorials of
https://github.com/PointCloudLibrary/data; see ``LICENSE.rooms`` for its license.
"""

import argparse
import dataclasses
import io
import shutil
import tempfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

import torchrg
from torchrg.config import PlanesConfig, SuperpointsConfig
from torchrg.io.result import Result
from torchrg.render import color_planes, make_page, render_cloud, write_page

FOLDER = Path(__file__).parent
OUTSIDE, MARGIN = 0.02, 0.1
"""Fraction of the points beyond the room on each side, seen through windows and the door, and
space around the others in meters. Only the drawing leaves them out."""
ELEVATION_DEG = 50
GRAY = 150
"""Brightness of points without a plane; the scan has no colors."""
NUM_PARTS = 300
WIDTH = 620
"""Width of each of the three panels, in pixels."""
CAPTION, LINE = 34, 56
"""Font size and line height of captions in pixels, legible at a fifth of the size."""
COLORS = 160
"""Number of palette colors, for small files."""
NUM_POINTS, NOISE, SEED = 600_000, 0.003, 4
"""Synthetic room in the viewer."""
PAGE = {"width": 1360, "height": 960}


def draw_scan(path: Path, scan: Path) -> None:
    """Render the points, planes and superpoints of a scan with captions."""
    cloud = torchrg.read_cloud(scan)
    points = torch.as_tensor(cloud.points)
    seg = torchrg.segment_planes(cloud, keep_neighbors=True)
    parts = torchrg.make_superpoints(points, seg, SuperpointsConfig(counts=(NUM_PARTS,))).labels
    panels = {
        "points": torch.full((len(points), 3), GRAY, dtype=torch.uint8),
        f"{len(seg.planes)} planes": color_planes(seg.labels, points),
        f"{int(parts.amax()) + 1} superpoints": color_planes(parts, points),
    }
    floor = points[:, :2].double()
    low, high = floor.quantile(torch.tensor([OUTSIDE, 1 - OUTSIDE]).double(), dim=0)
    shown = ((floor >= low - MARGIN) & (floor <= high + MARGIN)).all(dim=1)
    options = {"normals": seg.normals[shown], "labels": seg.labels[shown], "width": WIDTH}
    pictures = [
        render_cloud(points[shown], colors[shown], elevation_deg=ELEVATION_DEG, **options).numpy()
        for colors in panels.values()
    ]
    drawn = Image.fromarray(np.concatenate(pictures, axis=1))
    captioned = Image.new("RGB", (drawn.width, drawn.height + LINE), "white")
    captioned.paste(drawn)
    write, font = ImageDraw.Draw(captioned), ImageFont.load_default(CAPTION)
    for index, caption in enumerate(panels):
        middle = (index + 0.5) * WIDTH, drawn.height + LINE / 2
        write.text(middle, caption, fill="#1c2430", font=font, anchor="mm")
    _save(path, captioned)


def segment_room() -> Result:
    """Generate a room and segment it."""
    room = torchrg.scenes.make_room(NUM_POINTS, noise=NOISE, seed=SEED)
    upright = dataclasses.replace(torchrg.load_config(), planes=PlanesConfig(up="z"))
    seg = torchrg.segment_planes(room.points, upright)
    return Result.from_segmentation(torchrg.Cloud(room.points.numpy(), source="room.ply"), seg)


def draw_page(path: Path, result: Result) -> bool:
    """Take a screenshot of the viewer of a result; return False without a browser."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    if chromium is None:
        return False
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        page = Path(folder) / "page.html"
        write_page(page, make_page(result, unit="m", max_points=200_000))
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = driver.chromium.launch(executable_path=chromium, args=flags)
        tab = browser.new_page(viewport=PAGE)
        tab.goto(page.as_uri())
        ready = "globalThis.torchrg?.page?.ready && torchrg.state.fraction === 1"
        for _ in range(600):
            tab.wait_for_timeout(200)
            if tab.evaluate(ready):
                break
        tab.wait_for_timeout(2000)
        shot = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
        browser.close()
    _save(path, shot)
    return True


def _save(path: Path, image: Image.Image) -> None:
    image.quantize(COLORS).save(path, optimize=True)
    print(f"{path}: {image.width} x {image.height} pixels, {path.stat().st_size / 1000:.0f} kB")


def main() -> None:
    """Write both images."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scan", type=Path, help="scan of a room")
    draw_scan(FOLDER / "rooms.png", parser.parse_args().scan)
    if not draw_page(FOLDER / "page.png", segment_room()):
        print("page.png unchanged: Chromium not found")


if __name__ == "__main__":
    main()
