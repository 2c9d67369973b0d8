"""Linear algebra of many tiny matrices, and the only numerical tolerances of the library.

Everything that can decide a label is built from ``+ - * /`` and ``sqrt`` alone: these are exact to
the last bit wherever an element stands in a tensor, so results do not depend on chunk size or on
the number of threads. Vectorised ``acos`` or ``cos`` do not promise that.
"""

from torchrg.linalg.angles import above, at_most, signs, sq_chord_to_deg, unsigned_angle_deg
from torchrg.linalg.eigen import eigh3, eigh3_of_few, rank_tolerance, smallest_eigenvector3
from torchrg.linalg.moments import covariance

__all__ = [
    "above",
    "at_most",
    "covariance",
    "eigh3",
    "eigh3_of_few",
    "rank_tolerance",
    "signs",
    "smallest_eigenvector3",
    "sq_chord_to_deg",
    "unsigned_angle_deg",
]
