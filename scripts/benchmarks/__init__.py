"""Benchmarks, a file each, that ``scripts/bench.py NAME`` runs.

To add one, write a file with a :class:`benchmarks.harness.Benchmark` of the name ``Case``: clouds,
contenders that run on each, and columns of the table if the usual one will not do.
"""
