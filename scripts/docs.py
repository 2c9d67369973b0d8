"""The reference as HTML pages: guides, whose examples run, and the API; see ``docs.sh``.

Ends with exit code 1 and a line for each reference (``:func:`` and the like), link or picture that
leads nowhere, or with the example that failed.
"""

import ast
import importlib
import pkgutil
import re
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import guide_pages
import pdoc

import torchrg

sys.path.insert(0, str(Path(__file__).parents[1]))  # The scenes of tests.made.

ROLE = re.compile(r":(?:func|class|mod|data|meth|attr|exc|obj):`~?\.?([^`<]+)`")
OUTPUT = Path("build/docs")
_LINK = re.compile(r'<(?:a|img)\b[^>]*?\b(?:href|src)="([^"]+)"')
_PRIVATE = re.compile(r'<a href="[^"]*#_[^"]*">(.*?)</a>')
_ANCHOR = re.compile(r'\bid="([^"]+)"')


def modules() -> Iterator[ModuleType]:
    """Yield the modules of the package that need nothing that is not installed."""
    yield torchrg
    for info in pkgutil.walk_packages(torchrg.__path__, "torchrg."):
        if not info.name.endswith("__main__"):
            yield importlib.import_module(info.name)


def references(module: ModuleType) -> Iterator[tuple[int, str]]:
    """Yield line and target of each reference in the source of a module."""
    source = Path(str(module.__file__)).read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            for match in ROLE.finditer(node.value):
                yield node.lineno + node.value[: match.start()].count("\n"), match[1]


def leads_somewhere(target: str, module: ModuleType) -> bool:
    """Return whether a target is a name of the module, of one of its classes, or absolute."""
    classes = [value for value in vars(module).values() if isinstance(value, type)]
    return any(_reaches(start, target) for start in [module, *classes]) or _is_absolute(target)


def _is_absolute(target: str) -> bool:
    """Return whether a dotted name can be imported, its last parts as attributes."""
    parts = target.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ImportError:
            continue
        return _reaches(found, ".".join(parts[count:]))
    return False


def _reaches(start: object, dotted: str) -> bool:
    """Return whether the attributes of an object go as far as a dotted name."""
    for name in filter(None, dotted.split(".")):
        if hasattr(start, name):
            start = getattr(start, name)
        else:
            return name in getattr(start, "__annotations__", {})
    return True


def public_modules() -> dict[str, ModuleType]:
    """Return the modules that have a page: all but private ones and the command line."""
    return {
        module.__name__: module
        for module in modules()
        if not any(part.startswith("_") or part == "cli" for part in module.__name__.split("."))
    }


def broken_references() -> list[str]:
    """Return a line for each reference in a docstring that leads nowhere."""
    return [
        f"{module.__file__}:{line}: nothing is called {target!r}."
        for module in modules()
        for line, target in references(module)
        if not leads_somewhere(target, module)
    ]


def broken_links(folder: Path) -> list[str]:
    """Return a line for each link or picture in the pages of a folder that leads nowhere."""
    pages = {page: page.read_text(encoding="utf-8") for page in sorted(folder.rglob("*.html"))}
    anchors = {page.resolve(): set(_ANCHOR.findall(text)) for page, text in pages.items()}
    broken = []
    for page, text in pages.items():
        for target in dict.fromkeys(_LINK.findall(text)):
            place, _, anchor = target.partition("#")
            if re.match(r"\w+:|\$\{", place):  # Elsewhere, or filled in by the search box.
                continue
            file = (page.parent / place).resolve() if place else page.resolve()
            if not file.is_file() or (anchor and anchor not in anchors.get(file, {anchor})):
                broken.append(f"{page.relative_to(folder)}: {target} leads nowhere.")
    return broken


def write_reference(folder: Path, found: dict[str, ModuleType]) -> None:
    """Write a page for each module, and the index of guides and modules."""
    pdoc.render.configure(docformat="google", math=True)
    with warnings.catch_warnings():
        # pdoc walks packages by itself, but for those that name what is public.
        warnings.filterwarnings("ignore", "The module specification", UserWarning)
        pdoc.pdoc(*found, output_directory=folder)
    for page in (folder / "torchrg").rglob("*.html"):
        # pdoc links private bases, which have no place on any page.
        text = page.read_text(encoding="utf-8")
        page.write_text(_PRIVATE.sub(r"\1", text), encoding="utf-8")
    rows = [
        f"| [{name}]({guide_pages.place_of(name, set(found))}) | {_first_line(module)} |"
        for name, module in found.items()
        if name.count(".") < 2
    ]
    index = (guide_pages.GUIDES / "index.md").read_text(encoding="utf-8")
    index += "\n".join(["", "| module | |", "|---|---|", *rows, ""])
    (folder / "index.html").write_text(guide_pages.render(index, set(found)), encoding="utf-8")


def _first_line(module: ModuleType) -> str:
    """Return the first line of a docstring without markup."""
    line = (module.__doc__ or "").partition("\n")[0]
    return ROLE.sub(r"\1", line).replace("`", "").replace("|", "\\|")


def main() -> int:
    """Check all references, run the guides, write the pages, and check the links in them."""
    broken = broken_references()
    if not broken:
        found = public_modules()
        write_reference(OUTPUT, found)
        for guide in guide_pages.guide_files():
            print(guide_pages.make_guide(guide, OUTPUT / "guides", set(found)), flush=True)
        broken = broken_links(OUTPUT)
    if broken:
        print(*broken, sep="\n", file=sys.stderr)
        return 1
    print(f"{OUTPUT / 'index.html'}: guides, and the reference of the API")
    return 0


if __name__ == "__main__":
    sys.exit(main())
