"""Pages without a browser: what is in the file, what is escaped, and what is refused."""

import base64
import functools
import gzip
import json
import re

import numpy as np
import pytest
import torch

pytest.importorskip("pydeck", reason="needs the extra view")

from torchrg.errors import ConfigError, MissingDependencyError
from torchrg.io.result import Result
from torchrg.render.page import Page, make_page
from torchrg.scenes import make_room
from torchrg.structures import Cloud

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"


def room(num_points=1600, **changes):
    made = make_room(num_points=num_points, noise=0.003, seed=1)
    labels = torch.unique(made.labels, return_inverse=True)[1]
    fields = {
        "labels": labels.numpy(),
        "normals": made.normals.numpy(),
        "curvature": np.linspace(0, 0.3, num_points, dtype=np.float32),
        "sharp": np.arange(num_points) % 7 == 0,
        "superpoint": np.arange(num_points) // 50,
        "color": np.full((num_points, 3), 90, dtype=np.uint8),
    }
    return Cloud(made.points.numpy(), {**fields, **changes}, source="room.npz")


@functools.cache
def page_of_room():
    return make_page(Result(room()))


def described(page):
    text = re.search(r'id="description">(.*?)</script>', page.html, re.DOTALL)[1]
    return json.loads(text)


def unpacked(page, place=0):
    """The arrays of a cloud, read again by other means than those of the page."""
    blob = re.search(rf'id="blob{place + 1}">(.*?)</script>', page.html, re.DOTALL)[1]
    rest, arrays = gzip.decompress(base64.b64decode(blob)), {}
    for entry in described(page)["clouds"][place]["arrays"]:
        rows, columns, width = entry["rows"], entry["columns"], entry["width"]
        size = rows * columns * width
        part, rest = np.frombuffer(rest[:size], dtype=np.uint8), rest[size:]
        words = np.ascontiguousarray(part.reshape(columns, width, rows).transpose(0, 2, 1))
        values = words.view(f"<u{width}")[..., 0]
        if entry["differences"]:
            values = values.cumsum(axis=1, dtype=values.dtype)
        arrays[entry["name"]] = values.T
    assert not rest
    return arrays


def decode_directions(codes):
    """The unit vectors of the octahedral map, as ``page.js`` decodes them."""
    x, y = (codes.astype(np.float32) / 127 - 1).T
    z = 1 - np.abs(x) - np.abs(y)
    fold = np.maximum(-z, 0)
    directions = np.stack([x - np.copysign(fold, x), y - np.copysign(fold, y), z], axis=1)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def places(page, place=0):
    """The coordinates of the points in those of the file."""
    what = described(page)
    cloud, frame = what["clouds"][place], what["frame"]
    local = unpacked(page, place)["positions"] * cloud["step"] + cloud["low"]
    return local @ np.array(frame["rotation"]) * frame["scale"] + frame["origin"]


def test_a_page_holds_every_point_where_it_is_and_what_the_file_says_of_it():
    cloud, page = room(), page_of_room()
    arrays, what = unpacked(page), described(page)
    distances = torch.cdist(
        torch.from_numpy(places(page)), torch.from_numpy(cloud.coordinates).double()
    )
    nearest, rows = distances.min(dim=1)
    assert float(nearest.max()) <= what["clouds"][0]["step"] * what["frame"]["scale"]
    assert sorted(rows.tolist()) == list(range(len(cloud)))
    for name, field in (("plane", "labels"), ("superpoint", "superpoint"), ("sharp", "sharp")):
        assert (arrays[name][:, 0] == cloud.fields[field][rows]).all()
    assert (arrays["color"] == 90).all()
    normals = decode_directions(np.ascontiguousarray(arrays["normals"]))
    assert ((normals * cloud.fields["normals"][rows]).sum(axis=1) > 0.999).all()


def test_pages_do_not_depend_on_the_order_of_the_points():
    cloud = room()
    order = np.random.default_rng(2).permutation(len(cloud))
    fields = {name: values[order] for name, values in cloud.fields.items()}
    mixed = Cloud(cloud.coordinates[order], fields, source=cloud.source)
    assert make_page(Result(mixed)).html == page_of_room().html


@pytest.mark.parametrize("factor", [1e-4, 1e3])
def test_pages_do_not_depend_on_unit_and_origin(factor):
    cloud = room()
    moved = Cloud(
        cloud.coordinates.astype(np.float64) * factor + np.array([5e6, 4e6, 100.0]) * factor,
        cloud.fields,
        source=cloud.source,
    )
    page = make_page(Result(moved))
    middle = moved.coordinates.mean(axis=0)
    found, given = (torch.from_numpy(where - middle) for where in (places(page), moved.coordinates))
    assert float(torch.cdist(found, given).amin(dim=1).max()) < 1e-3 * factor
    assert len(torch.unique((found / factor).round(decimals=3), dim=0)) > 1500
    first, second = described(page_of_room()), described(page)
    assert second["toward"] == pytest.approx(first["toward"], abs=0.01)
    planes = zip(first["clouds"][0]["planes"], second["clouds"][0]["planes"], strict=True)
    for one, other in planes:
        assert other["count"] == one["count"]
        if one["count"] < 50:  # Where cells of a grid begin decides the area of few points.
            continue
        assert other["area"] == pytest.approx(one["area"] * factor**2, rel=0.02)
        own = moved.coordinates[cloud.fields["labels"] == one["name"]]
        residuals = own @ other["normal"] - other["offset"]
        assert np.abs(residuals).max() < 0.05 * factor


def test_what_the_same_planes_have_beside_each_other_is_one_colour():
    cloud = room()
    other = room(labels=cloud.fields["labels"].max() - cloud.fields["labels"])
    page = make_page(Result(cloud), compare=Result(other))
    first, second = (unpacked(page, place)["plane colors"] for place in (0, 1))
    assert (first[:-1] == second[:-1][::-1]).all()


def test_nothing_from_a_file_is_markup():
    cloud = Cloud(np.eye(3), {"labels": np.array([0, 0, -1])}, source=f"/tmp/{EVIL}.npz")
    html = make_page(Result(cloud), title=EVIL).html
    assert EVIL not in html
    assert html.count("<script") == html.count("</script>") == 1 + 2 + 1
    assert "onerror=alert" not in re.sub(r"&lt;.*?&gt;", "", re.sub(r"\\u003c.*?\\u003e", "", html))


def test_the_policy_allows_no_network_and_only_our_scripts():
    html = page_of_room().html
    policy = re.search(r'Content-Security-Policy" content="(.*?)"', html)[1]
    assert "default-src 'none'" in policy
    assert "connect-src" not in policy
    scripts = re.search(r"script-src ([^;]*)", policy)[1].split()
    assert len(scripts) == 2
    assert all(script.startswith("'sha256-") for script in scripts)
    assert not re.search(r'(src|href)\s*=\s*["\']?(https?:)?//', html)


@pytest.mark.parametrize(
    "cloud",
    [
        Cloud(np.zeros((1, 3), np.float32)),
        Cloud(np.full((5, 3), np.nan, np.float32), {"labels": np.zeros(5, np.int64)}),
        Cloud(np.array([[0, 0, 0], [np.inf, 0, 0], [1, 1, 1.0]]), {"labels": np.array([0, 0, 0])}),
        Cloud(np.ones((50, 3)), {"labels": np.zeros(50, np.int64)}),
        Cloud(np.eye(3), {"labels": np.array([-1, -1, -1])}),
        Cloud(np.random.default_rng(0).random((40, 3)), {"labels": np.arange(40) * 10**9}),
        Cloud(np.eye(3), {"normals": np.full((3, 3), np.nan), "curvature": np.full(3, np.nan)}),
        Cloud(np.eye(3), {"labels": np.eye(3), "color": np.eye(3), "sharp": np.array(["a"] * 3)}),
    ],
    ids=[
        "one-point",
        "all-NaN",
        "Inf",
        "one-place",
        "no-plane",
        "huge-labels",
        "NaN-fields",
        "other-fields",
    ],
)
def test_odd_clouds_give_a_page(cloud):
    page = make_page(Result(cloud))
    assert page.num_points == (int(cloud.finite.sum()),)
    assert described(page)["clouds"][0]["count"] == len(cloud)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_points": 0}, "expected max_points >= 1"),
        ({"up": (0, 0, 0)}, "expected up to be a direction"),
        ({"view": "inside"}, "expected view to be one of"),
        ({"color": "height"}, "expected one of plane"),
        ({"color": "error"}, "expected labels and ground truth for color='error'"),
        ({"ground_truth": Cloud(np.eye(3))}, "expected ground truth for 1,600 points, got 3"),
    ],
)
def test_wrong_settings_are_refused_in_one_line(settings, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        make_page(Result(room()), **settings)


def test_missing_package_is_told_with_its_repair(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pydeck", None)
    with pytest.raises(MissingDependencyError, match=re.escape("pip install 'torchrg[view]'")):
        make_page(Result(room()))


def test_view_writes_a_page(tmp_path, run):
    path, out = tmp_path / "room.npz", tmp_path / "room.html"
    np.savez(path, points=room().coordinates, **room().fields)
    flags = ("--out", out, "--compare", path, "--unit", "m")
    assert "1,600 and 1,600 points" in run("view", path, *flags).out
    what = described(Page(out.read_text(), ()))
    assert len(what["clouds"]) == 2
    assert what["unit"] == "m"
    assert described(page_of_room())["unit"] == "m"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--out", "no/page.html"], "not found; create it first"),
        (["--out", "page.pdf"], "expected a file ending in .png or .html"),
        (["--out", "page.png", "--ground-truth", "room.npz"], "with a viewer"),
        (
            ["--out", "page.html", "--ground-truth", "few.npz"],
            "expected ground truth for 300 points, got 3",
        ),
        (["--out", "page.html", "--color", "sharp"], "expected sharp for color="),
        (["--out", "page.html", "--compare", "gone.npz"], "file not found"),
        (["--out", "page.html", "--max-points", "0"], "expected max_points >= 1"),
    ],
)
def test_view_refuses_in_one_line(tmp_path, monkeypatch, run, arguments, message):
    monkeypatch.chdir(tmp_path)
    np.savez("room.npz", points=np.random.default_rng(0).random((300, 3)))
    np.savez("few.npz", points=np.eye(3))
    done = run("view", "room.npz", *arguments)
    assert done.code == 2
    assert message in done.error
    assert not list(tmp_path.glob("page.*"))
