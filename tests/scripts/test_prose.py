"""README and guides can be read aloud: short sentences, words of a dictionary, known commands."""

import ast
import itertools
import re
import subprocess
import sys

import guide_pages
import pytest

README = guide_pages.GUIDES.parents[1] / "README.md"
PAGES = [README, *guide_pages.guide_files()]
MAX_WORDS = 35
MODULES = sorted((guide_pages.GUIDES.parents[1] / "torchrg").rglob("*.py"))
VAGUE = re.compile(r"\b(?:found|given|some|own|part|rest|kept|known)\b")
MAX_VAGUE = 1000


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
    long = [line for line in sentences_of(text) if len(line.split()) > MAX_WORDS]
    assert not long


def test_words_are_spelled_right():
    places = ["README.md", ".github", "scripts", "torchrg", "tests"]
    command = [sys.executable, "-m", "codespell_lib", *places]
    done = subprocess.run(command, cwd=README.parent, capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("", 0)


def docstrings_of_constants(code):
    """Return the texts right after assignments of a module and of its classes."""
    bodies = [
        node.body
        for node in ast.walk(ast.parse(code))
        if isinstance(node, (ast.Module, ast.ClassDef))
    ]
    pairs = [pair for body in bodies for pair in itertools.pairwise(body)]
    return [
        text.value.value
        for constant, text in pairs
        if isinstance(constant, (ast.Assign, ast.AnnAssign))
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    ]


def test_docstrings_of_constants_are_read():
    code = 'A = 1\n"""One."""\nB = 2\n\nclass C:\n    """C."""\n    d: int\n    """Two."""\n'
    assert docstrings_of_constants(code) == ["One.", "Two."]


def test_docstrings_of_constants_begin_with_what_they_are():
    texts = [text for path in MODULES for text in docstrings_of_constants(path.read_text("utf-8"))]
    assert len(texts) > 500
    others = [text for text in texts if text.split()[0] in {"And", "Of", "What"}]
    assert not others


def test_vague_words_are_rare():
    counts = {path: len(VAGUE.findall(path.read_text(encoding="utf-8"))) for path in MODULES}
    assert sum(counts.values()) <= MAX_VAGUE, sorted(counts.items(), key=lambda item: -item[1])[:5]
