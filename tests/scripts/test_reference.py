"""The reference: its guides run, and every link in it leads somewhere."""

import docs
import guide_pages
import pytest

GUIDES = guide_pages.guide_files()


def test_every_guide_is_on_the_index():
    found = {path.stem for path in guide_pages.GUIDES.glob("*.md")} - {"index"}
    assert {guide.stem for guide in GUIDES} == found


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_guide_runs(guide, tmp_path):
    page = guide_pages.make_guide(guide, tmp_path / "guides", set())
    wanting = [line for line in docs.broken_links(tmp_path) if "index.html" not in line]
    others = {f"{other.stem}.html" for other in GUIDES}
    assert not [line for line in wanting if line.split()[1] not in others]
    assert page.stat().st_size > 2000


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_every_public_module_has_a_page_and_links_lead_somewhere(tmp_path):
    found = docs.public_modules()
    docs.write_reference(tmp_path, found)
    for name in ("config", "structures", "io", "linalg", "errors", "regions", "scratch"):
        assert (tmp_path / "torchrg" / f"{name}.html").is_file()
    assert len(list((tmp_path / "torchrg").rglob("*.html"))) == len(found) - 1
    # The guides have links of their own, and a test of their own.
    wanting = [line for line in docs.broken_links(tmp_path) if ": guides/" not in line]
    assert not wanting
    for guide in GUIDES:
        for name in guide_pages.names_in(guide.read_text(encoding="utf-8")):
            place = guide_pages.place_of(name, set(found))
            page, _, anchor = place.partition("#")
            assert not anchor or f'id="{anchor}"' in (tmp_path / page).read_text(encoding="utf-8")


def test_references_in_docstrings_lead_somewhere():
    modules = list(docs.modules())
    assert len(modules) > 100
    assert not docs.broken_references()
    assert not docs.leads_somewhere("torchrg.nothing", modules[0])


def test_a_link_to_nowhere_is_found(tmp_path):
    (tmp_path / "a.html").write_text('<p id="here"><a href="b.html#there">b</a> <img src="c.png">')
    (tmp_path / "b.html").write_text('<a href="a.html#here">a</a> <a href="https://a.b">c</a>')
    assert docs.broken_links(tmp_path) == [
        "a.html: b.html#there leads nowhere.",
        "a.html: c.png leads nowhere.",
    ]


def test_examples_run_share_names_and_show_what_they_print(tmp_path):
    guide = tmp_path / "guide.md"
    guide.write_text(
        "# A guide\n\n```python hidden\nnumber = 1\n```\n\n```python\nprint(number < 2)\n```\n\n"
        "```bash\ntorchrg sample \\\n  room.npz --num-points 500  # small\n```\n"
        "Then `torchrg.segment_planes`.\n"
    )
    text = guide_pages.make_guide(guide, tmp_path / "out", {"torchrg"}).read_text()
    assert "<title>A guide</title>" in text
    assert '<pre class="printed">True</pre>' in text
    assert "room.npz: 500 points" in text
    assert "number = 1" not in text
    assert 'href="../torchrg.html#segment_planes"' in text


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
        guide_pages.make_guide(guide, tmp_path / "out", set())
