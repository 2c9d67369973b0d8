"""Robust scale, location and scatter of many small point sets at once."""

from torchrg.robust.scale import mad, median, qn, qn_exceeds

__all__ = ["mad", "median", "qn", "qn_exceeds"]
