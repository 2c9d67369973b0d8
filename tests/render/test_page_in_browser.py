"""Pages in a real Chromium without a screen: what is drawn, picked, hidden, and linked."""

import csv
import io
import shutil
import time

import numpy as np
import pytest

from torchrg.io.result import Result
from torchrg.scenes import make_room
from torchrg.structures import Cloud

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)"
    ),
]
api = pytest.importorskip("playwright.sync_api", reason="needs playwright to drive Chromium")
pytest.importorskip("pydeck", reason="needs the extra view")
image = pytest.importorskip("PIL.Image", reason="needs pillow to read screenshots")

from torchrg.render.page import make_page, write_page  # noqa: E402

EVIL = "</script><img src=x onerror=alert(2)>"
SIZE = {"width": 900, "height": 500}
DEADLINE_SECONDS = 120


class Tab:
    """A page that is open, and all that it said."""

    def __init__(self, browser, path):
        self.said, self.requests = [], []
        self.page = browser.new_page(viewport=SIZE)
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("dialog", lambda dialog: self.said.append(dialog.message))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        self.wait_for(
            "globalThis.torchrg && (torchrg.page.ready || !message.hidden && "
            "!message.textContent.startsWith('Decompressing'))"
        )

    def run(self, script):
        return self.page.evaluate(script)

    def wait_for(self, condition):
        """The page's policy forbids playwright's own way of waiting, which needs eval."""
        end = time.monotonic() + DEADLINE_SECONDS
        while not self.run(condition):
            assert time.monotonic() < end, condition
            time.sleep(0.05)

    def settle(self):
        self.wait_for(
            "!torchrg.state.moving && torchrg.state.fraction === 1 && !torchrg.deck().needsRedraw()"
        )
        self.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def picture(self):
        """Return the pixels of the view, without the panel."""
        self.settle()
        box = self.run(
            "(() => { const b = view.getBoundingClientRect(); return [b.width, b.height] })()"
        )
        shot = self.page.screenshot(clip={"x": 0, "y": 0, "width": box[0], "height": box[1]})
        return np.asarray(image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


@pytest.fixture(scope="module")
def browser():
    with api.sync_playwright() as driver:
        # Software GL, so that it runs anywhere; root may not use the sandbox.
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        started = driver.chromium.launch(executable_path=CHROMIUM, args=flags)
        yield started
        started.close()


@pytest.fixture(scope="module")
def room():
    made = make_room(num_points=20_000, noise=0.003, seed=1)
    labels = np.unique(made.labels.numpy(), return_inverse=True)[1]
    fields = {"labels": labels, "normals": made.normals.numpy()}
    return Cloud(made.points.numpy(), fields, source=f"/tmp/{EVIL}.npz")


@pytest.fixture(scope="module")
def tab(browser, room, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "room.html"
    fields = dict(
        room.fields, labels=np.where(room.fields["labels"] == 0, -1, room.fields["labels"])
    )
    other = Cloud(room.coordinates, fields, source="other.npz")
    write_page(path, make_page(Result(room), compare=Result(other), title=EVIL))
    return Tab(browser, path)


@pytest.fixture(autouse=True)
def _as_it_was_opened(request):
    if "tab" not in request.fixturenames:
        return
    request.getfixturevalue("tab").run(
        """(() => {
          const wanted = { cut: true, outlines: false, normals: false };
          for (const [name, on] of Object.entries(wanted))
            if (document.getElementById(name).checked !== on) document.getElementById(name).click();
          torchrg.choose(null);
          torchrg.setMode("plane");
          showall.click();
          torchrg.home(torchrg.page.toward);
        })()"""
    )


def drawn(picture):
    """Return which pixels are neither white nor gray: those of points in planes."""
    return picture.max(axis=2) - picture.min(axis=2) > 12


def test_nothing_is_fetched_and_nothing_is_complained_about(tab):
    tab.settle()
    assert tab.said == []
    assert len(tab.requests) == 1  # The file itself.
    assert tab.run("document.querySelectorAll('img').length") == 0
    assert EVIL in tab.run("document.querySelector('h1').textContent")


def test_the_scale_bar_is_as_long_as_it_says(tab, room):
    tab.settle()
    digits, unit = tab.run("scale.innerText").split()
    points = room.coordinates.astype(np.float64)
    per_page = (points.max(axis=0) - points.min(axis=0)).max() / 10
    focal = tab.run("view.clientHeight") / 2 / np.tan(np.radians(25))
    toward, _, _, _, eye = camera_of(tab)
    distance = (eye - np.array(tab.run("torchrg.state.camera.target"))) @ toward
    width = tab.run("scale.lastChild.getBoundingClientRect().width")
    assert width == pytest.approx(float(digits) / per_page * focal / distance, rel=0.03)
    assert unit == "m"


def test_points_are_drawn_in_both_halves(tab):
    picture = tab.picture()
    half = picture.shape[1] // 2
    for side in (picture[:, :half], picture[:, half:]):
        assert drawn(side).mean() > 0.1
        assert (side == 255).all(axis=2).mean() > 0.1


def camera_of(tab):
    """Return the axes, the focal length and the place of the viewer."""
    camera = tab.run("torchrg.state.camera")
    turn, tilt = np.radians([camera["rotationOrbit"], camera["rotationX"]])
    toward = np.array([-np.sin(turn) * np.cos(tilt), -np.cos(turn) * np.cos(tilt), np.sin(tilt)])
    right = np.array([np.cos(turn), -np.sin(turn), 0])
    up = np.cross(toward, right)
    focal = tab.run("view.clientHeight") / 2 / np.tan(np.radians(25))
    eye = np.array(camera["target"]) + toward * focal / 2 ** camera["zoom"]
    return toward, right, up, focal, eye


def project(tab, points):
    """Return pixels and distance of points: a pinhole camera by its definition."""
    toward, right, up, focal, eye = camera_of(tab)
    local = points - eye
    depth = -local @ toward
    middle = np.array([tab.run("view.clientWidth") / 4, tab.run("view.clientHeight") / 2])
    pixels = middle + focal * np.stack([local @ right, -local @ up], axis=1) / depth[:, None]
    return pixels, depth


def test_picking_returns_the_plane_that_is_seen(tab, room):
    tab.run("cut.click()")
    tab.settle()
    points = room.coordinates.astype(np.float64)
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    scale = (points.max(axis=0) - points.min(axis=0)).max() / 10
    pixels, depth = project(tab, (points - middle) / scale)
    labels = room.fields["labels"]
    checked = set()
    width = tab.run("view.clientWidth") / 2
    inside = (pixels[:, 0] > 20) & (pixels[:, 0] < width - 20)
    for row in np.random.default_rng(0).permutation(inside.nonzero()[0]):
        near = np.abs(pixels - pixels[row]).max(axis=1) < 14
        front = near & (depth < depth[row] + 0.3)
        if labels[row] in checked or len(set(labels[front])) > 1:
            continue
        found = tab.run(f"torchrg.pick({pixels[row, 0]}, {pixels[row, 1]})")
        assert (found["cloud"], found["plane"]) == (0, labels[row])
        assert str(labels[row]) in tab.run("picked.textContent")
        checked.add(labels[row])
        if len(checked) == 3:
            break
    assert len(checked) == 3
    assert tab.run("torchrg.pick(3, 3)") is None


def test_a_click_picks_and_the_panel_tells(tab, room):
    tab.settle()
    tab.page.mouse.click(tab.run("view.clientWidth") / 4, tab.run("view.clientHeight") / 2)
    number = tab.run("torchrg.state.picked.plane")
    plane = tab.run(f"torchrg.page.clouds[0].planes[{number}]")
    text = tab.run("picked.innerText")
    assert f"{plane['count']:,}" in text
    assert all(word in text for word in ("equation", "area", "rms", "adjacent"))
    assert "°" in text
    boxes = "(terms) => terms.filter((term) => term.scrollWidth > term.clientWidth).length"
    assert tab.page.locator("#picked dt").evaluate_all(boxes) == 0  # No term covers its value.


def test_hiding_a_plane_and_cutting_change_the_picture(tab, room):
    open_room = tab.picture()
    before = drawn(open_room).sum()
    tab.run("torchrg.setHidden(0, torchrg.page.clouds[0].order.slice(0, 8), true)")
    assert drawn(tab.picture()).sum() < 0.9 * before
    tab.run("showall.click()")
    assert (tab.picture() == open_room).all()
    tab.run("cut.click()")
    assert (tab.picture() != open_room).any(axis=2).mean() > 0.05
    tab.run("cut.click()")
    tab.page.locator("#top").fill("70")
    assert drawn(tab.picture()).sum() < 0.9 * before
    tab.page.locator("#top").fill("0")
    tab.page.locator("#near").fill("70")
    assert drawn(tab.picture()).sum() < 0.9 * before
    tab.page.locator("#near").fill("0")


def test_kinds_of_planes_are_a_filter(tab):
    before, cloud = tab.picture(), "torchrg.page.clouds[0]"
    kinds = tab.run(f"{cloud}.planes.map((plane) => torchrg.page.kinds[plane.kind])")
    boxes, names = tab.page.locator("#kinds input"), tab.page.locator("#kinds label")
    assert {"floor", "ceiling", "wall"} <= set(kinds)
    shown = {text.strip() for text in names.all_inner_texts()}
    assert shown == {f"{name} ({kinds.count(name)})" for name in set(kinds)}
    tab.page.get_by_label("show wall planes").uncheck()
    hidden = tab.run(f"[...{cloud}.hidden]")
    assert [kinds[own] for own in hidden] == ["wall"] * kinds.count("wall")
    assert (tab.picture() != before).any()
    assert tab.run("document.activeElement.getAttribute('aria-label')") == "show wall planes"
    tab.run(f"torchrg.setHidden(0, [{hidden[0]}], false)")
    half = "(boxes) => boxes.filter((box) => box.indeterminate).length"
    assert boxes.evaluate_all(half) == 1
    tab.run("showall.click()")
    assert boxes.evaluate_all("(boxes) => boxes.every((box) => box.checked)")
    assert (tab.picture() == before).all()


def test_both_halves_are_turned_together(tab):
    def cameras():
        return np.array(tab.run("torchrg.deck().getViewports().map((v) => v.cameraPosition)"))

    tab.settle()
    before = cameras()
    x, y = tab.run("view.clientWidth") / 4, tab.run("view.clientHeight") / 2
    tab.page.mouse.move(x, y)
    tab.page.mouse.down()
    tab.page.mouse.move(x + 80, y + 20, steps=4)
    tab.page.mouse.up()
    tab.settle()
    after = cameras()
    assert len(after) == 2
    assert np.abs(after - before).max() > 0.5
    assert np.abs(after[0] - after[1]).max() < 1e-9


def test_keys_turn_zoom_and_go_from_plane_to_plane(tab):
    tab.page.locator("#view").focus()
    start = tab.run("torchrg.state.camera")
    tab.page.keyboard.press("ArrowRight")
    tab.page.keyboard.press("+")
    now = tab.run("torchrg.state.camera")
    assert now["rotationOrbit"] == pytest.approx(start["rotationOrbit"] + 5)
    assert now["zoom"] > start["zoom"]
    order = tab.run("torchrg.page.clouds[0].order")
    for expected in order[:2]:
        tab.page.keyboard.press("PageDown")
        assert tab.run("torchrg.state.picked.plane") == expected
    tab.page.keyboard.press("h")
    assert tab.run("[...torchrg.page.clouds[0].hidden]") == [order[1]]
    tab.page.keyboard.press("Escape")
    assert tab.run("torchrg.state.picked") is None


def test_colours_switch_and_outlines_and_normals_appear(tab):
    planes = tab.picture()
    tab.page.locator("#mode").select_option("normal")
    normals = tab.picture()
    assert (planes != normals).any(axis=2).mean() > 0.1
    for name in ("outlines", "normals"):
        tab.run(f"document.getElementById('{name}').click()")
        with_lines = tab.picture()
        assert (with_lines != normals).any(axis=2).mean() > 0.002
        normals = with_lines


def test_the_outline_of_a_hidden_plane_hides_with_it(tab):
    def num_black():
        return (tab.picture() == 0).all(axis=2).sum()

    before = num_black()
    tab.run("torchrg.choose({ cloud: 0, plane: torchrg.page.clouds[0].order[0] })")
    assert num_black() > before + 200
    tab.run("torchrg.setHidden(0, [torchrg.state.picked.plane], true)")
    assert num_black() <= before


def test_discs_do_not_hide_the_face_beyond_an_edge(browser, tmp_path):
    """Of a cube, pixels with the color of a face that is not theirs, by rays. Flat discs: 7 %."""
    rng = np.random.default_rng(0)
    faces = np.arange(3000) % 6
    points = rng.random((3000, 3))
    points[np.arange(3000), faces // 2] = faces % 2
    fields = {"labels": faces, "normals": np.eye(3, dtype=np.float32)[faces // 2]}
    cube = Cloud(points.astype(np.float32), fields)
    write_page(tmp_path / "cube.html", make_page(Result(cube), view="outside"))
    tab = Tab(browser, tmp_path / "cube.html")
    picture = tab.picture()
    toward, right, up, focal, eye = camera_of(tab)
    rows, columns = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
    across = (columns - picture.shape[1] / 2)[..., None] / focal * right
    rays = across - (rows - picture.shape[0] / 2)[..., None] / focal * up - toward
    low, high = (-5 - eye) / rays, (5 - eye) / rays
    axis = np.minimum(low, high).argmax(axis=2)
    is_far = np.take_along_axis(high < low, axis[..., None], axis=2)[..., 0]
    hit = np.minimum(low, high).max(axis=2) < np.maximum(low, high).min(axis=2)
    colors = np.array(tab.run("[...torchrg.page.clouds[0].values['plane colors']]")).reshape(-1, 3)
    hue, shades = (each / each.max(axis=-1, keepdims=True) for each in (picture + 1, colors[:6]))
    seen = np.square(hue[:, :, None] - shades).sum(axis=3).argmin(axis=2)
    assert (seen != 2 * axis + is_far)[hit].mean() < 0.068
    tab.page.close()


@pytest.mark.parametrize(
    ("cloud", "words"),
    [
        (Cloud(np.full((3, 3), np.nan)), "no finite point"),
        (Cloud(np.zeros((1, 3))), ""),
        (Cloud(np.random.default_rng(0).random((500, 3)).astype(np.float32)), ""),
    ],
    ids=["all NaN", "one point", "no labels"],
)
def test_odd_clouds_open(browser, tmp_path, cloud, words):
    write_page(tmp_path / "odd.html", make_page(Result(cloud)))
    tab = Tab(browser, tmp_path / "odd.html")
    assert words in tab.run("message.textContent")
    if not words:
        tab.settle()
        assert (tab.picture() < 250).any()
        assert "no plane labels" in tab.run("planes.textContent")
    assert tab.said == []
    tab.page.close()


def test_the_table_of_the_chosen_cloud_is_saved_as_csv(tab, room):
    labels = room.fields["labels"]
    for place in (0, 1):  # The second has no plane 0.
        tab.run(f"cloud.value = {place}; cloud.onchange()")
        with tab.page.expect_download() as started:
            tab.run("csv.click()")
        with started.value.path().open(newline="") as file:
            rows = list(csv.DictReader(file))
        names, counts = np.unique(labels[labels >= place], return_counts=True)
        assert [int(row["id"]) for row in rows] == names.tolist()
        assert [int(row["count"]) for row in rows] == counts.tolist()
        assert {row["kind"] for row in rows} > {"wall"}
    assert tab.said == []


def names_of_rows(tab):
    rows = "[...document.querySelectorAll('#planes tr[data-plane]')]"
    return tab.run(f"{rows}.map((row) => Number(row.dataset.plane))")


def test_the_table_is_sorted_by_its_columns(tab):
    planes = tab.run("torchrg.page.clouds[0].planes.map((p) => [p.area, p.count, p.kind])")
    areas, counts, _ = (np.array(column) for column in zip(*planes, strict=True))
    tab.run("cloud.value = 0; cloud.onchange()")
    head = tab.page.locator("#planes th button")
    assert [text.split()[0] for text in head.all_inner_texts()] == [
        *("plane", "class", "area", "points"),
    ]
    head.nth(2).click()
    assert (np.diff(areas[names_of_rows(tab)]) <= 0).all()
    assert tab.run("document.querySelector('th[aria-sort]').innerText") == "area (m²) ↓"
    tab.page.locator("#planes th button").nth(2).click()
    assert (np.diff(areas[names_of_rows(tab)]) >= 0).all()
    tab.page.locator("#planes th button").nth(0).click()
    assert names_of_rows(tab) == sorted(names_of_rows(tab))
    tab.page.locator("#planes th button").nth(3).click()
    assert (np.diff(counts[names_of_rows(tab)]) <= 0).all()
    assert tab.said == []


def test_a_minimum_area_hides_small_planes_and_leaves_them_out_of_the_csv(tab):
    areas = np.array(tab.run("torchrg.page.clouds[0].planes.map((p) => p.area)"))
    tab.run("cloud.value = 0; cloud.onchange()")
    before = drawn(tab.picture()).sum()
    tab.page.locator("#minarea").fill("4")
    large = np.flatnonzero(areas >= 4)
    assert 0 < len(large) < len(areas)
    assert sorted(names_of_rows(tab)) == large.tolist()
    assert drawn(tab.picture()).sum() < before
    with tab.page.expect_download() as started:
        tab.run("csv.click()")
    with started.value.path().open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(large)
    assert min(float(row["area_m2"]) for row in rows) >= 4
    tab.run("showall.click()")
    assert len(names_of_rows(tab)) == len(areas)
    assert tab.page.locator("#minarea").input_value() == ""


@pytest.mark.parametrize("width", [1400, 390])
def test_targets_are_large_and_nothing_overflows(tab, width):
    size = tab.page.viewport_size
    tab.page.set_viewport_size({"width": width, "height": 900})
    tab.run("cloud.value = 0; cloud.onchange()")
    small = tab.run(
        "[...document.querySelectorAll('aside :is(button, input, select)')]"  # codespell:ignore
        ".filter((e) => e.offsetParent && Math.min(e.offsetHeight, e.offsetWidth) < 24"
        " && e.type !== 'range').map((e) => e.outerHTML.slice(0, 60))"
    )
    assert small == []
    assert tab.run("document.documentElement.scrollWidth <= innerWidth")
    assert tab.run("planes.scrollWidth <= planes.clientWidth")
    tab.page.set_viewport_size(size)


def test_a_phone_shows_the_planes_without_scrolling(tab):
    size = tab.page.viewport_size
    tab.page.set_viewport_size({"width": 390, "height": 844})
    top, bottom = tab.run(
        "(() => { const b = planes.getBoundingClientRect(); return [b.top, b.bottom] })()"
    )
    assert bottom - top >= 200
    assert bottom <= 844
    tab.page.set_viewport_size(size)


def test_errors_are_in_millimeters_and_level_planes_have_no_dip_direction(tab):
    tab.run("torchrg.choose({ cloud: 0, plane: torchrg.page.clouds[0].order[0] })")
    text = tab.run("picked.innerText")
    assert "mm" in text
    level = tab.run("torchrg.page.clouds[0].planes.findIndex((p) => p.dip_direction_deg === null)")
    if level >= 0:
        tab.run(f"torchrg.choose({{ cloud: 0, plane: {level} }})")
        assert "dip direction" not in tab.run("picked.innerText")
