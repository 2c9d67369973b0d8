"""The notebook runs from top to bottom, and shows tables, pictures and a page."""

import ast
import json
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "scripts" / "first_hour.ipynb"


def run_cells():
    """Run the cells as a kernel does, and return what the last line of each shows."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    names, shown = {}, []
    for cell in cells:
        if cell["cell_type"] != "code":
            continue
        body = ast.parse("".join(cell["source"])).body
        last = body.pop() if isinstance(body[-1], ast.Expr) else None
        exec(compile(ast.Module(body, []), str(NOTEBOOK), "exec"), names)
        if last is not None:
            shown.append(eval(compile(ast.Expression(last.value), str(NOTEBOOK), "eval"), names))
    return shown


@pytest.mark.slow
def test_notebook_runs_and_shows_what_it_says(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pydeck", reason="needs the extra view")
    monkeypatch.chdir(tmp_path)
    shown = run_cells()
    pages = "".join(part._repr_html_() for part in shown if hasattr(part, "_repr_html_"))
    assert "<table>" in pages
    assert "data:image/png;base64" in pages
    assert "<iframe" in pages
    assert shown[-1] is True
    assert capsys.readouterr().out.count("ARI") == 4


def test_notebook_is_stored_without_results():
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)
