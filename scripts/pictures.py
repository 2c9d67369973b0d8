"""README images: a scan with its planes and superpoints, and the viewer.

    python scripts/pictures.py 1.png 1_depth.png

Writes ``rooms.png`` and ``page.png`` next to this file; the latter needs Chromium and playwright,
and is unchanged without them. The frame shows a desk at the Technical University of Munich, from
the folder ch7 of https://github.com/gaoxiang12/slambook2; see ``LICENSE.rooms`` for its license.
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
from torchrg.io.result import Result
from torchrg.render import color_planes, make_page, render_cloud, write_page

FOLDER = Path(__file__).parent
CAMERA, DEPTH_SCALE = (520.9, 521.0, 325.1, 249.7), 5000.0
"""Focal lengths and principal point in pixels, and depth units per meter."""
MAX_DEPTH = 2.6
"""Maximum depth, in meters. Beyond it, Kinect depth steps are larger than objects on a desk."""
NUM_PARTS = 120
WIDTH = 620
"""Width of each of the three panels, in pixels."""
CAPTION, LINE = 34, 56
"""Font size and line height of captions in pixels, legible at a fifth of the size."""
COLORS = 160
"""Number of palette colors, for small files."""
NUM_POINTS, NOISE, SEED = 600_000, 0.003, 4
"""Synthetic room in the viewer."""
PAGE = {"width": 1360, "height": 960}


def draw_frame(path: Path, color: Path, depth: Path) -> None:
    """Render the points, planes and superpoints of a frame with captions."""
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
    rgb = torch.from_numpy(np.array(Image.open(color).convert("RGB"))).flatten(0, 1)
    config = SuperpointsConfig(counts=(NUM_PARTS,))
    parts = torchrg.make_superpoints(points, seg, config, colors=rgb).labels
    panels = {
        "points": rgb,
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
    parser.add_argument("color", type=Path, help="color image of a frame of a depth camera")
    parser.add_argument("depth", type=Path, help="its 16-bit depth image")
    frame = parser.parse_args()
    draw_frame(FOLDER / "rooms.png", frame.color, frame.depth)
    if not draw_page(FOLDER / "page.png", segment_room()):
        print("page.png unchanged: Chromium not found")


if __name__ == "__main__":
    main()
