"""Displayed points, planes and tables of a viewer."""

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.render.test_page import described, places, room, unpacked
from torchrg.io.result import Result
from torchrg.render.content import NUM_STRATA
from torchrg.render.page import make_page
from torchrg.structures import Cloud


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
    assert [float(row["area_m2"]) for row in rows] == pytest.approx(
        [plane["area"] for plane in shown], abs=1e-4
    )
    bare = make_page(Result(Cloud(cloud.coordinates)))
    assert "table" not in {entry["name"] for entry in described(bare)["clouds"][0]["arrays"]}


def test_planes_are_drawn_with_their_polygons_or_bounding_rectangles():
    square = torch.tensor([[0.0, 0, 1], [4, 0, 1], [4, 2, 1], [0, 2, 1]])
    points = torch.cartesian_prod(torch.arange(5.0), torch.arange(3.0), torch.ones(1))
    cloud = Cloud(points.numpy() + 1e6, {"labels": np.zeros(15, dtype=np.int64)})
    bare = Result(cloud)
    origin = torch.from_numpy(1e6 - cloud.origin).float()
    traced = replace(bare, table=replace(bare.planes, outline=((square[:3] + origin,),)))
    scale = described(make_page(bare))["frame"]["scale"]
    expected = ((square - torch.tensor([2.0, 1, 1])) / scale).tolist()
    for result, corners in ((bare, expected), (traced, expected[:3])):
        (plane,) = described(make_page(result))["clouds"][0]["planes"]
        assert sorted(plane["rings"][0]) == pytest.approx(np.array(sorted(corners)), abs=1e-4)
