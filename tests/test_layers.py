"""Each layer imports only from the layers below it."""

import ast
from pathlib import Path

LAYERS = [
    {"errors", "version", "_display"},
    {"_checks", "_optional", "_parallel", "structures"},
    {"linalg", "neighbors", "config"},
    {"robust"},
    {"normals", "regions", "metrics", "io", "scenes"},
    {"result"},
    {"store"},
    {"tiles"},
    {"pipeline"},
    {"depth", "nn"},
    {"transforms"},
    {"datasets"},
    {"batch", "render"},
    {"cli"},
    {"__init__", "__main__"},
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
PACKAGE = Path(__file__).parents[1] / "torchrg"


def layer_of(path):
    """Return the name under which a file stands in LAYERS."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_layers(source):
    """Yield the layer of every module of torchrg that a source imports."""
    for node in ast.walk(ast.parse(source)):
        names = []
        if isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
            if node.module == "torchrg":
                names = [f"torchrg.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        for package, _, rest in (name.partition(".") for name in names):
            if package == "torchrg":
                layer = rest.split(".")[0]
                yield layer if layer in RANK else "__init__"


def upward_imports(layer, source):
    """Return the layers that a source of some layer may not import."""
    return [
        target
        for target in imported_layers(source)
        if target not in (layer, "__init__") and RANK[target] >= RANK[layer]
    ]


def test_every_module_has_a_layer():
    assert {layer_of(path) for path in PACKAGE.rglob("*.py")} <= RANK.keys()


def test_imports_point_down():
    upward = {
        str(path.relative_to(PACKAGE)): targets
        for path in PACKAGE.rglob("*.py")
        if (targets := upward_imports(layer_of(path), path.read_text()))
    }
    assert not upward


def test_upward_imports_are_seen_in_every_spelling():
    for source in (
        "import torchrg.pipeline",
        "from torchrg.pipeline import segment_planes",
        "from torchrg import pipeline",
    ):
        assert upward_imports("regions", source) == ["pipeline"]
    assert upward_imports("regions", "from torchrg.normals import pca") == ["normals"]
