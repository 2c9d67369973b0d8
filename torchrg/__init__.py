"""Robust normals, curvature and plane labels for indoor point clouds."""

__version__ = "0.1.0"
