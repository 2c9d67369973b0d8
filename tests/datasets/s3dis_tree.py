"""A small tree laid out like the raw release of S3DIS, with every defect that is known of it.

What each room must read as is written down next to it, not derived by the code under test.
"""

import hashlib

import numpy as np

# The broken lines as the two releases have them, with what they must read as.
BROKEN = {
    b"22.350 6.692 3.048 185\x00187 182": (22.350, 6.692, 3.048, 185, 187, 182),
    b"19.302 -9.1\x160 1.785 146 137 106": (19.302, -9.160, 1.785, 146, 137, 106),
    b"1.25 2.5 3.75 167.\x1000000 20.000000 30.000000": (1.25, 2.5, 3.75, 167, 20, 30),
    b"1.25 2.5 3.75 103.0\x100000 20.000000 30.000000": (1.25, 2.5, 3.75, 103, 20, 30),
    b"1.25 2.5 3.75 56.00\x10000 20.000000 30.000000": (1.25, 2.5, 3.75, 56, 20, 30),
    b"1.25 2.5 3.75 2\x111.000000 20.000000 30.000000": (1.25, 2.5, 3.75, 211, 20, 30),
}


def rows_of(seed, count):
    """Return rows of an object: coordinates in millimeters, whole colors."""
    random = np.random.default_rng(seed)
    coordinates = random.integers(-20_000, 20_000, (count, 3)) / 1000
    return np.hstack([coordinates, random.integers(0, 256, (count, 3))])


def text_of(rows, *, color="%d", end="\n"):
    """Return rows as the bytes of an annotation file."""
    line = f"%.3f %.3f %.3f {color} {color} {color}"
    return "".join(line % tuple(row) + end for row in rows).encode()


def write_objects(room, objects):
    """Write annotation files by name."""
    (room / "Annotations").mkdir(parents=True)
    for name, content in objects.items():
        (room / "Annotations" / name).write_bytes(content)


def write_clean_room(room, seed, counts):
    """Write a room of the objects ``{class_number: points}``; return their rows by name."""
    rows = {name: rows_of([seed, i], count) for i, (name, count) in enumerate(counts.items())}
    write_objects(room, {f"{name}.txt": text_of(values) for name, values in rows.items()})
    return rows


def digest(folder):
    """Return a hash over names and bytes of everything below a folder."""
    total = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        total.update(str(path.relative_to(folder)).encode("utf-8", "surrogateescape"))
        if path.is_file():
            total.update(path.read_bytes())
    return total.hexdigest()
