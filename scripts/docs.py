"""The reference of the API as HTML pages, made from the docstrings; see ``docs.sh``.

Ends with exit code 1 and a line for each reference (``:func:`` and the like) that leads nowhere.
"""

import ast
import importlib
import pkgutil
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pdoc

import torchrg

ROLE = re.compile(r":(?:func|class|mod|data|meth|attr|exc|obj):`~?\.?([^`<]+)`")
OUTPUT = Path("build/docs")


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


def main() -> int:
    """Check all references, then write the pages."""
    broken = [
        f"{module.__file__}:{line}: nothing is called {target!r}."
        for module in modules()
        for line, target in references(module)
        if not leads_somewhere(target, module)
    ]
    if broken:
        print(*broken, sep="\n", file=sys.stderr)
        return 1
    pdoc.render.configure(docformat="google", math=True)
    pdoc.pdoc("torchrg", output_directory=OUTPUT)
    print(f"{OUTPUT / 'index.html'}: the reference of the API")
    return 0


if __name__ == "__main__":
    sys.exit(main())
