"""What the paper says about segmentations, and whether it comes out."""

from reproduction.cells import Record
from reproduction.paper_numbers import INDICES
from reproduction.sections import Block, claim
from reproduction.segmentations import METHODS
from torchrg.metrics import METRICS

INTERNAL = {"cp": "CP", "sp": "SP", "dbi": "DBI", "dvi": "DVI"}
"""The paper's internal indices, and how it writes them."""


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


def trend_claims(key: str, found: dict[str, Record], origin: str) -> list[Block]:
    """Return whether the paper's trends come out on a cloud with truth."""
    f1 = {preset: found[preset]["labels"]["f1"] for preset in METHODS}
    recall = {preset: found[preset]["labels"]["recall"] for preset in METHODS}
    ordered = f1["classic"] < f1["detmm"] < f1["paper"]
    iou = {preset: found[preset]["labels"]["recall_iou50"] for preset in METHODS}
    pairs = {preset: found[preset]["labels"]["pairs"] for preset in METHODS}
    faces = found["classic"]["labels"]["faces"]
    why = (
        ""
        if ordered
        else (
            f"F1 is a mean over matched pairs only, and these are {_listed(pairs, 'd')} of "
            f"{faces} faces; the share of faces found at IoU 0.5 is {_listed(iou, '.3f')}. The "
            "picture of errors below shows which points are lost, and to what."
        )
    )
    blocks = [
        claim(
            f"F1 rises from classic over DetMM to the paper's method ({origin}).",
            ordered,
            f"F1: {_listed(f1, '.1f')}.",
            why,
        )
    ]
    blocks += [
        claim(
            f"Recall of {METHODS[preset]} is above that of classic ({origin}).",
            recall[preset] > recall["classic"],
            f"Recall: {recall[preset]:.1f} against {recall['classic']:.1f}.",
            ""
            if recall[preset] > recall["classic"]
            else f"Pairs: {pairs[preset]} against {pairs['classic']} of {faces} faces; the hard "
            "faces that only one method finds count in its mean alone.",
        )
        for preset in ("paper", "consensus")
    ]
    return blocks


def _listed(values: dict[str, float], form: str) -> str:
    return ", ".join(f"{METHODS[preset]} {format(value, form)}" for preset, value in values.items())
