"""What ``--help`` prints can be read, and all of it is true."""

import dataclasses
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Literal

import pytest
from command_page import PROGS as KINDS

from torchrg.cli import main
from torchrg.cli.arguments import Argument, example_lines, list_flags, parse, plain
from torchrg.cli.sample import Arguments
from torchrg.config import check_values
from torchrg.errors import ConfigError

QUICK = """
import sys, torchrg.cli
try:
    torchrg.cli.main(sys.argv[1:])
finally:
    print("loaded:", *({"torch", "numpy", "argparse"} & set(sys.modules)))
"""


def help_of(prog, capsys, flag="--help-all"):
    with pytest.raises(SystemExit, match="0"):
        main([*prog.split()[1:], flag])
    return capsys.readouterr().out


@pytest.mark.parametrize("prog", KINDS)
def test_help_has_no_markup_and_stays_in_its_lines(prog, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "90")
    text = help_of(prog, capsys)
    assert "`" not in text
    assert ":func:" not in text
    assert ":class:" not in text
    flags = [line for line in text.splitlines() if line.startswith(("  --", "  torchrg", "usage"))]
    assert all(len(line) <= 90 for line in text.splitlines() if line not in flags)


@pytest.mark.parametrize("prog", KINDS)
def test_each_argument_is_told_once_in_sentences(prog, capsys):
    text = help_of(prog, capsys)
    flags = [flag for flag in list_flags(KINDS[prog]) if not flag.section]
    assert len({flag.name for flag in flags}) == len(flags)
    for flag in flags:
        assert text.count(f"\n  {flag.spelling}\n") == 1
        assert flag.text[0].isupper() or flag.text.startswith("x,y")
        assert flag.text.endswith(".")
        assert not flag.text.startswith(("They ", "And ", "That ", "This ", "Those "))


@pytest.mark.parametrize("prog", KINDS)
def test_flags_are_those_that_are_understood(prog):
    needed = ["x"] * sum(flag.is_positional for flag in list_flags(KINDS[prog]))
    for flag in list_flags(KINDS[prog]):
        for name in re.findall(r"--[a-z][\w.-]*", flag.spelling):
            is_switch = flag.hint is bool and not flag.section
            wrong = [*needed, name, *["?"] * (not is_switch), "--not-a-flag"]
            with pytest.raises(ConfigError) as refused:
                parse(KINDS[prog], wrong, prog=prog)
            # The flag is taken, and what is no flag or no value is refused.
            assert f"options: {name}" not in str(refused.value)


@dataclasses.dataclass(frozen=True)
class Part:
    """Settings of a part."""

    size: float | None = 1.0
    """A size."""
    is_on: bool = True
    """Whether it is on."""
    counts: tuple[int, ...] | None = None
    """Some counts."""

    __post_init__ = check_values


@dataclasses.dataclass(frozen=True)
class Command:
    """Do something."""

    file: Annotated[Path, Argument("FILE", is_positional=True)]
    """A file."""
    out: Path
    """A place."""
    place: tuple[float, float, float] | None = None
    """A place of three numbers."""
    kind: Literal["one", "other"] | None = None
    """A kind."""
    part: Part = Part()


@pytest.mark.parametrize(
    ("line", "changes"),
    [
        ("a --out b", {}),
        ("--out=b a --part.size 2", {"part": Part(size=2.0)}),
        ("a --out b --part.size None --part.is-on false", {"part": Part(size=None, is_on=False)}),
        ("a --out b --part.is_on=no --part.is-on yes", {}),
        ("--out b --part.counts 3 4 a", {"part": Part(counts=(3, 4))}),
        ("a --out b --part.counts 3,4", {"part": Part(counts=(3, 4))}),
        ("a --out b --place 1 -2 1e3", {"place": (1.0, -2.0, 1000.0)}),
        ("a --out b --place none", {}),
        ("--place 1 -2 .5 a --out b", {"place": (1.0, -2.0, 0.5)}),
        ("a,b --out b", {"file": Path("a,b")}),
        ("--out b -- --a", {"file": Path("--a")}),
        ("a --out c --kind other --out b", {"kind": "other"}),
    ],
)
def test_fields_become_what_is_written(line, changes):
    expected = dataclasses.replace(Command(Path("a"), Path("b")), **changes)
    assert parse(Command, line.split(), prog="f") == expected


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "missing required FILE and --out."),
        ("a", "missing required --out for a."),
        ("a --out", "expected a value for --out. See"),
        ("a --out b --part.size wide", "expected --part.size to be a number or none, got 'wide'."),
        ("a --out b --place 1 2", "expected --place to be 3 numbers or none, got '1,2'. See"),
        ("a --out b --part.counts 1,x", "expected --part.counts to be integers or none, got '1,x'"),
        ("a --out b --kind two", "expected --kind to be one of one, other or none, got 'two'. See"),
        ("a --out b --part.is-on", "expected a value for --part.is-on, as in --part.is-on true."),
        ("a --out b --part.size --kind one", "expected a value for --part.size. See"),
        ("a b --out b", "unrecognized argument b. See"),
        ("a --out b --par.size 2", "unrecognized option --par.size. Did you mean --part.size? See"),
        ("a --output b --size 2", "unrecognized option --size. Did you mean --part.size? See"),
        ("a -o b --is_on", "unrecognized option --is-on. Did you mean --part.is-on? See"),
        ("a --out b --kind one two", "expected one value for --kind, got one two; separate"),
        ("a --out -y two", "expected one value for --out, got -y two; separate values with commas"),
        ("a --out=b two", "unrecognized argument two."),
        ("a --out b --part.is-on c", "expected --part.is-on to be true or false, got 'c'. See"),
        (
            "a --out b --part.no-is-on",
            "unrecognized option --part.no-is-on. Did you mean --part.is-on false? See",
        ),
        ("a --out b --other.size 2", "unrecognized option --other.size. Did you mean --part.size?"),
    ],
)
def test_what_is_written_wrongly_is_one_line(line, message):
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        parse(Command, line.split(), prog="f")


@pytest.mark.parametrize(
    ("word", "flag"),
    [
        ("--min-size", "--growing.min-size"),
        ("--k", "--normals.k"),
        ("--max-angle-deg", "--growing.max-angle-deg"),
        ("--strengths", "--partition.strengths"),
        ("--partition.min-points", "--partition.min-size"),
        ("--min-points", "--growing.min-size"),
        ("--voxel-size", "--voxel"),
        ("--n_jobs", "--threads"),
        ("--growing.no-absorb", "--growing.absorb false"),
    ],
)
def test_a_setting_without_its_section_and_a_foreign_name_are_suggested(word, flag):
    shown = word.replace("_", "-")
    with pytest.raises(ConfigError, match=rf"option {shown}\. Did you mean {flag}\?"):
        parse(KINDS["torchrg segment"], ["a.ply", word, "3"], prog="torchrg segment")


@pytest.mark.parametrize(
    ("word", "advice"),
    [
        ("--gpu", ": the device is that of the points, for commands the CPU; leave it out"),
        ("--device=cuda", ": the device is that of the points, for commands the CPU; leave it out"),
        ("--quiet", ": only commands print progress, to standard error; 2>/dev/null hides it"),
        ("--distance-threshold", ": distances to planes follow from the noise; .*"),
        ("--lr", ""),
        ("--labels", ""),
    ],
)
def test_names_without_counterpart_are_advised_on_or_left_alone(word, advice):
    name = word.partition("=")[0]
    with pytest.raises(ConfigError, match=rf"^unrecognized option {name}{advice}\. See"):
        parse(KINDS["torchrg segment"], ["a.ply", word], prog="torchrg segment")


@pytest.mark.parametrize("prog", KINDS)
def test_examples_are_understood(prog, capsys):
    kind = KINDS[prog]
    examples = example_lines(kind)
    assert examples
    assert help_of(prog, capsys).rstrip().endswith(examples[-1])
    for line in examples:
        assert line.startswith(f"{prog} ")
        arguments = shlex.split(line)[len(prog.split()) :]
        parse(kind, arguments, prog=prog)


@pytest.mark.parametrize("prog", KINDS)
def test_short_help_fits_a_screen_and_names_the_rest(prog, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    text = help_of(prog, capsys, "--help")
    flags = [flag for flag in list_flags(KINDS[prog]) if not flag.section]
    assert len(text.splitlines()) <= 52
    shown = [flag for flag in flags if f"\n  {flag.spelling}" in text]
    assert all(flag in shown for flag in flags if flag.is_required)
    more = f"{prog} --help-all explains these and {len(flags) - len(shown)} more."
    assert (more in text) == (len(shown) < len(flags))
    assert text.rstrip().endswith(example_lines(KINDS[prog])[-1])


def test_what_is_needed_has_names(capsys):
    usage = "usage: torchrg convert s3dis ROOT OUT [options]\n"
    assert help_of("torchrg convert s3dis", capsys).startswith(usage)


@pytest.mark.parametrize(
    ("prog", "most"), [("segment", 25), ("convert folder", 28), ("align", 15), ("depth", 15)]
)
def test_commands_have_few_options(prog, most, capsys):
    text = help_of(f"torchrg {prog}", capsys)
    assert (
        sum(line.startswith(("  --", "  CLOUD", "  ROOT", "  OUT")) for line in text.splitlines())
        <= most
    )


@pytest.mark.parametrize("argument", ["--help", "--version", "segmnet"])
def test_quick_answers_load_nothing_heavy(argument):
    done = subprocess.run([sys.executable, "-c", QUICK, argument], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "loaded:"


def test_parse_by_example():
    assert parse(Arguments, ["room.npz", "--noise=0.01"], prog="torchrg sample").noise == 0.01


def test_plain_by_example():
    assert (
        plain("With ``absorb``; see :func:`torchrg.segment_planes`.")
        == "With absorb; see torchrg.segment_planes."
    )


def test_a_named_argument_may_follow_its_name_and_lists_may_be_repeated():
    kind = KINDS["torchrg convert folder"]
    words = ["scans", "--out", "results", "--exclude", "a.txt", "b*", "--exclude=c"]
    arguments = parse(kind, words, prog="torchrg convert folder")
    assert (arguments.root, arguments.out) == (Path("scans"), Path("results"))
    assert arguments.exclude == ("a.txt", "b*", "c")
    with pytest.raises(ConfigError, match="unrecognized argument results"):
        parse(kind, ["scans", "results", "--out", "other"], prog="torchrg convert folder")
