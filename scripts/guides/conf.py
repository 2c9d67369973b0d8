"""What Sphinx is told about the pages that ``scripts/docs.py`` lays before it."""

import pkgutil
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

import torchrg

project = author = "torchrg"
project_copyright = "the torchrg authors"
release = torchrg.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon"]
exclude_patterns = ["made"]
"""Where the examples of guides run: pages are not looked for there, pictures are."""

nitpicky = True
nitpick_ignore_regex = [("py:.*", "PinholeCamera|Template|Arguments")]
"""Types that are only there for type checkers."""
suppress_warnings = ["ref.python"]
"""A type that is called as attributes of several classes are, as ``object`` is."""
smartquotes = False
"""Else flags lose a dash."""
myst_heading_anchors = 3
napoleon_custom_sections = ["Convention"]
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
add_module_names = False
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = f"torchrg {release}"
html_copy_source = False
html_static_path = [str(Path(__file__).with_name("printed.css"))]
html_css_files = ["printed.css"]
html_search_scorer = str(Path(__file__).with_name("search.js"))


def show_public_bases(_app: Sphinx, _name: str, _of: type, _options: object, bases: Any) -> None:  # noqa: ANN401
    """Put the bases of private bases in their place."""
    shown = [*bases]
    while private := [base for base in shown if getattr(base, "__name__", "").startswith("_")]:
        place = shown.index(private[0])
        shown[place : place + 1] = private[0].__bases__
    bases[:] = shown


def leave_out_aliases(*event: Any) -> bool | None:  # noqa: ANN401
    """Skip fields of named tuples, which the docstrings of these describe."""
    return True if str(event[3].__doc__).startswith("Alias for field number") else None


def keep_colons(*event: Any) -> None:  # noqa: ANN401
    """Begin the text of a constant with an empty comment: its first colon is not after a type."""
    if event[1] in ("attribute", "data", "property"):
        event[-1][:0] = ["..", ""]


def leave_out_factories(*event: Any) -> tuple[str, str] | None:  # noqa: ANN401
    """Write defaults that are made anew as dots: as Python writes them they are no expression."""
    *_, signature, returned = event
    return (signature.replace("<factory>", "..."), returned) if signature else None


def find_elsewhere(app: Sphinx, env: Any, node: Any, text: Any) -> Any:  # noqa: ANN401
    """Lead a name to where it is described, though a package shows it, or another module has it.

    Names of other packages, and those of ours that have no docstring, need only be there.
    """
    target, domain = node.get("reftarget", ""), env.get_domain("py")
    is_ours, is_there = target.startswith("torchrg."), True
    try:
        pkgutil.resolve_name(target)
    except (AttributeError, ImportError, ValueError):
        is_there = False
    ending = f".{target.rpartition('.')[2] if is_ours else target}"
    places = [name for name in domain.objects if name.endswith(ending)]
    if places and (is_there or not is_ours):
        place = min(places, key=len)
        return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", place, node, text)
    return text if is_there else None


def setup(app: Sphinx) -> None:
    """Connect the functions above."""
    app.connect("autodoc-process-bases", show_public_bases)
    app.connect("autodoc-skip-member", leave_out_aliases)
    app.connect("autodoc-process-docstring", keep_colons, priority=400)  # Before napoleon.
    app.connect("autodoc-process-signature", leave_out_factories)
    app.connect("missing-reference", find_elsewhere)
