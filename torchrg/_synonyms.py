"""Suggestions for misspelled names, and for names of other libraries."""

import difflib
from collections.abc import Iterable

_MIN_SIMILARITY = 0.75
"""Similarity to a misspelled name from which a name is suggested, as in difflib."""
SYNONYMS = {
    "angle_deg": ("angle", "theta"),
    "curvature_quantile": ("curvature_threshold",),
    "force": ("overwrite", "rerun"),
    "intrinsics": ("camera", "camera_matrix"),
    "k": ("k_neighbors", "k_search", "knn", "max_nn", "n_neighbors", "num_neighbors"),
    "kinds": ("categories", "classes"),
    "limit_memory": ("max_memory", "memory", "ram"),
    "max_angle_deg": (
        *("angle_threshold", "max_angle", "maximum_angle", "normal_threshold"),
        *("normal_variance_threshold_deg", "smoothness_threshold"),
    ),
    "max_depth": ("depth_trunc", "max_range"),
    "merge": ("concat", "concatenate", "fuse"),
    "method": ("estimator", "normal_method"),
    "min_size": (
        *("min_cluster_size", "min_num_points", "min_points", "min_pts", "min_region_size"),
        *("min_samples", "minimum_region_size"),
    ),
    "orient": ("orientation",),
    "out": ("destination", "output", "output_dir", "output_file", "save"),
    "picture": ("image", "plot", "render", "visualize"),
    "table": ("csv", "planes_csv"),
    "seed": ("random_seed", "random_state"),
    "up": ("up_axis", "vertical_axis"),
    "voxel": ("downsample", "grid_size", "leaf_size", "voxel_down_sample", "voxel_size"),
    **dict.fromkeys(("workers", "threads"), ("jobs", "n_jobs", "num_threads", "num_workers")),
}
"""Words of other libraries by the name in torchrg."""
_ADVICE = {
    ("cuda", "device", "gpu"): "torchrg runs on the CPU; leave it out",
    ("debug", "log_level", "quiet", "silent", "verbose"): "only commands print progress, to "
    "standard error; 2>/dev/null hides it",
    ("dist_threshold", "distance_threshold", "eps", "epsilon", "max_distance_to_plane"): "distances "
    "to planes follow from the noise; growing.facet_tolerance merges regions within a distance, "
    "and growing.max_distance bounds gaps",
    ("max_planes", "n_planes", "num_planes"): "all planes are detected; min_area and "
    "growing.min_size drop small ones",
    ("max_iterations", "num_iterations", "probability", "ransac_n"): "regions grow without random "
    "samples; leave it out",
    ("seed", *SYNONYMS["seed"]): "results are deterministic; leave it out",
    ("n",): "the numbers of superpoints are counts",
    ("offset",): "batches with an offset are supported by torchrg.transforms",
    ("out", *SYNONYMS["out"]): "torchrg.write_cloud writes a result",
    ("preset",): "pass the preset as the first argument, config, or as the key base",
    ("radius",): "neighborhoods have k points; max_distance bounds their radius",
    ("threads", "workers", *SYNONYMS["threads"]): "torch.set_num_threads sets the number of "
    "threads",
    ("voxel", *SYNONYMS["voxel"]): "pass voxel to segment_planes, SegmentPlanes or torchrg segment",
}
_FIXES = {word: advice for words, advice in _ADVICE.items() for word in words}


def nearest_name(word: str, names: Iterable[str]) -> str:
    """Return the name that a misspelled or foreign word stands for, or "".

    Names are dotted; a word may omit the section, for which the first section that has it counts.

    Example:
        >>> nearest_name("min_points", ["up", "growing.min_size"])
        'growing.min_size'
        >>> nearest_name("gpu", ["up"])
        ''
    """
    known = {name.rpartition(".")[2]: name for name in reversed([*names])}
    known |= {name: name for name in names}
    section, dot, last = word.rpartition(".")
    for meant in (last, *(name for name, words in SYNONYMS.items() if last in words)):
        for name in (f"{section}{dot}{meant}", meant):
            if name in known:
                return known[name]
    near = difflib.get_close_matches(word, known, 1, _MIN_SIMILARITY)
    return known[near[0]] if near and last not in _FIXES else ""


def advice_on(word: str) -> str:
    """Return how to do without a name of other libraries, or "".

    Example:
        >>> advice_on("gpu")
        'torchrg runs on the CPU; leave it out'
    """
    return _FIXES.get(word.rpartition(".")[2], "")
