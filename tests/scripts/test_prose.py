"""README, guides and names: short sentences, US spelling, and the words of the field."""

import re
import subprocess
import sys

import guide_pages
import pytest
import words

README = guide_pages.GUIDES.parents[1] / "README.md"
PAGES = [README, *guide_pages.guide_files()]
MAX_WORDS = 35
MAX_KEPT = 150
"""Words of the list in the package that stay for a reason."""


def sentences_of(markdown):
    """Return the sentences of a text, each item of a list and cell of a table for itself."""
    prose = re.sub(r"^ *```.*?^ *```$", "", markdown, flags=re.MULTILINE | re.DOTALL)
    parts = re.split(r"\n\s*\n|\n(?=[*#>]|\d\. )|\s*\|\s*", prose)
    return [
        " ".join(sentence.split())
        for part in parts
        for sentence in re.split(r"(?<=[.!?])[)\"`]*\s+(?=[A-Z`*])", part)
        if sentence.strip()
    ]


def test_sentences_are_separated():
    text = "# One\n\nTwo, e.g. 2.\nThree?\n\n```text\nx. Y.\n```\n* Four. Five\n| a | b. C |\n"
    found = ["# One", "Two, e.g. 2.", "Three?", "* Four.", "Five", "a", "b.", "C"]
    assert sentences_of(text) == found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_sentences_are_short(page):
    text = page.read_text(encoding="utf-8").replace("```{glossary}", "")
    long = [line for line in sentences_of(text) if len(line.split()) > MAX_WORDS]
    assert not long


def test_words_are_spelled_right():
    paths = ["README.md", ".github", "scripts", "torchrg", "tests"]
    command = [sys.executable, "-m", "codespell_lib", *paths]
    done = subprocess.run(command, cwd=README.parent, capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("", 0)


def test_names_and_phrases_have_no_better_word(capsys):
    assert words.main() == 0, capsys.readouterr().out
    package, texts = capsys.readouterr().out.splitlines()
    assert int(package.split()[1]) <= MAX_KEPT
    assert texts == "texts: 0 words, 0 with a reason"


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("a.py", "most_fitted = 3\n", (1, "most_fitted", "max", False)),
        (
            "a.py",
            "x = 1  # the rows, as many as there are\n",
            (1, "as many", "the number or amount", False),
        ),
        ("a.cpp", "float share = 1;  // a fraction\n", (1, "share", "fraction", False)),
        ("a.md", "The truth is\n", (1, "truth", "ground truth", False)),
        ("a.py", "at_most = absorb\n", (1, "absorb", "assign", True)),
    ],
)
def test_words_are_found_with_their_replacement(tmp_path, name, text, found):
    (tmp_path / name).write_text(text)
    assert found in words.words_of(tmp_path / name)
