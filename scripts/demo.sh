#!/usr/bin/env bash
# Creates .venv, generates a synthetic room, segments it, evaluates the planes and renders an image.
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
mkdir -p demo
set -x
torchrg sample demo/room.npz --num-points 200000 --noise 0.003
torchrg segment demo/room.npz --out demo/planes.npz
torchrg view demo/planes.npz --out demo/planes.png
{ set +x; } 2>/dev/null
python - <<'END'
import numpy as np
from torchrg.metrics import score_labels

truth, labels = (np.load(f"demo/{name}.npz")["labels"] for name in ("room", "planes"))
surfaces = np.where(np.bincount(truth)[truth] >= 50, truth, -1)
scores = score_labels(labels, surfaces)
detected = round(scores.recall_iou50 * scores.faces)
print(f"{detected} of {scores.faces} surfaces with 50 points or more are detected at IoU 0.5.")
print(f"Matched planes and surfaces have an F1 of {scores.f1:.1f} %.")
print(f"The adjusted Rand index is {scores.ari:.3f}, where 1 is a perfect result.")
END
echo "Look at $PWD/demo/planes.png: each plane has its own color."
