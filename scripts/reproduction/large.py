"""Figure 9: the two large clouds, at several angles."""

from reproduction.cells import Record
from reproduction.methods import DRAWN, METHODS
from reproduction.pictures import draw_side_by_side
from reproduction.runs import Run
from reproduction.sections import Block, figure, section, table, text
from reproduction.segmentation_tables import draw_figures, more_rows
from reproduction.segmentations import count_regions, regrow, score
from reproduction.trends import face_recalls, trend_claims
from torchrg.metrics import score_labels

CLOUDS = ("cory", "kinect")
ANGLES_DEG = (2.0, 5.0, 8.0)
"""The paper does not print those of its second row; the third is at 5 degrees."""


def reproduce(run: Run) -> Record:
    """Make Figure 9."""
    words = (
        "The paper shows its method on these clouds at several angles, without numbers. Normals "
        "and sharp points are those of the preset, at 5 degrees, whatever the angle of growth."
    )
    blocks, records = [text(words)], []
    for key in CLOUDS:
        found = {preset: score(run, key, preset, internal=False) for preset in METHODS}
        records += list(found.values())
        cloud = run.cloud(key).cloud
        rows = more_rows(found)
        if cloud.labels is not None:
            for name in ("f1", "recall", "precision"):
                values = (f"{record['labels'][name]:.1f}" for record in found.values())
                rows.insert(0, [name.capitalize(), *values])
        blocks.append(table(f"**{key}**, {cloud.origin}", [key, *METHODS.values()], rows))
        if cloud.labels is not None:
            blocks += trend_claims(
                found,
                {preset: face_recalls(run, key, preset) for preset in METHODS},
                cloud.origin,
            )
        blocks += draw_figures(run, key, "Figure 9", DRAWN)
        angles, made = _angles(run, key)
        blocks += angles
        records.append(made)
    return section("Figure 9: large clouds", blocks, records)


def _angles(run: Run, key: str) -> tuple[list[Block], Record]:
    """Return the paper's method at several angles: the picture and its numbers."""
    cloud = run.cloud(key).cloud
    file = f"figures/figure9_{key}_angles.png"

    def work() -> Record:
        labelings = {
            f"paper, {angle:g} degrees": regrow(run, key, "paper", angle, 0.95)
            for angle in ANGLES_DEG
        }
        draw_side_by_side(
            run.folder,
            f"figure9_{key}_angles",
            cloud,
            labelings,
            with_input=cloud.labels is None,
        )
        counts = {title: count_regions(labels) for title, labels in labelings.items()}
        if cloud.labels is not None:
            for title, labels in labelings.items():
                counts[title]["f1"] = score_labels(labels, cloud.labels).f1
        return {"cloud": key, "angles": counts}

    record = run.folder.cell(f"angles-{cloud.name}", work, needs=run.folder.path / file)
    rows = [
        [
            title,
            f"{found['regions']:,}",
            f"{100 * found['share_labeled']:.1f} %",
            f"{found['f1']:.1f}" if "f1" in found else "-",
        ]
        for title, found in record["angles"].items()
    ]
    caption = f"**Figure 9**, {cloud.origin}: the paper's method at several angles."
    return [figure(file, caption), table("", ["", "regions", "labelled", "F1"], rows)], record
