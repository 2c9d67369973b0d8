"""Parts of ``bench_peers.py``: contenders, the process that runs one, tables."""
