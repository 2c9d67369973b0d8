"""The pictures of the README: a scan, its planes and its superpoints, and the page.

    python scripts/pictures.py 1.png 1_depth.png

``rooms.png`` and ``page.png`` beside this file are written again; the latter needs Chromium and
playwright, and stays as it is where they are missing. The frame, of a desk at the Technical
University of Munich, is in the folder ch7 of https://github.com/gaoxiang12/slambook2; where it is
from dataclasses import replace
from and its licence are in ``LICENSE.rooms`` beside this file.
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
from torchrg.depth import depth_to_points, make_intrinsics, segment_depth
from torchrg.render import color_planes, make_page, render_cloud, write_page
from torchrg.result import Result

FOLDER = Path(__file__).parent
CAMERA, DEPTH_SCALE = (520.9, 521.0, 325.1, 249.7), 5000.0
"""Focal lengths and principal point in pixels, and the stored value of a metre."""
MAX_DEPTH = 2.6
"""In metres. Farther away the steps of a Kinect's depth are wider than things on a desk."""
NUM_PARTS = 120
WIDTH = 620
"""Pixels of one of the three pictures."""
CAPTION, LINE = 34, 56
"""Pixels of the letters of a caption, and of its line, to be read at a fifth of the size as well.
"""
COLORS = 160
"""Colours of the files, which keeps them small."""
NUM_POINTS, NOISE, SEED = 600_000, 0.003, 4
"""The room of the page."""
PAGE = {"width": 1360, "height": 960}


def draw_frame(path: Path, color: Path, depth: Path) -> None:
    """Draw the points of a frame, its planes, and its superpoints, each above its caption."""
    image = torch.from_numpy(np.array(Image.open(depth)).astype(np.float32)) / DEPTH_SCALE
    image[image > MAX_DEPTH] = 0
    intrinsics = make_intrinsics(*CAMERA)
    points = depth_to_points(image[None], intrinsics[None])[0].flatten(0, 1)
    found = segment_depth(image, intrinsics)
    seg = dataclasses.replace(
        found,
        **{
            name: getattr(found, name).flatten(0, 1)
            for name in ("labels", "normals", "curvature", "sharp", "valid")
        },
    )
    own = torch.from_numpy(np.array(Image.open(color).convert("RGB"))).flatten(0, 1)
    config = SuperpointsConfig(counts=(NUM_PARTS,))
    parts = torchrg.make_superpoints(points, seg, config, colors=own).labels
    panels = {
        "points": own,
        f"{len(seg.planes)} planes": color_planes(seg.labels, points),
        f"{int(parts.amax()) + 1} superpoints": color_planes(parts, points),
    }
    pictures = [
        render_cloud(points, colors, normals=seg.normals, view="sensor", width=WIDTH).numpy()
        for colors in panels.values()
    ]
    drawn = Image.fromarray(np.concatenate(pictures, axis=1))
    captioned = Image.new("RGB", (drawn.width, drawn.height + LINE), "white")
    captioned.paste(drawn)
    write, font = ImageDraw.Draw(captioned), ImageFont.load_default(CAPTION)
    for place, caption in enumerate(panels):
        middle = (place + 0.5) * WIDTH, drawn.height + LINE / 2
        write.text(middle, caption, fill="#1c2430", font=font, anchor="mm")
    _save(path, captioned)


def segment_room() -> Result:
    """Make a room, and find its planes."""
    room = torchrg.scenes.make_room(NUM_POINTS, noise=NOISE, seed=SEED)
    upright = dataclasses.replace(torchrg.load_config(), planes=PlanesConfig(up="z"))
    seg = torchrg.segment_planes(room.points, upright)
    return Result.of(torchrg.Cloud(room.points.numpy(), source="room.ply"), seg)


def draw_page(path: Path, result: Result) -> bool:
    """Take a picture of the page of a result; return whether a browser was there."""
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
        ready = "globalThis.torchrg?.page?.ready && torchrg.state.share === 1"
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
    """Write both pictures."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("color", type=Path, help="color image of a frame of a depth camera")
    parser.add_argument("depth", type=Path, help="its depth image, of 16 bits")
    frame = parser.parse_args()
    draw_frame(FOLDER / "rooms.png", frame.color, frame.depth)
    if not draw_page(FOLDER / "page.png", segment_room()):
        print("page.png stays as it is: no Chromium")


if __name__ == "__main__":
    main()
