"""The notebook is stored with what Jupyter shows, and shows it again."""

from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "scripts" / "first_hour.ipynb"
nbformat = pytest.importorskip("nbformat", reason="needs the extra dev")


def texts_of(notebook):
    """Return what each cell prints or shows as text alone, by its code."""
    texts = {}
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            shown = data.get("text/plain", "") if "text/html" not in data else ""
            texts[cell.source] = texts.get(cell.source, "") + output.get("text", "") + shown
    return texts


def test_notebook_is_stored_with_pictures_tables_and_texts():
    stored = nbformat.read(NOTEBOOK, as_version=4)
    pages = [
        output.data["text/html"]
        for cell in stored.cells
        for output in cell.get("outputs", ())
        if "text/html" in output.get("data", {})
    ]
    assert any("<table>" in page and "data:image/png;base64" in page for page in pages)
    assert sum(text.count("ARI") for text in texts_of(stored).values()) == 4
    assert NOTEBOOK.stat().st_size < 1_000_000


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_notebook_shows_what_it_is_stored_with(tmp_path):
    pytest.importorskip("pydeck", reason="needs the extra view")
    client = pytest.importorskip("nbclient", reason="needs the extra dev")
    stored = nbformat.read(NOTEBOOK, as_version=4)
    again = client.execute(nbformat.read(NOTEBOOK, as_version=4), cwd=str(tmp_path))
    assert texts_of(again) == texts_of(stored)
