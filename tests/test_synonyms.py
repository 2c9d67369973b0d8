"""Names of other libraries and misspelled names lead to those here, and others to none."""

import pytest

from torchrg._synonyms import advice_on, describe_missing, nearest_name

NAMES = ["out", "up", "voxel", "threads", "normals.k", "growing.min_size", "partition.min_size"]


@pytest.mark.parametrize(
    ("word", "name"),
    [
        ("up", "up"),
        ("k", "normals.k"),
        ("min_size", "growing.min_size"),
        ("min_points", "growing.min_size"),
        ("partition.min_points", "partition.min_size"),
        ("normal.k", "normals.k"),
        ("n_neighbors", "normals.k"),
        ("n_jobs", "threads"),
        ("voxel_size", "voxel"),
        ("output", "out"),
        ("growing.min_siz", "growing.min_size"),
        ("thread", "threads"),
        ("bed", ""),
        ("gpu", ""),
        ("quiet", ""),
        ("device", ""),
        ("ups", "up"),
        ("o", ""),
    ],
)
def test_a_word_leads_to_the_name_it_stands_for(word, name):
    assert nearest_name(word, NAMES) == name


def test_words_without_a_name_have_advice():
    assert nearest_name("voxel_size", ["normals.k"]) == ""
    assert advice_on("voxel_size").startswith("pass voxel to segment_planes")
    assert "2>/dev/null" in advice_on("quiet")
    assert advice_on("growing.distance_threshold") == advice_on("distance_threshold")
    assert advice_on("shade") == ""


def test_missing_attributes_name_what_to_use():
    found = describe_missing("Plane", "polygons", {"kind": "kind", "polygon": "outline"})
    assert found == "Plane has no attribute 'polygons'; use outline."
    found = describe_missing("Cloud", "save", {})
    assert found == "Cloud has no attribute 'save'; use torchrg.write_cloud(path, cloud, seg)."
