"""Make the first batch of a program that reads torchrg's files, by its own loaders and settings.

``python first_batch.py WORDS...`` runs in a checkout of the program. The words are those that its
users type after ``python`` or ``sh``, as ``tools/train.py configs/spf_scannet.yaml``. For programs
whose users write Python they are ``sonata SCENE``, also for Concerto, and ``pointcept DATASET
SPLIT``. A line that starts with ``ok`` tells the shapes of a batch; if none is made, this fails.

The files of the program run as they are. Stand-ins replace what they import and what is not
installed, as extensions that have to be compiled, and networks, which no loader asks for. What
loaders need is PyTorch Geometric (for Superpoint Transformer 2.3.0, with h5py), munch for SPFormer
and ISBNet, plyfile for SAI3D, and mmengine, mmcv-lite and mmdet for OneFormer3D and UniDet3D.
"""

import functools
import importlib
import importlib.abc
import importlib.util
import logging
import runpy
import sys
import types
from importlib.machinery import ModuleSpec
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import scipy.ndimage
import torch
import yaml
from torch_geometric.utils import scatter

import torchrg

HERE = Path.cwd()
LEFT_OUT = (
    "isbnet.ops", "src.dependencies", "torchmetrics",
    "mmdet.models", "mmdet3d.models", "mmdet3d.evaluation",
)  # fmt: skip
"""Modules that are replaced even where they are there: networks, scores and what is compiled."""
CLASSES = {"scannet": "ScanNet", "structured3d": "Structured3D", "hm3d": "HM3D", "s3dis": "S3DIS"}
"""Classes of Pointcept by data set, less the word ``Dataset``; others have the default class."""


def voxelize(coord, *_):
    """Stand for the compiled function of that name: voxels, and the voxel of each point."""
    voxels, members = torch.unique(coord, dim=0, return_inverse=True)
    return voxels, members, members


def normalize_color(mean, std):
    """Stand for ``albumentations.Normalize``."""
    return lambda image: {"image": (image / 255 - np.array(mean)) / np.array(std)}


AUGMENTATIONS = {"NoOp": lambda: dict, "load": lambda *_, **__: dict}
"""Augmentations that return what they are given, by name."""
CONTENTS = {
    "torch_scatter": {
        "scatter_sum": scatter,
        "scatter_mean": functools.partial(scatter, reduce="mean"),
    },
    "pointgroup_ops": {"voxelization_idx": voxelize},
    "isbnet.ops": {"voxelization_idx": voxelize},
    "albumentations": AUGMENTATIONS | {"Normalize": normalize_color},
    "volumentations": AUGMENTATIONS,
    "numba.core.errors": {"NumbaPerformanceWarning": Warning},
}
"""What stand-ins have to do right; anything else of them is a mock."""


class StandIns(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports a mock in place of each module whose name ``picks`` accepts."""

    def __init__(self, picks):
        self.picks = picks

    def find_spec(self, name, path, target=None):
        """Say whether this imports a module."""
        return ModuleSpec(name, self, is_package=True) if self.picks(name) else None

    def create_module(self, spec):
        """Make a mock of a package, with a version that MMDetection3D takes."""
        content = {"__name__": spec.name, "__path__": [], "__version__": "2.1.0"}
        module = MagicMock(name=spec.name)
        vars(module).update(content | CONTENTS.get(spec.name, {}))
        return module

    def exec_module(self, module):
        """Do nothing, as mocks have no code."""


def is_absent(name):
    """Whether a module that was not found is one that a file of the program imports."""
    package = name.partition(".")[0]
    if isinstance(sys.modules.get(package), MagicMock) or name == "mmcv._ext":
        return True
    frame = sys._getframe(2)
    while "importlib" in frame.f_code.co_filename:
        frame = frame.f_back
    importer = Path(frame.f_code.co_filename).resolve()
    return name == package and importer.is_relative_to(HERE.parent)


def open_package(name):
    """Import a package of the program without running its ``__init__``."""
    spec = ModuleSpec(name, None, is_package=True)
    spec.submodule_search_locations = [str(HERE.joinpath(*name.split(".")))]
    package = sys.modules[name] = importlib.util.module_from_spec(spec)
    return package


def pairs(words):
    """Values by the flags that stand before them."""
    return dict(zip(words[::2], words[1::2], strict=True))


def report(batch):
    """Print the shapes of a batch that holds something."""
    kinds = (np.ndarray, torch.Tensor)
    shapes = {key: tuple(value.shape) for key, value in batch.items() if isinstance(value, kinds)}
    assert shapes, f"expected arrays in the batch, got {batch}"
    sys.stdout.write(f"ok {HERE.name} {shapes}\n")


def run_script(words):
    """Run a script of the program that prepares data."""
    sys.argv = words
    runpy.run_path(words[0], run_name="__main__")
    sys.stdout.write(f"ok {HERE.name} {words[0]}\n")


def spformer_or_isbnet(config, *_):
    """Read scans by the settings of SPFormer or ISBNet."""
    from munch import munchify

    open_package(HERE.name.lower())
    place = {"SPFormer": "spformer.dataset", "ISBNet": "isbnet.data"}[HERE.name]
    loaders = importlib.import_module(place)
    settings = munchify(yaml.safe_load(Path(config).read_text()))
    for part in ("train", "test"):
        data = loaders.build_dataset(settings.data[part], logging.getLogger())
        scans = [data[0], data[len(data) - 1]][: settings.dataloader[part].batch_size]
        report(data.collate_fn(scans))


def oneformer3d_or_unidet3d(config):
    """Read scans by the settings of OneFormer3D or UniDet3D, on those of MMDetection3D."""
    from mmengine.registry import init_default_scope

    open_package(HERE.name)
    importlib.import_module("mmdet3d.datasets.transforms")
    for pattern in ("loading.py", "formatting.py", "transforms_3d.py", "*_dataset.py"):
        for path in Path(HERE.name).glob(pattern):
            importlib.import_module(f"{HERE.name}.{path.stem}")
    registry = importlib.import_module("mmdet3d.registry")
    init_default_scope("mmdet3d")
    base = "mmdetection3d/configs/_base_/datasets/scannet-seg.py"
    layers = [runpy.run_path(HERE.parent / base), runpy.run_path(config)]
    for part in ("train_dataloader", "val_dataloader"):
        under, settings = (layer[part]["dataset"] for layer in layers)
        if "scannet" in config and "datasets" not in settings:
            settings = under | settings
        sample = registry.DATASETS.build(settings)[0]
        masks = getattr(sample["data_samples"], "gt_pts_seg", {})
        report({"points": sample["inputs"]["points"], **dict(masks.items())})


def mask3d(*words):
    """Read scans by the settings of Mask3D and those that the words change."""
    changes = dict(word.split("=", 1) for word in words)
    name = changes.pop("data/datasets", "scannet")
    folder = Path("conf/data")
    indoor = yaml.safe_load((folder / "indoor.yaml").read_text())
    values = {"general.add_instance": True} | {f"data.{key}": indoor[key] for key in indoor}
    values |= {key: yaml.safe_load(word) for key, word in changes.items()}
    semseg = importlib.import_module("datasets.semseg")
    semseg.yaml = types.SimpleNamespace(load=yaml.safe_load)
    settings = yaml.safe_load((folder / "datasets" / f"{name}.yaml").read_text())
    for part in ("train_dataset", "validation_dataset"):
        given = {
            key: values[value[2:-1]] if str(value).startswith("${") else value
            for key, value in settings[part].items()
            if key != "_target_"
        }
        coord, features, labels, *_ = semseg.SemanticSegmentationDataset(**given)[0]
        report({"coord": coord, "features": features, "labels": labels})


def sai3d(*words):
    """Read a scan and its superpoints as SAI3D does before it looks at images."""
    given = pairs(words)
    folder, scene = given["--base_dir"], given["--scene_id"]
    program = importlib.import_module("sai3d")
    program.utils.get_points_from_ply(f"{folder}/scans/{scene}/{scene}_vh_clean_2.ply")
    points = np.loadtxt(f"{folder}/scans/{scene}/points.pts").astype(np.float32)
    settings = {"max_neighbor_distance": 2, "similar_metric": "2-norm", "dis_decay": 0.5}
    arguments = types.SimpleNamespace(scannetpp=False, view_freq=5, **settings)
    agent = program.ScanNet_SAI3D(points, arguments)
    ids, _, _, neighbors = agent.get_seg_data(folder, scene, max_neighbor_distance=2)
    report({"points": points, "ids": ids, "neighbors": neighbors})


def pointcept(settings, keys):
    """Read scenes by Pointcept's loaders; arrays of those keys have a row for each point."""
    open_package("pointcept")
    open_package("pointcept.models")
    datasets = importlib.import_module("pointcept.datasets")
    data = datasets.build_dataset(settings)
    batch = datasets.point_collate_fn([data[0], data[len(data) - 1]])
    assert len({len(batch[key]) for key in ("coord", "feat", *keys)}) == 1
    report(batch)


def pointcept_by_config(*words):
    """Read scenes by a config of Pointcept, to which the guide adds planes and curvature."""
    given = pairs(words)
    settings = runpy.run_path(f"configs/{given['-d']}/{given['-c']}.py")["data"]["train"]
    if "torchrg" not in Path("pointcept/datasets/__init__.py").read_text():
        return pointcept(settings, ["superpoint"])
    collect = settings["transform"][-1]
    collect["keys"] += ("plane",)
    collect["feat_keys"] += ("curvature",)
    return pointcept(settings, ["plane"])


def pointcept_by_name(name, split):
    """Read scenes of a data set by the class that Pointcept has for it."""
    keys = ("coord", "segment", "plane", "superpoint")
    features = ("color", "normal", "curvature")
    steps = [
        {"type": "GridSample", "grid_size": 0.05, "mode": "train"},
        {"type": "ToTensor"},
        {"type": "Collect", "keys": keys, "feat_keys": features},
    ]
    kind = f"{CLASSES.get(name, 'Default')}Dataset"
    settings = {"type": kind, "split": split, "transform": steps, "data_root": f"data/{name}"}
    if name == "hm3d":
        settings["force_label"] = False
    pointcept(settings, keys)


def spatiallm(*words):
    """Read a scan by torchrg, where SpatialLM uses Open3D, and make a batch of it."""
    cloud = torchrg.read_cloud(pairs(words)["--point_cloud"])
    open_package("spatiallm").Layout = None
    program = importlib.import_module("inference")
    points = (cloud.coordinates + cloud.origin).astype(float)
    colors = cloud.fields["color"].astype(float)
    report({"point_cloud": program.preprocess_point_cloud(points, colors, 0.025, 1280)})


def superpoint_transformer(code):
    """Run lines on Superpoint Transformer's structures, without its networks."""
    source = open_package("src")
    source.is_debug_enabled = importlib.import_module("src.debug").is_debug_enabled
    exec(code, {})
    sys.stdout.write(f"ok {HERE.name} {code}\n")


def sonata_or_concerto(scene):
    """Transform a scene as the guide does for Sonata and Concerto."""
    name = HERE.name.lower()
    open_package(name)
    point = {key: np.load(f"{scene}/{key}.npy") for key in ("coord", "normal")}
    point["color"] = np.full_like(point["coord"], 128)
    report(importlib.import_module(f"{name}.transform").default()(point))


PROGRAMS = {
    "main_instance_segmentation.py": mask3d,
    "sai3d.py": sai3d,
    "scripts/train.sh": pointcept_by_config,
    "pointcept": pointcept_by_name,
    "inference.py": spatiallm,
    "-c": superpoint_transformer,
    "sonata": sonata_or_concerto,
}
"""Programs by the word that their users type first."""


def main(first, *rest):
    """Make libraries what the program knew them as; make its batch."""
    torch.load = functools.partial(torch.load, weights_only=False)
    vars(np)["in1d"] = np.isin
    scipy.ndimage.filters = scipy.ndimage
    sys.path[:0] = [str(HERE / "tools"), str(HERE), str(HERE.parent / "mmdetection3d")]
    sys.meta_path.insert(0, StandIns(lambda name: name.startswith(LEFT_OUT)))
    sys.meta_path.append(StandIns(is_absent))
    if first == "tools/train.py":
        known = HERE.name in ("oneformer3d", "unidet3d")
        (oneformer3d_or_unidet3d if known else spformer_or_isbnet)(*rest)
    elif first in PROGRAMS:
        PROGRAMS[first](*rest)
    else:
        run_script([first, *rest])


if __name__ == "__main__":
    main(*sys.argv[1:])
