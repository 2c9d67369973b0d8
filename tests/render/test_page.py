"""Pages without a browser: what is in the file, what is escaped, and what is refused."""

import base64
import csv
import functools
import gzip
import io
import json
import re

import numpy as np
import pytest
import torch

pytest.importorskip("pydeck", reason="needs the extra view")

from torchrg.errors import ConfigError, MissingDependencyError
from torchrg.render import color_curvature, color_normals, color_planes, color_sharp
from torchrg.render.channels import decode_directions, encode_directions
from torchrg.render.content import NUM_STRATA
from torchrg.render.page import Page, make_page
from torchrg.result import Result
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


def test_a_sample_is_stated_and_strata_are_spread_evenly():
    page = make_page(Result(room(4000)), max_points=800)
    cloud = described(page)["clouds"][0]
    assert page.num_points == (800,)
    assert (cloud["count"], cloud["shown"], cloud["levels"][-1]) == (4000, 800, 800)
    assert cloud["levels"][0] == 800 / NUM_STRATA
    assert sum(plane["count"] for plane in cloud["planes"]) == 4000
    whole = places(make_page(Result(room(4000))))
    first = whole[: 4000 // NUM_STRATA]
    error = whole.std(axis=0) / np.sqrt(len(first))
    assert (np.abs(first.mean(axis=0) - whole.mean(axis=0)) < 4 * error).all()


def test_what_the_same_planes_have_beside_each_other_is_one_colour():
    cloud = room()
    other = room(labels=cloud.fields["labels"].max() - cloud.fields["labels"])
    page = make_page(Result(cloud), compare=Result(other))
    first, second = (unpacked(page, place)["plane colors"] for place in (0, 1))
    assert (first[:-1] == second[:-1][::-1]).all()


@pytest.mark.parametrize("mode", ["plane", "superpoint", "normal", "curvature", "sharp"])
def test_colours_are_those_of_pictures(mode):
    """Of a sample of the points, with another axis up, as far as the page's numbers are as fine."""
    cloud = room()
    fields = {name: torch.from_numpy(values) for name, values in cloud.fields.items()}
    colors = {
        "plane": color_planes(fields["labels"], cloud.points),
        "superpoint": color_planes(fields["superpoint"], cloud.points),
        "normal": color_normals(fields["normals"], up=(0.0, 1.0, 0.0)),
        "curvature": color_curvature(fields["curvature"]),
        "sharp": color_sharp(fields["sharp"]),
    }[mode]
    page = make_page(Result(cloud), max_points=700, up=(0.0, 1.0, 0.0))
    arrays, found = unpacked(page), places(page)
    rows = [np.abs(cloud.coordinates - place).max(axis=1).argmin() for place in found]
    shown = arrays[f"{mode} colors"][arrays[mode][:, 0]]
    differences = np.abs(shown.astype(int) - colors[rows].numpy())
    assert differences.max() <= (12 if mode in ("normal", "curvature") else 0)


def test_errors_are_shown_against_a_truth():
    cloud = room()
    wrong = cloud.fields["labels"].copy()
    wrong[:100] = -1
    page = make_page(Result(room(labels=wrong)), ground_truth=cloud, color="error")
    assert described(page)["mode"] == "error"
    assert (unpacked(page)["error"] == 3).sum() == 100
    assert (unpacked(page)["normal-error"] == 0).all()


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


def test_directions_survive_two_bytes():
    directions = torch.randn(2000, 3, generator=torch.Generator().manual_seed(0))
    directions = torch.nn.functional.normalize(directions, dim=1)
    found = decode_directions(encode_directions(directions))
    cosines = (found * directions.numpy()).sum(axis=1)
    assert np.degrees(np.arccos(cosines.clip(-1, 1))).max() < 1.0


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


def test_walls_of_an_open_scan_are_cut_away_from_outside_alone():
    """A floor, and two walls with a gap between them: nothing closes the cloud."""
    rng = np.random.default_rng(0)
    flat = rng.random((3, 900, 2)) * 4
    zero = np.zeros(900)
    floor = np.stack([flat[0, :, 0], flat[0, :, 1], zero], axis=1)
    west = np.stack([zero, flat[1, :, 0], flat[1, :, 1] / 2], axis=1)
    middle = np.stack([zero + 2, flat[2, :, 0], flat[2, :, 1] / 2], axis=1)
    cloud = Cloud(np.concatenate([floor, west, middle]), {"labels": np.repeat([0, 1, 2], 900)})
    what = described(make_page(Result(cloud)))["clouds"][0]
    outward = [
        [where for bit, where in enumerate(what["surfaces"]) if plane["sides"] >> bit & 1]
        for plane in what["planes"]
    ]
    assert outward[0] in ([], [pytest.approx([0, 0, -1], abs=0.01)])  # Seen from below, if at all.
    assert outward[1] == [pytest.approx([-1, 0, 0], abs=0.01)]
    assert outward[2] == []


def test_points_are_as_large_as_the_space_around_them():
    rng = np.random.default_rng(0)
    dense, sparse = rng.random((4000, 3)), rng.random((4000, 3)) * 2 + 5
    dense[:, 2] = sparse[:, 2] = 0
    points = np.concatenate([dense, sparse])
    page = make_page(Result(Cloud(points)))
    radii = unpacked(page)["radii"][:, 0]
    is_sparse = places(page)[:, 0] > 3
    octaves = (np.median(radii[is_sparse]) - np.median(radii[~is_sparse])) / 16
    assert octaves == pytest.approx(1, abs=0.25)
    unlabeled = make_page(Result(Cloud(points, {"labels": np.full(8000, -1)})))
    assert unpacked(unlabeled)["radii"].max() <= 128


def test_the_table_as_csv_names_planes_as_the_file_does():
    cloud = room()
    labels = np.where(cloud.fields["labels"] >= 0, cloud.fields["labels"] * 3 + 4, -1)
    page = make_page(Result(Cloud(cloud.coordinates, {**cloud.fields, "labels": labels})))
    text = unpacked(page)["table"].astype(np.uint8).tobytes().decode()
    rows = list(csv.DictReader(io.StringIO(text)))
    names, counts = np.unique(labels[labels >= 0], return_counts=True)
    assert [int(row["id"]) for row in rows] == names.tolist()
    assert [int(row["count"]) for row in rows] == counts.tolist()
    shown = described(page)["clouds"][0]["planes"]
    assert [float(row["area"]) for row in rows] == [plane["area"] for plane in shown]
    bare = make_page(Result(Cloud(cloud.coordinates)))
    assert "table" not in {entry["name"] for entry in described(bare)["clouds"][0]["arrays"]}
