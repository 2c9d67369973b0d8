"""``torchrg settings`` lists each setting once, with the values that a preset has."""

import re

import pytest

from torchrg.cli import main, segment
from torchrg.cli.arguments import list_flags
from torchrg.cli.settings import flags_by_section
from torchrg.config import convert, load_config

SECTIONS = flags_by_section(load_config())


def listed(capsys, *arguments):
    assert main(["settings", *arguments]) == 0
    return capsys.readouterr().out


def test_each_setting_is_listed_once_in_sentences(capsys):
    text = listed(capsys)
    for section, flags in SECTIONS.items():
        part = text.partition(f"{section}:\n")[2].partition("\n\n")[0]
        assert flags
        for flag in flags:
            assert part.count(f"  {flag.spelling}\n") == 1
            assert flag.text[0].isupper()
            assert flag.text.endswith(".")
    assert "  --growing.absorb {true,false}\n" in text
    assert "Default: 0.5,1.5,4.0,12.0." in " ".join(text.split())


def test_a_section_has_the_values_of_the_preset_and_of_other_words(capsys, tmp_path):
    text = listed(capsys, "normals", "--preset", "classic", "--normals.k", "31")
    assert "--growing" not in text
    assert "Default: pca." in text
    assert "Default: 31." in text
    (tmp_path / "mine.yaml").write_text("growing: {absorb: no}\n")
    text = listed(capsys, "growing", "--config", str(tmp_path / "mine.yaml"))
    assert "plane they lie. Default: false." in " ".join(text.split())


def test_each_setting_of_a_configuration_is_in_a_section():
    listed_names = {flag.path for flag in SECTIONS["selection"]}
    listed_names |= {f"{name}.{flag.path}" for name, flags in SECTIONS.items() for flag in flags}
    paths = {flag.path for flag in list_flags(segment.Arguments) if "." in flag.path}
    assert len(paths) > 35
    assert {path.removeprefix("settings.") for path in paths} <= listed_names


def test_an_unknown_section_is_refused(capsys):
    assert main(["settings", "planez"]) == 2
    assert "expected SECTION to be one of selection, normals, growing" in capsys.readouterr().err


@pytest.mark.parametrize("section", SECTIONS)
def test_defaults_are_shown_as_words_that_are_accepted(section):
    for flag in SECTIONS[section]:
        for word in re.findall(r"Default: (\S+)\.$", flag.text):
            shown = convert(word, flag.hint, flag.name)
            assert convert(str(shown).strip("()"), flag.hint, flag.name) == shown


@pytest.mark.filterwarnings("always:expected degrees")
def test_an_angle_in_radians_is_told_once(tmp_path, run):
    cloud = tmp_path / "room.npz"
    assert run("sample", cloud, "--num-points", 2000).code == 0
    done = run("segment", cloud, "--out", tmp_path / "out.npz", "--angle-deg", "0.0872")
    assert done.err.count("expected degrees, not radians, got 0.0872; pass 5") == 1
