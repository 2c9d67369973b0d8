"""Benchmarks for ``scripts/bench.py NAME``, one file each.

To add a benchmark, write a file with a subclass of :class:`benchmarks.harness.Benchmark` named
``Case``: its clouds, its contenders, and a report if the default table does not fit.
"""
