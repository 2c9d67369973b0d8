"""Linear algebra of many tiny matrices.

Values that can affect a label use only ``+ - * /`` and ``sqrt``. These are bit-identical at any
position of a tensor, so results do not depend on chunk size or number of threads. Vectorized
``acos`` and ``cos`` do not guarantee this.
"""

from torchrg.linalg.angles import unsigned_angle_deg
from torchrg.linalg.eigen import eigh3
from torchrg.linalg.moments import covariance, second_moments

__all__ = ["covariance", "eigh3", "second_moments", "unsigned_angle_deg"]
__dir__ = __all__.copy
