"""Version of torchrg, without further imports."""

__version__ = "0.1.0"
