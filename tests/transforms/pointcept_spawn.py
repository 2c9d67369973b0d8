"""Run Pointcept's loader with spawned workers: ``python pointcept_spawn.py POINTCEPT OUT``."""

import sys
from functools import partial

from torch.utils.data import DataLoader

if __name__ in ("__main__", "__mp_main__"):  # a worker imports this file under the second name
    sys.path.insert(0, sys.argv[1])
    import real  # noqa: F401

    import torchrg.transforms.pointcept  # noqa: F401

STEPS = {
    "made": [{"type": "SegmentPlanes", "config": "classic"}],
    "read": [],
}


def main():
    """Write which samples are in step."""
    from pointcept import datasets

    crop = {"type": "SphereCrop", "sample_rate": 0.5, "mode": "random"}
    collect = {"type": "Collect", "keys": ("coord", "plane"), "feat_keys": ("curvature",)}
    for name, steps in STEPS.items():
        data = datasets.build_dataset(
            {
                "type": "DefaultDataset",
                "split": "Area_1",
                "data_root": sys.argv[2],
                "transform": [*steps, crop, {"type": "ToTensor"}, collect],
            }
        )
        collate = partial(datasets.point_collate_fn, mix_prob=0)
        loader = DataLoader(
            data, batch_size=3, num_workers=1, multiprocessing_context="spawn", collate_fn=collate
        )
        (batch,) = loader
        num_points = int(batch["offset"][-1])
        if {len(batch[key]) for key in ("coord", "plane", "feat")} == {num_points}:
            sys.stdout.write(f"{name} in step\n")


if __name__ == "__main__":
    main()
