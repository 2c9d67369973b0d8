"""Repairs in messages: for misspelled names, names of other libraries, and other arguments."""

import difflib
from collections.abc import Iterable, Mapping, Sequence

_MIN_SIMILARITY = 0.75
"""Similarity to a misspelled name from which a name is suggested, as in difflib."""
_MAX_LISTED = 30
"""Maximum number of attributes that a message lists."""
_OUTPUT = "destination output output_dir output_file save"
_SEED = "random_seed random_state"
_THREADS = "jobs n_jobs num_threads num_workers"
_VOXEL = "downsample grid_size leaf_size voxel_down_sample voxel_size"
_SYNONYMS = {
    "angle_deg": "angle theta",
    "curvature_quantile": "curvature_threshold",
    "exclude": "ignore omit skip",
    "force": "overwrite rerun",
    "intrinsics": "camera camera_matrix",
    "k": "k_neighbors k_search knn max_nn n_neighbors nb_neighbors num_neighbors",
    "kinds": "categories classes",
    "limit_memory": "max_memory memory ram",
    "max_angle_deg": "angle_threshold max_angle maximum_angle normal_threshold "
    "normal_variance_threshold_deg smoothness_threshold",
    "max_depth": "depth_trunc max_range",
    "merge": "concat concatenate fuse",
    "method": "estimator normal_method",
    "min_size": "min_cluster_size min_num_points min_points min_pts min_region_size min_samples",
    "num_points": "n n_points number_of_points",
    "only_failed": "failed failed_only retry",
    "orient": "orientation",
    "out": _OUTPUT,
    "picture": "image plot render visualize",
    "seed": _SEED,
    "support_fraction": "alpha",
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
    "coordinates keep their reference system; PDAL converts them to another": "crs epsg proj srs",
    "lengths are in the unit of the cloud; leave it out, or scale the coordinates": "unit units",
    "distances to planes follow from the noise; growing.facet_tolerance merges regions within a "
    "distance, and growing.max_distance bounds gaps": "dist_threshold distance_threshold eps "
    "epsilon",
    "all planes are detected; min_area and growing.min_size drop small ones": "max_planes n_planes "
    "num_planes",
    "an estimator is a method, as method='pca' of estimate_normals, {'normals.method': 'pca'} of "
    "other functions, or --normals.method pca": "detmcd fastmcd irls jet mve pca",
    "torchrg depth segments depth images": "depth_kind depth_scale intrinsics",
    "regions grow without random samples; leave it out": "max_iterations num_iterations "
    "probability ransac_n",
    "finished scans are skipped; leave it out": "continue resume skip_existing",
    "results are deterministic; leave it out": f"seed {_SEED}",
    "the numbers of superpoints are counts": "n",
    "batches with an offset are supported by torchrg.transforms": "offset",
    "commands name OUT or --out, and torchrg.write_cloud writes a result": f"out {_OUTPUT}",
    "pass the preset as the first argument, config, or as the key base": "preset",
    "torchrg.grow_regions takes normals of points": "normals",
    "neighborhoods have k points; max_distance bounds their radius": "radius",
    "leave it out: the default adapts to the data; up sets the up axis": "laser rgbd s3dis scannet",
    "torch.set_num_threads sets the number of threads": f"threads workers {_THREADS}",
    "pass voxel to segment_planes, SegmentPlanes or torchrg segment": f"voxel {_VOXEL}",
}
"""Words of other libraries by how to do without them, for words without such a name."""

_ATTRIBUTES = {
    "torchrg.segment_planes(points), whose planes[0] has the most points": "detect_planar_patches "
    "detect_planes extract_planes find_planes fit_plane plane_segmentation ransac region_growing "
    "sacsegmentation segment segment_plane",
    "torchrg.estimate_normals(points)": "compute_normals estimate_normal estimate_normals "
    "normal_estimation",
    "torchrg.normals.orient_normals(points, normals)": "flip_normals "
    "orient_normals_consistent_tangent_plane orient_normals_to_align_with_direction "
    "orient_normals_towards_camera_location",
    "torchrg.read_cloud(path)": "load load_cloud load_pcd load_pcd_file load_ply load_point_cloud "
    "open point_cloud read read_file read_las read_laz read_pcd read_ply read_point_cloud read_xyz",
    "torchrg.read_result(path)": "from_file load_result read_planes read_segmentation",
    "torchrg.write_cloud(path, cloud, seg)": "dump export save save_cloud save_pcd save_ply to_csv "
    "to_file to_ply write write_file write_result write_las write_pcd write_ply write_point_cloud",
    "voxel, as in torchrg.segment_planes(points, voxel=0.02)": "down_sample downsample "
    "random_down_sample uniform_down_sample voxel_down_sample voxel_grid voxelize",
    "torchrg.make_superpoints(points, seg)": "cluster cluster_dbscan dbscan euclidean_cluster "
    "superpoints supervoxel_clustering supervoxels",
    "torchrg.render.color_planes(seg.labels, points)": "color_by_label colorize paint "
    "paint_uniform_color",
    "torchrg.io.result.Result.from_segmentation(cloud, seg)": "cloud provenance",
    "seg.show()": "draw draw_geometries plot render show view visualize",
    "torchrg.scenes.make_room(num_points)": "demo_data example make_room sample_data",
    "seg.inliers(i), or seg.labels == i": "indices inlier inlier_indices inlier_mask mask masks "
    "points_of select_by_index",
    "seg.labels, where -1 is no plane": "instances label plane_ids plane_labels point_labels "
    "segment_ids segments",
    "plane.equation of seg.planes, a, b, c and d": "a abcd b c coefficients coeffs d model models "
    "params plane_model plane_models",
    "points[seg.inliers(plane.id)]": "inliers points",
    "plane.outline, with {'planes.outline': True}": "boundary contour convex_hull corners hull "
    "polygon vertices",
    "plane.rms": "error residual rmse std thickness",
    "plane.count": "n_points num_inliers num_points size",
    "plane.kind": "category class_name semantic type",
    "seg.planes, whose columns are tensors": "area areas equation kind kinds offset to_pandas",
    "plane.extent and plane.axes, or cloud.points.amin(0) and amax(0)": "bbox bounding_box "
    "get_axis_aligned_bounding_box get_oriented_bounding_box height length width",
    "len(seg.planes), or the shape of a tensor, as points.shape": "n_planes num_planes shape",
    "a tensor, as seg.labels.numpy(), or the array cloud.coordinates": "array detach numpy tolist "
    "xyz",
    "seg.to(device)": "cuda gpu",
    "cloud.fields, as in 'normals' in cloud.fields": "has_colors has_normals",
    "a new torchrg.Cloud of other coordinates": "crop remove_statistical_outlier rotate scale "
    "transform translate",
}
"""Names of other libraries by what to use in place of an attribute."""


def describe_missing(owner: str, name: str, known: Mapping[str, str]) -> str:
    """Return the message about an attribute that ``owner`` lacks, with what to use.

    ``known`` has the attributes by name, in the form in which they are used.
    """
    word = _squeezed(name)
    use = [known[name]] if name in known else []
    use += [advice for advice, words in _ATTRIBUTES.items() if word in _squeezed(words).split()]
    near = difflib.get_close_matches(name, known, 1, _MIN_SIMILARITY)
    use += [known[each] for each in near]
    has = ", ".join(known.values()) if len(known) <= _MAX_LISTED else ""
    shown = f"; use {use[0]}" if use else f"; it has {has}" if has else ""
    return f"{owner} has no attribute {name!r}{shown}."


def _squeezed(text: str) -> str:
    """Return text in lower case without underscores, as names of libraries differ in both."""
    return text.lower().replace("_", "")


def nearest_name(word: str, names: Iterable[str]) -> str:
    """Return the name that a misspelled or foreign word stands for, or "".

    Names are dotted; a word may omit the section, for which the first section that has it counts.
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
    """Return how to do without a name of other libraries, or ""."""
    last = word.rpartition(".")[2]
    return next((advice for advice, words in _ADVICE.items() if last in words.split()), "")


def describe_keyword(name: str, known: Sequence[str]) -> str:
    """Return the message about a keyword that a function lacks, with what to use."""
    nearest = nearest_name(name, known)
    use = f"use {nearest}" if nearest else advice_on(name) or f"it has {', '.join(known)}"
    return f"got an unexpected keyword argument {name!r}; {use}."


def repair_of(caller: str, name: str, values: object) -> str:
    """Return how to make a tensor of an object of another type, after a semicolon, or ""."""
    if type(values).__module__.startswith("open3d"):
        return "; pass numpy.asarray(cloud.points)"
    if name == "cloud" and hasattr(values, "labels") and not hasattr(values, "cloud"):
        return "; pass the cloud that was segmented, as in torchrg.write_cloud(path, cloud, seg)"
    if has := [key for key in (name, "points", "labels") if hasattr(values, key)]:
        return f"; pass its {has[0]}"
    if hasattr(values, "_fields"):
        return f"; pass {name} in its place, or name the arguments"
    if name == "intrinsics":
        return "; use torchrg.depth.make_intrinsics(fx, fy, cx, cy)"
    if isinstance(values, str):
        return "; pass its values, not a name or path"
    if isinstance(values, list | tuple) and values and getattr(values[0], "ndim", 0) > 1:
        return f"; pass one at a time, as [{caller}(p) for p in {name}]"
    if isinstance(values, list | tuple):
        return "; use torch.tensor, or with_format('torch') for a data set"
    if hasattr(values, "to_numpy"):
        return "; pass its columns of coordinates, as in frame[['x', 'y', 'z']].to_numpy()"
    return ""


def repair_shape(name: str, shape: tuple[int, ...], axes: list[str]) -> str:
    """Return how to select from a tensor of one axis too many, or to add the missing one, or ""."""
    missing = len(axes) - (axes[0] == "*") - len(shape)
    if missing == -1 and axes == ["H", "W"] and shape[-1] in (3, 4):
        return f"; pass {name}, not colors"
    if missing == -1 and axes[0] != "*":
        return f"; pass one part, as {name}[0] or {name}[..., 0]"
    if missing == 1:
        return f"; pass {name}[{'None' if axes[-1] == str(shape[-1]) else ':, None'}]"
    return ""
