"""Linear algebra of many tiny matrices, and precision-based tolerances.

Values that can affect a label use only ``+ - * /`` and ``sqrt``. These are bit-identical at any
position of a tensor, so results do not depend on chunk size or number of threads. Vectorized
``acos`` and ``cos`` do not guarantee this.
"""

from torchrg.linalg.angles import (
    above,
    at_most,
    deg_to_sq_chord,
    signs,
    sq_chord_to_deg,
    sq_chords,
    unit_direction,
    unsigned_angle_deg,
)
from torchrg.linalg.eigen import (
    coordinate_resolution,
    eigh3,
    eigh3_lapack,
    flatness_tolerance,
    machine_epsilon,
    rank_tolerance,
    smallest_eigenvector3,
    smallest_normal,
)
from torchrg.linalg.moments import covariance, second_moments

__all__ = [
    "above",
    "at_most",
    "coordinate_resolution",
    "covariance",
    "deg_to_sq_chord",
    "eigh3",
    "eigh3_lapack",
    "flatness_tolerance",
    "machine_epsilon",
    "rank_tolerance",
    "second_moments",
    "signs",
    "smallest_eigenvector3",
    "smallest_normal",
    "sq_chord_to_deg",
    "sq_chords",
    "unit_direction",
    "unsigned_angle_deg",
]
__dir__ = __all__.copy
