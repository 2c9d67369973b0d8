"""Conversion of data sets with provenance records.

A source (:class:`~torchrg.batch.sources.CloudSource` for any
:class:`~torchrg.datasets.SceneDataset` of clouds, or
:class:`~torchrg.batch.sources.RGBDSource`) lists scans and converts one of them.
:func:`~torchrg.batch.run.list_jobs` creates a job per scan.
:func:`~torchrg.batch.run.make_plan` selects the jobs to run.
:func:`~torchrg.batch.stale.find_stale` finds results of renamed or removed scans.
:func:`~torchrg.batch.local.run_local` and :func:`~torchrg.batch.ray_tasks.run_ray` run the jobs.
:func:`~torchrg.batch.run.run_plan` collects their reports.

The guide on data sets converts a data set of one's own.
"""

__all__ = ["local", "ray_tasks", "run", "scans", "sources", "stale"]
__dir__ = __all__.copy
