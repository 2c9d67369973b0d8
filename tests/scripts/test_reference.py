"""The documentation: its guides and commands run, and every link in it leads somewhere."""

import re
import shlex

import command_page
import docs
import guide_pages
import pytest

from torchrg.cli import main
from torchrg.cli.arguments import list_flags

GUIDES = guide_pages.guide_files()
TEXTS = {guide.stem: guide.read_text(encoding="utf-8") for guide in GUIDES}
LINES = re.MULTILINE | re.DOTALL


def test_the_index_names_every_guide_twice():
    index, _, trees = TEXTS["index"].partition("```{toctree}")
    others = set(TEXTS) - {"index"}
    assert set(re.findall(r"^\* \[[^]]+\]\(([\w-]+)\.md\): ", index, re.MULTILINE)) == others
    assert set(re.findall(r"^[\w-]+$", trees, re.MULTILINE)) == others


@pytest.mark.parametrize("name", TEXTS)
def test_links_between_guides_lead_to_guides(name):
    for target in re.findall(
        r"(?<!!)\[[^]]*\]\(([^)#]+)\)", guide_pages.BLOCK.sub("", TEXTS[name])
    ):
        assert target.startswith("https://") or target.removesuffix(".md") in TEXTS, target


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_guide_runs_and_makes_its_pictures(guide, tmp_path):
    text = guide_pages.make_page(guide, tmp_path).read_text(encoding="utf-8")
    assert len(text) >= guide.stat().st_size * 0.9
    for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text):
        assert (tmp_path / picture).is_file()


def test_examples_run_share_names_and_show_what_they_print(tmp_path):
    guide = tmp_path / "guide.md"
    guide.write_text(
        "# A guide\n\n```python hidden\nnumber = 1\n```\n\n```python\nprint(number < 2)\n```\n\n"
        "```bash\ntorchrg sample \\\n  room.npz --num-points 500  # small\n```\n"
        "```script\nexamples/pyg_superpoints.py\n```\n"
        "Then `torchrg.segment_planes`: ![it](a.png)\n\n"
        "```python page\nprint(f'## {number}')\n```\n"
    )
    text = guide_pages.make_page(guide, tmp_path / "out").read_text()
    assert "print(number < 2)\n```\n\n```{code-block} text\n:class: printed\n\nTrue\n```" in text
    assert "room.npz: 500 points" in text
    assert "number = 1" not in text
    assert '```py\n"""Average point features over superpoints' in text
    assert "{py:obj}`torchrg.segment_planes`: ![it](made/guide/a.png)" in text
    assert text.endswith("\n\n## 1\n")


def test_pages_show_no_times_and_paths_of_the_build_machine(tmp_path):
    guide = tmp_path / "guide.md"
    lines = [
        "scan  points  read (s)  GB",
        "room     500       0.1   2",
        "500 points in 2.4 s: 208 points, 0.42 scans a second",
        "room.ply: 500 points, 1,126.5 s -> here/planes.npz",
        "a longer line, which is no row of the table: 0.1  2",
    ]
    guide.write_text(
        "# A guide\n\n```python\nfrom pathlib import Path\n\n"
        f"print({chr(10).join(lines)!r}.replace('here', str(Path.cwd())))\n```\n"
    )
    shown = guide_pages.make_page(guide, tmp_path / "out").read_text().partition("printed\n\n")[2]
    assert shown.splitlines()[:-1] == [
        "scan  points",
        "room     500",
        "room.ply: 500 points -> planes.npz",
        lines[-1],
    ]


@pytest.mark.parametrize(
    ("block", "message"),
    [
        ("python\n1 / 0", "guide.md:4: ZeroDivisionError: division by zero"),
        ("bash\ntorchrg info none.ply", "guide.md:4: ValueError: exit code 2 of 'torchrg info"),
        ("bash\nrm -r x", "guide.md:4: ValueError: expected a command of torchrg"),
    ],
)
def test_a_failing_example_is_named(tmp_path, block, message):
    guide = tmp_path / "guide.md"
    guide.write_text(f"# A guide\n\n```{block}\n```\n")
    with pytest.raises(RuntimeError, match=message):
        guide_pages.make_page(guide, tmp_path / "out")


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("[a](https://a.b)", 0),
        ("{py:obj}`torchrg.nothing`", 1),
        ("[a](none.md)", 1),
        ("![a](none.png)", 1),
    ],
)
def test_what_leads_nowhere_fails_the_site(tmp_path, text, code):
    pages = tmp_path / "pages"
    pages.mkdir()
    (pages / "index.md").write_text(f"# Title\n\n{text}\n")
    assert docs.build_site(pages, tmp_path / "site") == code
    if code == 0:
        search = (tmp_path / "site" / "_static" / "language_data.js").read_text()
        assert "guides come before module pages" in search


@pytest.mark.parametrize("prog", command_page.PROGS)
def test_the_page_of_commands_says_what_help_says(prog, capsys):
    with pytest.raises(SystemExit):
        main([*prog.split()[1:], "--help-all"])
    words = " ".join(capsys.readouterr().out.split())
    flags = command_page.flags_of(command_page.PROGS[prog])
    assert len(flags) > 1
    assert not [flag.name for flag in flags if f"{flag.spelling} {flag.text}" not in words]


def test_the_page_of_commands_has_each_argument_and_example():
    page = command_page.command_page()
    for prog, kind in command_page.PROGS.items():
        section = page.partition(f"## {prog}\n")[2].partition("\n## ")[0]
        for flag in command_page.flags_of(kind):
            assert f"```{{option}} {flag.spelling}\n" in section
        assert f"\n{prog} " in section


def test_commands_that_are_only_shown_have_the_flags_that_they_are_shown_with():
    readme = (GUIDES[0].parents[2] / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(
        r"^```(?:console|bash)\n(.*?)^```", "\n".join([readme, *TEXTS.values()]), LINES
    )
    lines = re.sub(r"\\\n\s*", " ", "".join(blocks)).splitlines()
    shown = [shlex.split(line, comments=True) for line in lines if line.startswith("torchrg ")]
    assert len(shown) > 20
    for words in shown:
        prog = " ".join(words[: 3 if words[1] == "convert" else 2])
        known = {flag.name for flag in list_flags(command_page.PROGS[prog])}
        assert {word for word in words if word.startswith("--")} <= known
