"""Where a scan of an E57 file stands, and points between its frame and the world's."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SHORTEST_QUATERNION = 1e-300


class Scan(NamedTuple):
    """A scan of an E57 file: its name, and how its points were moved to where they are.

    Attributes:
        name: Its name.
        rotation: Quaternion w x y z.
        translation: What is added after the rotation.

    Example:
        >>> half_turn = Scan("s", rotation=(0.0, 0.0, 0.0, 1.0), translation=(0.0, 0.0, 2.0))
        >>> half_turn.to_world(np.array([[1.0, 5.0, 3.0]])).tolist()
        [[-1.0, -5.0, 5.0]]
    """

    name: str = "torchrg"
    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    translation: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def is_moved(self) -> bool:
        """Whether the pose changes anything; if not, points keep their bits."""
        return (self.rotation, self.translation) != (Scan().rotation, Scan().translation)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The rotation as a matrix, shape ``(3, 3)``."""
        length = max(float(np.linalg.norm(self.rotation)), SHORTEST_QUATERNION)
        w, x, y, z = np.array(self.rotation) / length
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    def to_world(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Move points of the scan to the world, shape ``(N, 3)``."""
        if not self.is_moved:
            return points
        moved: NDArray[np.float64] = points.astype(np.float64) @ self.matrix.T
        moved += np.array(self.translation)
        return moved

    def to_scan(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Move points of the world to the scan, shape ``(N, 3)``."""
        if not self.is_moved:
            return points
        moved: NDArray[np.float64] = points.astype(np.float64)
        moved -= np.array(self.translation)
        moved @= self.matrix
        return moved

    def rotate(self, vectors: NDArray[np.floating], *, back: bool = False) -> NDArray[np.floating]:
        """Turn vectors from the scan to the world, or back, shape ``(N, 3)``, in their own type."""
        if not self.is_moved:
            return vectors
        matrix = self.matrix if back else self.matrix.T
        turned: NDArray[np.float64] = vectors.astype(np.float64) @ matrix
        return turned.astype(vectors.dtype)


def to_cartesian(spherical: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Cartesian coordinates of range, azimuth and elevation (radians), shape ``(N, 3)``."""
    distance, azimuth, elevation = spherical.T
    flat = distance * np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1
    )
