"""Small trees laid out like the releases of ScanNet and ScanNet++, written by means of their own.

What each scan must read as is written down next to it, not derived by the code under test.
"""

import json
import struct

import numpy as np

WORDS = {"wall": (1, 1), "floor": (2, 3), "office chair": (5, 9), "table": (7, 4), "lamp": (35, 35)}
"""Words of annotations, with their numbers in NYU40 and in the table of ScanNet."""
ALIGNMENT = np.array([[0.96, 0.28, 0, -1], [-0.28, 0.96, 0, 2], [0, 0, 1, -0.5], [0, 0, 0, 1]])


def write_mesh(path, coord, color=None, *, labels=None, faces=((0, 1, 2), (1, 2, 3))):
    """A binary PLY with faces after the vertices, as VCG writes the meshes of ScanNet."""
    names = [("float", axis) for axis in "xyz"]
    kinds = "<fff"
    if color is not None:
        names += [("uchar", name) for name in ("red", "green", "blue", "alpha")]
        kinds += "BBBB"
    if labels is not None:
        names += [("ushort", "label")]
        kinds += "H"
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(coord)}"]
    head += [f"property {kind} {name}" for kind, name in names]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    with path.open("wb") as stream:
        stream.write(("\n".join(head) + "\n").encode())
        for i, place in enumerate(coord.tolist()):
            row = place + ([*color[i].tolist(), 255] if color is not None else [])
            stream.write(struct.pack(kinds, *row, *([labels[i]] if labels is not None else [])))
        for face in faces:
            stream.write(struct.pack("<Biii", 3, *face))


def write_scan(scans, name, coord, color, segments, objects, *, with_labels=True):
    """A scan of ScanNet; objects are words and lists of segments, None for a scan of the test."""
    folder = scans / name
    folder.mkdir(parents=True)
    write_mesh(folder / f"{name}_vh_clean_2.ply", coord, color)
    lines = ["colorHeight = 968", "sceneType = Office"]
    if objects is not None:
        numbers = " ".join(f"{value:.6f}" for value in ALIGNMENT.reshape(-1))
        lines.insert(0, f"axisAlignment = {numbers} ")
        groups = [
            {"id": i, "objectId": i, "segments": [*map(int, own)], "label": word}
            for i, (word, own) in enumerate(objects)
        ]
        content = {"sceneId": f"scannet.{name}", "segGroups": groups}
        (folder / f"{name}.aggregation.json").write_text(json.dumps(content))
        content = {"sceneId": name, "segIndices": [*map(int, segments)]}
        (folder / f"{name}_vh_clean_2.0.010000.segs.json").write_text(json.dumps(content))
        if with_labels:
            category = np.zeros(len(coord), int)
            for word, own in objects:
                category[np.isin(segments, own)] = WORDS[word][0]
            path = folder / f"{name}_vh_clean_2.labels.ply"
            write_mesh(path, coord, color, labels=category)
    (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")


def write_tables(root, train, val):
    """The table of words and the lists of splits."""
    (root / "meta_data").mkdir(parents=True)
    rows = ["id\traw_category\tcategory\tcount\tnyu40id"]
    rows += [f"{number}\t{word}\t{word}\t3\t{nyu}" for word, (nyu, number) in WORDS.items()]
    (root / "meta_data" / "scannetv2-labels.combined.tsv").write_text("\n".join(rows) + "\n")
    for split, names in (("train", train), ("val", val)):
        (root / "meta_data" / f"scannetv2_{split}.txt").write_text("\n".join(names) + "\n")


def write_scan_plus(root, name, coord, color, segments, objects):
    """A scan of ScanNet++: objects may share segments."""
    folder = root / "data" / name / "scans"
    folder.mkdir(parents=True)
    write_mesh(folder / "mesh_aligned_0.05.ply", coord, color)
    (folder / "segments.json").write_text(json.dumps({"segIndices": [*map(int, segments)]}))
    groups = [
        {"id": i, "objectId": i + 1, "segments": [*map(int, own)], "label": word}
        for i, (word, own) in enumerate(objects)
    ]
    (folder / "segments_anno.json").write_text(json.dumps({"segGroups": groups}))
    benchmark = root / "metadata" / "semantic_benchmark"
    benchmark.mkdir(parents=True, exist_ok=True)
    (benchmark / "top100.txt").write_text("wall\noffice chair\ntable\n")
    lines = ["class,count,semantic_map_to,instance_map_to", "wall,3,,", "chair,2,office chair,"]
    lines += ["table,2,,", "SPLIT,1,None,None"]
    (benchmark / "map_benchmark.csv").write_text("\n".join(lines) + "\n")
    (root / "splits").mkdir(exist_ok=True)
    (root / "splits" / "nvs_sem_train.txt").write_text(f"{name}\n")
