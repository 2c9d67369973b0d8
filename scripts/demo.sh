#!/usr/bin/env bash
# Sets up .venv, makes a room, segments it, scores the result against the truth, draws a picture.
source "$(dirname "${BASH_SOURCE[0]}")/environment.sh"
mkdir -p demo
set -x
torchrg sample demo/room.npz --num-points 200000 --noise 0.003
torchrg segment demo/room.npz --out demo/planes.npz
torchrg score demo/planes.npz demo/room.npz
torchrg view demo/planes.npz --out demo/planes.png
{ set +x; } 2>/dev/null
echo "Look at $PWD/demo/planes.png: each plane has its own colour."
