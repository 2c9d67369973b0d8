"""Settings of the segmentation of depth images."""

from dataclasses import dataclass

from torchrg.errors import ConfigError


@dataclass(frozen=True)
class DepthConfig:
    """How planes are found in depth images; see :func:`torchrg.transforms.segment_depth`."""

    noise: tuple[float, float] | None = None
    """Noise of the sensor: two numbers a and b, for a standard deviation of a + b z^2 at depth z,
    in the unit of the depth. None: estimated from each image."""
    max_depth: float | None = None
    """Depth beyond this is left out, in the unit of the depth. None: all is used."""
    max_angle_deg: float = 8.0
    """A pixel joins the region of the next one when the angle between their normals is at most
    this."""
    max_step: float = 1.5
    """And when the planes of the two differ at either by at most this many standard deviations of
    the noise."""
    min_size: int = 100
    """Smaller regions are not labelled, in pixels."""
    absorb_reach: float = 3.0
    """Pixels at borders join the flat region beside them when they are within this many standard
    deviations of its plane."""
    merge_tolerance: float = 1.2
    """Flat regions that touch become one when one plane explains both: neither is farther from it
    than this many times what it is from its own."""

    def __post_init__(self) -> None:
        noise, depth = self.noise, self.max_depth
        for name, requirement, holds in (
            ("noise", "two numbers >= 0, not both 0, or none", noise is None or _is_noise(noise)),
            ("max_depth", "> 0 or none", depth is None or depth > 0),
            ("max_angle_deg", "in [0, 90]", 0 <= self.max_angle_deg <= 90),
            ("max_step", ">= 0", self.max_step >= 0),
            ("min_size", ">= 1", self.min_size >= 1),
            ("absorb_reach", ">= 0", self.absorb_reach >= 0),
            ("merge_tolerance", ">= 1", self.merge_tolerance >= 1),
        ):
            if not holds:
                value = getattr(self, name)
                raise ConfigError(f"DepthConfig: expected {name} {requirement}, got {value!r}.")


def _is_noise(noise: tuple[float, float]) -> bool:
    """Return whether two numbers describe noise."""
    constant, growth = noise
    return 0 <= constant < float("inf") and 0 <= growth < float("inf") and constant + growth > 0
