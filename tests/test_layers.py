"""Each layer imports only from those below it, and no modules import each other in a circle."""

import ast
import builtins
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from torchrg import make_superpoints, segment_planes, transforms
from torchrg.metrics import score_labels
from torchrg.scenes import make_room

METHOD = [
    {"errors", "version", "_limits", "_parallel", "_synonyms"},
    {"scratch"},
    {"structures"},
    {"_checks", "_optional"},
    {"kernels"},
    {"_opaque", "linalg", "neighbors", "config"},
    {"robust"},
    {"normals", "regions", "metrics", "scenes"},
    {"pipeline"},
    {"depth", "nn"},
    {"transforms"},
]
"""The rows of the method, which knows neither files nor pictures."""
FILES = [{"io"}, {"datasets"}]
LAYERS = [*METHOD, *FILES, {"batch", "render"}, {"cli"}, {"__init__", "__main__"}]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
PACKAGE = Path(__file__).parents[1] / "torchrg"


MODULES = {
    ".".join(("torchrg", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(
        ".__init__"
    ): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
"""Every module of the package by its name."""
UPWARD = {
    "torchrg.structures.planes": {"torchrg.render.notebook", "torchrg.render.page"},
    "torchrg._checks": {"torchrg.io"},
}
"""The only imports upward, in functions: what a notebook shows, and the path of a cloud."""
MAX_LINES_OF_METHOD = 19_930
"""Lines that a program loads for the method alone; lower it, and never raise it."""
LOADS_ANYTHING = {"torchrg._optional"}
"""Modules that import by a name they are given: packages of others."""


def layer_of(module):
    """Return the name under which a module stands in LAYERS."""
    return module.split(".")[1] if "." in module else "__init__"


def module_of(name):
    """Return the module that holds what a dotted name means, and None beyond the package."""
    while name and name not in MODULES:
        name = name.rpartition(".")[0]
    return name or None


def modules_below(name):
    """Return the modules whose names begin so, as a name made while running may be any of them."""
    return {module for module in MODULES if module.startswith(name)}


def named_by_call(node):
    """Return the modules that a call loads by a name, and None where the name is a variable."""
    argument = (node.args or [keyword.value for keyword in node.keywords])[0]
    if isinstance(argument, ast.JoinedStr) and isinstance(argument.values[0], ast.Constant):
        return modules_below(argument.values[0].value)
    if not isinstance(argument, ast.Constant):
        return None
    return {module_of(argument.value)}


def imported_modules(module, source):
    """Return the modules of torchrg that a source imports, wherever in it and in any spelling.

    The top of the package loads its names when they are asked for: it imports what it names for
    checkers of types.
    """
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: import by full names"
            found |= {module_of(f"{node.module}.{alias.name}") for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {module_of(alias.name) for alias in node.names}
        elif isinstance(node, ast.Call) and is_loader(node.func):
            named = named_by_call(node)
            assert named is not None or module in LOADS_ANYTHING | {"torchrg"}, (
                f"{module}: import_module of a variable hides what is imported"
            )
            found |= named or set()
    return found - UPWARD.get(module, set()) - {None, module}


def is_loader(function):
    """Return whether a called function loads modules by name."""
    name = getattr(function, "attr", getattr(function, "id", ""))
    return name in ("import_module", "__import__")


class WithoutBodies(ast.NodeTransformer):
    """Leaves out what loading a module does not run: bodies of functions, and types alone."""

    def visit_FunctionDef(self, node):
        return ast.copy_location(ast.Pass(), node)

    def visit_If(self, node):
        return None if getattr(node.test, "id", "") == "TYPE_CHECKING" else node


def loaded_with(module):
    """Return the modules that loading a module loads, itself included."""
    loaded, new = set(), {module}
    while new:
        loaded |= new
        sources = {
            name: WithoutBodies().visit(ast.parse(MODULES[name].read_text())) for name in new
        }
        found = (imported_modules(name, ast.unparse(tree)) for name, tree in sources.items())
        new = set().union(*found, *map(packages_of, new)) - loaded - {"torchrg"}
    return loaded


def packages_of(module):
    """Return the packages that a module is in, which are loaded before it."""
    parts = module.split(".")
    return {".".join(parts[:count]) for count in range(1, len(parts))}


def circles(imports):
    """Return the groups of modules that import each other, directly or around, in any order.

    Importing a module of another package loads that package first.
    """
    loads = {
        module: targets.union(*map(packages_of, targets))
        - (packages_of(module) - targets)
        - {module}
        for module, targets in imports.items()
    }
    order = list(loads)
    number = {module: i for i, module in enumerate(order)}
    pairs = [(number[m], number[t]) for m in order for t in sorted(loads[m])]
    rows, columns = zip(*pairs, strict=True) if pairs else ((), ())
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(order),) * 2)
    _, parts = connected_components(graph, directed=True, connection="strong")
    groups = [[order[i] for i in np.flatnonzero(parts == part)] for part in np.unique(parts)]
    return [group for group in groups if len(group) > 1]


@cache
def imports_of_package():
    """Return what each module of the package imports."""
    return {module: imported_modules(module, path.read_text()) for module, path in MODULES.items()}


def test_every_module_has_a_layer():
    assert {layer_of(module) for module in MODULES} <= RANK.keys()


@pytest.fixture(scope="module")
def imported_when_run():
    """The modules of torchrg that functions of the method import while they run."""
    load, noted = builtins.__import__, set()

    def note_and_load(name, *args, **kwargs):
        noted.add(name)
        return load(name, *args, **kwargs)

    room = make_room(num_points=600, seed=0)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(builtins, "__import__", note_and_load)
        seg = segment_planes(room.points, "classic")
        make_superpoints(room.points, seg, colors=room.points.abs() / room.points.abs().max())
        transforms.EstimateNormals()({"coord": room.points})
        score_labels(seg.labels, room.labels)
    assert noted
    return noted & MODULES.keys()


def test_the_method_is_small(imported_when_run):
    packages = {f"torchrg.{name}" for name in ("pipeline", "transforms", "nn", "metrics", "scenes")}
    loaded = set().union(*map(loaded_with, packages | imported_when_run))
    lines = sum(len(MODULES[module].read_text().splitlines()) for module in loaded)
    assert lines <= MAX_LINES_OF_METHOD


def test_the_method_loads_no_file_when_it_runs(imported_when_run):
    above = {name for name in imported_when_run if RANK.get(layer_of(name), 0) >= len(METHOD)}
    assert not above


def test_imports_point_down():
    """A module may import from its own package, and from the rows below."""
    upward = {
        (module, target)
        for module, targets in imports_of_package().items()
        for target in targets
        if (own := layer_of(module)) != (other := layer_of(target)) and RANK[other] >= RANK[own]
    }
    assert not upward


def test_no_modules_import_each_other_in_a_circle():
    assert circles(imports_of_package()) == []


def test_an_import_upward_closes_a_circle_of_the_package():
    imports = imports_of_package()
    imports = imports | {"torchrg.structures": imports["torchrg.structures"] | {"torchrg"}}
    assert any("torchrg.structures" in group for group in circles(imports))
