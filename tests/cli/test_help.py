"""What ``--help`` prints can be read, and all of it is true."""

import contextlib
import importlib
import io
import re
import shlex
import subprocess
import sys

import pytest
import tyro

from torchrg.cli import COMMANDS, console, convert, main
from torchrg.cli.help import example_lines, list_flags

KINDS = {
    f"torchrg {name}": importlib.import_module(f"torchrg.cli.{name}").Arguments
    for name in COMMANDS
    if name != "convert"
} | {f"torchrg convert {name}": kind for name, kind in convert.KINDS.items()}
QUICK = """
import sys, torchrg.cli
try:
    torchrg.cli.main(sys.argv[1:])
finally:
    print("loaded:", *({"torch", "numpy", "tyro"} & set(sys.modules)))
"""


def help_of(prog, capsys):
    with pytest.raises(SystemExit, match="0"):
        main([*prog.split()[1:], "--help"])
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
    flags = list(list_flags(KINDS[prog]))
    assert len({flag.name for flag in flags}) == len(flags)
    for flag in flags:
        assert text.count(f"\n  {flag.spelling}\n") == 1
        assert flag.text[0].isupper() or flag.text.startswith("x,y")
        assert flag.text.endswith(".")
        assert not flag.text.startswith(("They ", "And ", "That ", "This ", "Those "))


@pytest.mark.parametrize("prog", KINDS)
def test_flags_are_those_that_are_understood(prog):
    known = names_that_tyro_knows(KINDS[prog], prog)
    shown = {
        word.removeprefix("--")
        for flag in list_flags(KINDS[prog])
        for word in flag.spelling.replace(",", " ").split()
        if word.startswith("--")
    }
    assert shown <= known


def names_that_tyro_knows(kind, prog):
    """Return the names of flags, from the help of the parser itself."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        tyro.cli(kind, args=["--help"], prog=prog)
    return set(re.findall(r"--([a-z][\w.-]*)", out.getvalue()))


@pytest.mark.parametrize("prog", KINDS)
def test_examples_are_understood(prog, capsys):
    kind = KINDS[prog]
    examples = example_lines(kind)
    assert examples
    assert help_of(prog, capsys).rstrip().endswith(examples[-1])
    for line in examples:
        assert line.startswith(f"{prog} ")
        arguments = shlex.split(line)[len(prog.split()) :]
        for flag in ("--superpoints", "--superpoint"):
            arguments = console.spell_counts(arguments, flag)
        console.parse(kind, arguments, prog=prog)


def test_what_is_needed_has_names(capsys):
    assert main(["convert", "s3dis"]) == 2
    error = capsys.readouterr().err
    assert "ROOT" in error
    assert "OUT" in error
    assert help_of("torchrg convert s3dis", capsys).startswith(
        "usage: torchrg convert s3dis ROOT OUT [options]\n"
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--normals.k", "two"], "expected a whole number for --normals.k, got 'two'. See"),
        (["--voxel", "wide"], "expected a number for --voxel, got 'wide'. See"),
        (["--growing.min-sise", "3"], "Did you mean --growing.min-size? See torchrg segment"),
        (["--quite-another", "3"], "Unrecognized options: --quite-another, 3. See"),
    ],
)
def test_a_wrong_flag_is_told_in_plain_words(arguments, message, capsys):
    assert main(["segment", "a.ply", "--out", "b.npz", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_errors_are_read_from_boxes_of_lines_and_of_none():
    boxed = "╭─ Value error ─╮\n│ No such      │\n│ thing: a-b.  │\n│ ──────── │\n│ More │\n╰────╯"
    plain = " Value error   \n --------------- \n  No such\n  thing: a-b.\n  --------\n  More"
    assert console._one_line(boxed) == console._one_line(plain) == "No such thing: a-b."


def test_settings_of_the_preset_are_shown(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["segment", "--preset", "classic", "--help"])
    assert "Default: pca." in capsys.readouterr().out


@pytest.mark.parametrize("argument", ["--help", "--version", "segmnet"])
def test_quick_answers_load_nothing_heavy(argument):
    done = subprocess.run([sys.executable, "-c", QUICK, argument], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "loaded:"
