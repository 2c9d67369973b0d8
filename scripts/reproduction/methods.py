"""The methods that are compared: presets, called by their names everywhere."""

METHODS = ("classic", "classic_increment", "detmm", "algorithm2", "paper", "consensus")
"""Presets.

The paper compares all methods under its own description of region growing (II.B), in which a seed
is chosen by the increment of the curvature (``classic_increment``, ``detmm``); PCL's
``RegionGrowing`` tests the curvature itself (``classic``). ``algorithm2`` drops unconnected
neighbours, as Algorithm 2 is printed; the text of the paper (``paper``) says three times that they
join and only do not become seeds.
"""

PAPERS = ("classic_increment", "detmm", "paper")
"""The three of the paper, in the order in which it finds them to rise."""

DRAWN = (*PAPERS, "consensus")
"""Those that the figures show."""
