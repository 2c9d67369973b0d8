"""README and guides can be read aloud: short sentences, words of a dictionary, known commands."""

import re
import subprocess
import sys

import guide_pages
import pytest

README = guide_pages.GUIDES.parents[1] / "README.md"
PAGES = [README, *guide_pages.guide_files()]
MOST_WORDS = 35


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


def test_sentences_are_told_apart():
    text = "# One\n\nTwo, e.g. 2.\nThree?\n\n```text\nx. Y.\n```\n* Four. Five\n| a | b. C |\n"
    found = ["# One", "Two, e.g. 2.", "Three?", "* Four.", "Five", "a", "b.", "C"]
    assert sentences_of(text) == found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_sentences_are_short(page):
    text = page.read_text(encoding="utf-8").replace("```{glossary}", "")
    long = [line for line in sentences_of(text) if len(line.split()) > MOST_WORDS]
    assert not long


def test_words_are_spelled_right():
    places = ["README.md", ".github", "scripts", "torchrg", "tests"]
    command = [sys.executable, "-m", "codespell_lib", *places]
    done = subprocess.run(command, cwd=README.parent, capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("", 0)
