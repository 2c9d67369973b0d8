"""Robust normals, curvature and plane labels for indoor point clouds.

Files: :func:`read_cloud`, :func:`read_result`, :func:`write_cloud`. Segmentation:
:func:`segment_planes` with the settings of :func:`load_config`. Single stages: :func:`search_knn`,
:func:`estimate_normals`, :func:`grow_regions`, :func:`make_superpoints`, :func:`align_axes`.
:mod:`torchrg.transforms` applies them to samples of data loaders, :mod:`torchrg.datasets` reads
data sets, :mod:`torchrg.metrics` evaluates results, :mod:`torchrg.config` documents all settings.
:mod:`torchrg.robust` and :mod:`torchrg.nn` work on patches of points.

Functions of patches (``covariance``, ``eigh3``, ``median``, ``mad``, ``qn``, ``tau``,
``fit_normals_pca``, ``fit_normals_jet``, ``fit_normals_irls``, ``fit_normals_robust``,
``fit_detmcd``, ``fit_fastmcd``, ``fit_mve``, ``fit_dets``, ``fit_detmm``) are differentiable and
support ``vmap``, ``torch.func``, ``torch.compile(fullgraph=True)``, ``torch.export`` and
``torch.autocast``. Except for ``covariance``, they support reverse mode only, not ``jacfwd`` and
``hessian``. The robust fits, scales and ``fit_normals_irls`` are opaque operations for ``vmap``,
``torch.func`` and compilers, and have no second derivatives there.

Functions of clouds (``search_knn``, ``estimate_normals``, ``orient_normals``, ``grow_regions``,
``segment_planes``, ``make_superpoints``, ``segment_depth``) search neighbors and grow regions on
the CPU. A compiler breaks its graph there; ``vmap`` and ``torch.func`` raise an error;
``torch.export`` does not support them. Normals of ``estimate_normals`` and ``orient_normals`` are
differentiable, except for the method ``consensus``. CUDA is untested.

Example:
    >>> import torchrg
    >>> room = torchrg.scenes.make_room(num_points=2000, noise=0.003, seed=0)
    >>> seg = torchrg.segment_planes(room.points, torchrg.load_config("classic"))
    >>> seg.labels.shape, seg.normals.shape, len(seg.planes) > 3
    (torch.Size([2000]), torch.Size([2000, 3]), True)
"""

import sys

from torchrg.version import __version__ as __version__

TYPE_CHECKING = False  # Like typing.TYPE_CHECKING, without importing typing.
if TYPE_CHECKING:
    from torchrg import datasets, depth, metrics, nn, normals, robust, scenes, transforms
    from torchrg.config import load_config
    from torchrg.errors import TorchrgError
    from torchrg.io import read_cloud, write_cloud
    from torchrg.io.result import read_result
    from torchrg.neighbors import search_knn
    from torchrg.normals import estimate_normals
    from torchrg.pipeline import make_superpoints, segment_mesh, segment_planes
    from torchrg.regions import align_axes, grow_regions, select_planes
    from torchrg.structures import UNLABELED, Cloud, Plane
else:
    _NAMES = {
        "config": ("load_config",),
        "errors": ("TorchrgError",),
        "io": ("read_cloud", "write_cloud"),
        "neighbors": ("search_knn",),
        "normals": ("estimate_normals",),
        "pipeline": ("make_superpoints", "segment_mesh", "segment_planes"),
        "regions": ("align_axes", "grow_regions", "select_planes"),
        "io.result": ("read_result",),
        "structures": ("UNLABELED", "Cloud", "Plane"),
    }
    # Public modules that a star import omits, because names such as io hide other modules.
    _PACKAGES = (
        "batch", "config", "errors", "io", "linalg", "neighbors", "pipeline",
        "regions", "render", "scratch", "structures",
    )  # fmt: skip
    _MODULES = {name: module for module, names in _NAMES.items() for name in names}

    def __getattr__(name):  # noqa: ANN001, ANN202
        """Load a name or module on first access, so that commands start before torch is loaded."""
        from importlib import import_module

        path = f"torchrg.{_MODULES.get(name, name)}"
        try:
            module = import_module(path) if not name.startswith("_") else None
        except ModuleNotFoundError as error:
            if error.name != path:
                raise
            module = None
        if module is None:
            from torchrg._synonyms import describe_missing

            raise AttributeError(describe_missing("module 'torchrg'", name, _public_names()))
        globals()[name] = getattr(module, name) if name in _MODULES else module
        return globals()[name]

    def _public_names():  # noqa: ANN202
        """Return the names of all public functions and classes with their modules."""
        from importlib import import_module

        packages = [*_PACKAGES, *(name for name in __all__ if name not in _MODULES)]
        modules = [import_module(path) for path in map("torchrg.{}".format, packages)]
        names = {name: f"{module.__name__}.{name}" for module in modules for name in module.__all__}
        return names | {name: f"torchrg.{name}" for name in __all__}

    if "torch" in sys.modules:  # Otherwise torch.load does not know saved results.
        from torchrg import structures as structures

    def __dir__():  # noqa: ANN202
        """Return the public names, loaded or not."""
        return sorted([*__all__, *_PACKAGES, "__version__"])


__all__ = [
    "UNLABELED", "Cloud", "Plane", "TorchrgError", "align_axes", "datasets", "depth",
    "estimate_normals", "grow_regions", "load_config", "make_superpoints", "metrics", "nn",
    "normals", "read_cloud", "read_result", "robust", "scenes", "search_knn", "segment_mesh",
    "segment_planes", "select_planes", "transforms", "write_cloud",
]  # fmt: skip
