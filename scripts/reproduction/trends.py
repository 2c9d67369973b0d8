"""What the paper says about segmentations, and whether it comes out."""

from reproduction.cells import Record
from reproduction.methods import METHODS
from reproduction.paper_numbers import INDICES
from reproduction.runs import Run
from reproduction.sections import Block, claim
from reproduction.segmentations import read_segmented
from torchrg.metrics import METRICS, contingency_table, match_regions

INTERNAL = {"cp": "CP", "sp": "SP", "dbi": "DBI", "dvi": "DVI"}
"""The paper's internal indices, and how it writes them."""

LARGE = 1000
"""Points from which on a face is called large here."""


def face_recalls(run: Run, key: str, preset: str) -> Record:
    """Return recall in percent and number of points of each true face with a paired region."""
    cloud = run.cloud(key).cloud

    def work() -> Record:
        table = contingency_table(read_segmented(run, key, preset).labels, cloud.labels)
        pairs = match_regions(table)
        sizes = table.face_sizes[table.faces[pairs]]
        names = table.face_labels[table.faces[pairs]].tolist()
        recalls = (100 * table.overlaps[pairs] / sizes).tolist()
        faces = zip(names, recalls, sizes.tolist(), strict=True)
        return {"faces": {str(name): [recall, size] for name, recall, size in faces}}

    return run.folder.cell(f"faces-{cloud.name}-{preset}", work)


def internal_claim(key: str, found: dict[str, Record]) -> Block:
    """Return whether the paper's method is the best of its three in most internal indices."""
    best = []
    for name in INTERNAL:
        higher = METRICS["clusters"][name].higher_is_better
        values = {preset: found[preset]["clusters"][name] for preset in INDICES[key]}
        choice = max(values, key=values.get) if higher else min(values, key=values.get)
        best.append(f"{INTERNAL[name]} {METHODS[choice]}")
    return claim(
        f"The paper's method is the best of three in three of the four internal indices ({key}).",
        sum(word.endswith(" paper") for word in best) >= 3,
        f"Best: {', '.join(best)}.",
    )


def trend_claims(found: dict[str, Record], faces: dict[str, Record], origin: str) -> list[Block]:
    """Return whether the paper's trends come out on a cloud with truth.

    Args:
        found: Scores by method.
        faces: What :func:`face_recalls` says of each method.
        origin: What the cloud is.
    """
    scores = {preset: found[preset]["labels"] for preset in METHODS}
    f1 = {preset: score["f1"] for preset, score in scores.items()}
    rising = [f1["classic"] < f1["detmm"] < f1[preset] for preset in ("paper", "paper@0.5")]
    half = "It does" if rising[1] else "Nor does it"
    blocks = [
        claim(
            f"F1 rises from classic over DetMM to the paper's method ({origin}).",
            rising[0],
            f"F1: {_listed(f1, '.1f')}.",
            f"F1 is a mean over matched pairs only, of {scores['classic']['faces']} faces: "
            f"{_listed({name: score['pairs'] for name, score in scores.items()}, 'd')}. Faces "
            "found at IoU 0.5: "
            f"{_listed({name: score['recall_iou50'] for name, score in scores.items()}, '.3f')}. "
            "The picture of errors in the report shows which points are lost, and to what. "
            f"{half} where half of the neighbours have to be shared.",
        )
    ]
    for preset in ("paper", "paper@0.5", "consensus"):
        ours, theirs = scores[preset]["recall"], scores["classic"]["recall"]
        blocks.append(
            claim(
                f"Recall of {METHODS[preset]} is above that of classic ({origin}).",
                ours > theirs,
                f"Recall: {ours:.1f} against {theirs:.1f}.",
                _common_recall(faces["classic"]["faces"], faces[preset]["faces"]),
            )
        )
    return blocks


def _common_recall(classic: Record, other: Record) -> str:
    """Return the mean recall over the faces that two methods both find, large and small."""
    common = classic.keys() & other.keys()
    parts = []
    for name, large in ((f"{LARGE:,} points and more", True), (f"fewer than {LARGE:,}", False)):
        chosen = [face for face in common if (classic[face][1] >= LARGE) == large]
        if chosen:
            means = [
                sum(found[face][0] for face in chosen) / len(chosen) for found in (other, classic)
            ]
            parts.append(f"{means[0]:.1f} against {means[1]:.1f} on {len(chosen)} faces of {name}")
    if not parts:
        return ""
    return f"On the faces that both find: {'; '.join(parts)}. The mean counts every face alike."


def _listed(values: dict[str, float], form: str) -> str:
    return ", ".join(f"{METHODS[preset]} {format(value, form)}" for preset, value in values.items())
