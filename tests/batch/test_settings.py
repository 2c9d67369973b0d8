"""Settings for kinds of data: what they change, and files that name a base."""

import pytest

from torchrg.config import load_config
from torchrg.errors import ConfigError

CONSENSUS = load_config("consensus")


def changes(settings, base):
    """Return what differs, by section and name."""
    return {
        (section, name): value
        for section in ("normals", "growing", "planes")
        for name, value in vars(getattr(settings, section)).items()
        if value != getattr(getattr(base, section), name)
    }


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "s3dis",
            {
                ("growing", "facet_tolerance"): 0.009,
                ("growing", "max_plane_residual"): 2.5,
                ("growing", "min_size"): 200,
                ("planes", "up"): "z",
            },
        ),
        (
            "scannet",
            {
                ("normals", "noise_scope"): "regional",
                ("growing", "min_size"): 20,
                ("planes", "up"): "z",
            },
        ),
        ("laser", {("planes", "up"): "z"}),
        ("rgbd", {("normals", "k"): 100, ("growing", "min_size"): 100}),
    ],
)
def test_settings_for_a_kind_of_data_are_consensus_but_for_what_they_say(name, expected):
    assert changes(load_config(name), CONSENSUS) == expected


def test_a_file_holds_differences_to_its_base(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("base: consensus\ngrowing: {min_size: 7}\nchunk_size: 99\n")
    settings = load_config(path)
    assert changes(settings, CONSENSUS) == {("growing", "min_size"): 7}
    assert settings.chunk_size == 99
    path.write_text("base: s3dis\n")
    assert load_config(path) == load_config("s3dis")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("base: clasic", r"mine.yaml: expected base to be one of .*classic, .* got 'clasic'"),
        ("base: 3", "got 3"),
        ("base: [consensus]", "got "),
        ("base: ../mine", "expected base"),
        ("base: consensus\ngrowing: 3", "growing: expected a mapping"),
        ("base: consensus\ngrow: {}", "unknown key 'grow'"),
    ],
)
def test_a_wrong_base_is_refused(tmp_path, text, message):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_config(path)
