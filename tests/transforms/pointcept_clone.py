"""Pointcept's data pipeline out of a clone, with stand-ins for what needs compiled extensions."""

import importlib
import importlib.util
import sys
import types

NAMES = ("pointcept", "torch_scatter", "torchvision", "termcolor")
"""Modules that ``import_datasets`` may put in place."""


def _stand_in(name, **names):
    module = types.ModuleType(name)
    module.__dict__.update(names)
    sys.modules[name] = module
    return module


def import_datasets(folder):
    """Import ``pointcept.datasets`` with the data sets for indoor scenes alone."""
    sys.path.insert(0, str(folder))
    if importlib.util.find_spec("torch_scatter") is None:
        _stand_in("torch_scatter", scatter_min=None)
    if importlib.util.find_spec("termcolor") is None:
        _stand_in("termcolor", colored=lambda text, *args, **kwargs: text)
    if importlib.util.find_spec("torchvision") is None:
        modes = types.SimpleNamespace(BILINEAR=2, BICUBIC=3, NEAREST=0)
        inner = _stand_in("torchvision.transforms.transforms")
        outer = _stand_in("torchvision.transforms", transforms=inner, InterpolationMode=modes)
        _stand_in("torchvision", transforms=outer)
    _stand_in("pointcept.models").utils = _stand_in("pointcept.models.utils", offset2batch=None)
    path = [str(folder / "pointcept" / "datasets")]
    datasets = _stand_in("pointcept.datasets", __path__=path)
    for name in ("defaults", "builder", "utils", "s3dis", "scannetpp"):
        module = importlib.import_module(f"pointcept.datasets.{name}")
        datasets.__dict__.update(
            {key: value for key, value in vars(module).items() if key[0] != "_"}
        )
    return datasets
