"""Conversion of data sets with provenance records.

A source (:class:`~torchrg.batch.sources.CloudSource` for any
:class:`~torchrg.datasets.SceneDataset` of clouds, or
:class:`~torchrg.batch.sources.RGBDSource`) lists scans and converts one of them.
:func:`~torchrg.batch.run.list_jobs` creates a job per scan.
:func:`~torchrg.batch.run.make_plan` selects the jobs to run.
:func:`~torchrg.batch.stale.find_stale` finds results of renamed or removed scans.
:func:`~torchrg.batch.local.run_local` and :func:`~torchrg.batch.ray_tasks.run_ray` run the jobs.
:func:`~torchrg.batch.run.run_plan` collects their reports.

Example:
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from torchrg.batch.scans import convert_scan
    >>> from torchrg.batch.sources import CloudSource
    >>> from torchrg.batch.run import list_jobs
    >>> from torchrg.config import load_config
    >>> from torchrg.datasets import FolderOfClouds
    >>> from torchrg.scenes import make_room
    >>> folder = Path(tempfile.mkdtemp())
    >>> (folder / "in").mkdir()
    >>> np.save(folder / "in" / "room.npy", make_room(2000).points)
    >>> source = CloudSource(FolderOfClouds(folder / "in"), load_config("classic"))
    >>> [convert_scan(job).status for job in list_jobs(source, folder / "out")]
    ['converted']
    >>> sorted(path.name for path in (folder / "out" / "room").iterdir())
    ['coord.npy', 'curvature.npy', 'normal.npy', 'plane.npy', 'planes.json', 'provenance.json']
"""

__all__ = ["local", "ray_tasks", "run", "scans", "sources", "stale"]
__dir__ = __all__.copy
