"""Sphinx configuration for the pages written by ``scripts/docs.py``."""

import pkgutil
from pathlib import Path
from typing import Any, get_origin

from sphinx.application import Sphinx

import torchrg

project = author = "torchrg"
project_copyright = "the torchrg authors"
release = torchrg.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon"]
exclude_patterns = ["made"]
"""Folder where the examples of guides run; it contains images, but no pages."""

nitpicky = True
nitpick_ignore_regex = [("py:.*", "PinholeCamera|Template|Arguments")]
"""Types that exist only for type checkers."""
suppress_warnings = ["ref.python"]
"""A type with the name of attributes of several classes, such as ``object``."""
smartquotes = False
"""Smart quotes would turn the two dashes of flags into one."""
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
    """Replace private bases by their bases."""
    shown = [get_origin(base) or base for base in bases]
    while private := [base for base in shown if getattr(base, "__name__", "").startswith("_")]:
        index = shown.index(private[0])
        shown[index : index + 1] = private[0].__bases__
    bases[:] = shown


def leave_out_aliases(app: Sphinx, _what: str, name: str, member: Any, *_: Any) -> bool | None:  # noqa: ANN401
    """Skip fields of named tuples, which their classes describe, and classes of the first page."""
    is_field = str(member.__doc__).startswith("Alias for field number")
    is_class_of_page = isinstance(member, type) and name in torchrg.__all__
    is_second = is_class_of_page and app.env.docname == "reference/torchrg.structures"
    return True if is_field or is_second else None


def keep_colons(*event: Any) -> None:  # noqa: ANN401
    """Start docstrings of constants with a comment, so a first colon does not mark a type."""
    if event[1] in ("attribute", "data", "property"):
        event[-1][:0] = ["..", ""]


def leave_out_factories(*event: Any) -> tuple[str, str] | None:  # noqa: ANN401
    """Replace default factories by dots, because their repr is not an expression."""
    *_, signature, returned = event
    return (signature.replace("<factory>", "..."), returned) if signature else None


def resolve_reference(app: Sphinx, env: Any, node: Any, text: Any) -> Any:  # noqa: ANN401
    """Resolve a name to its documentation, even if it is re-exported or in another module.

    Names of other packages, and names without a docstring, only need to exist.
    """
    target, domain = node.get("reftarget", ""), env.get_domain("py")
    is_ours, exists = target.startswith("torchrg."), True
    try:
        pkgutil.resolve_name(target)
    except (AttributeError, ImportError, ValueError):
        exists = False
    ending = f".{target.rpartition('.')[2] if is_ours else target}"
    matches = [name for name in domain.objects if name.endswith(ending)]
    if matches and (exists or not is_ours):
        match = min(matches, key=len)
        return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", match, node, text)
    return text if exists else None


def setup(app: Sphinx) -> None:
    """Connect the functions above."""
    app.connect("autodoc-process-bases", show_public_bases)
    app.connect("autodoc-skip-member", leave_out_aliases)
    app.connect("autodoc-process-docstring", keep_colons, priority=400)  # Before napoleon.
    app.connect("autodoc-process-signature", leave_out_factories)
    app.connect("missing-reference", resolve_reference)
