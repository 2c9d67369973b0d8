"""Suggestions for misspelled names, and for names of other libraries."""

import difflib
from collections.abc import Iterable

_MIN_SIMILARITY = 0.75
"""Similarity to a misspelled name from which a name is suggested, as in difflib."""
_OUTPUT = "destination output output_dir output_file save"
_SEED = "random_seed random_state"
_THREADS = "jobs n_jobs num_threads num_workers"
_VOXEL = "downsample grid_size leaf_size voxel_down_sample voxel_size"
_SYNONYMS = {
    "angle_deg": "angle theta",
    "curvature_quantile": "curvature_threshold",
    "force": "overwrite rerun",
    "intrinsics": "camera camera_matrix",
    "k": "k_neighbors k_search knn max_nn n_neighbors num_neighbors",
    "kinds": "categories classes",
    "limit_memory": "max_memory memory ram",
    "max_angle_deg": "angle_threshold max_angle maximum_angle normal_threshold "
    "normal_variance_threshold_deg smoothness_threshold",
    "max_depth": "depth_trunc max_range",
    "merge": "concat concatenate fuse",
    "method": "estimator normal_method",
    "min_size": "min_cluster_size min_num_points min_points min_pts min_region_size min_samples",
    "orient": "orientation",
    "out": _OUTPUT,
    "picture": "image plot render visualize",
    "seed": _SEED,
    "table": "csv",
    "threads": _THREADS,
    "up": "up_axis vertical_axis",
    "voxel": _VOXEL,
    "workers": _THREADS,
}
"""Words of other libraries by the name in torchrg."""
_ADVICE = {
    "the device is that of the points, for commands the CPU; leave it out": "cuda device gpu",
    "only commands print progress, to standard error; 2>/dev/null hides it": "debug log_level "
    "quiet silent verbose",
    "distances to planes follow from the noise; growing.facet_tolerance merges regions within a "
    "distance, and growing.max_distance bounds gaps": "dist_threshold distance_threshold eps "
    "epsilon",
    "all planes are detected; min_area and growing.min_size drop small ones": "max_planes n_planes "
    "num_planes",
    "regions grow without random samples; leave it out": "max_iterations num_iterations "
    "probability ransac_n",
    "results are deterministic; leave it out": f"seed {_SEED}",
    "the numbers of superpoints are counts": "n",
    "batches with an offset are supported by torchrg.transforms": "offset",
    "commands name OUT or --out, and torchrg.write_cloud writes a result": f"out {_OUTPUT}",
    "pass the preset as the first argument, config, or as the key base": "preset",
    "neighborhoods have k points; max_distance bounds their radius": "radius",
    "leave it out: the default adapts to the data; up sets the up axis": "laser rgbd s3dis scannet",
    "torch.set_num_threads sets the number of threads": f"threads workers {_THREADS}",
    "pass voxel to segment_planes, SegmentPlanes or torchrg segment": f"voxel {_VOXEL}",
}
"""Words of other libraries by how to do without them, for words without such a name."""


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
    for meant in (last, *(name for name, words in _SYNONYMS.items() if last in words.split())):
        for name in (f"{section}{dot}{meant}", meant):
            if name in known:
                return known[name]
    near = difflib.get_close_matches(word, known, 1, _MIN_SIMILARITY)
    return known[near[0]] if near and not advice_on(word) else ""


def advice_on(word: str) -> str:
    """Return how to do without a name of other libraries, or "".

    Example:
        >>> advice_on("gpu")
        'the device is that of the points, for commands the CPU; leave it out'
    """
    last = word.rpartition(".")[2]
    return next((advice for advice, words in _ADVICE.items() if last in words.split()), "")
