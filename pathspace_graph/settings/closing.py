"""Settings of loop closing: when the loop may close, and how certain its registration must be."""

from dataclasses import dataclass

from .checked import Positive


@dataclass(frozen=True)
class ClosingSettings(Positive):
    """When the loop may close, and how certain its registration must be."""

    UNLIMITED = ("gauge_laps",)

    min_path: float = 60.0
    """Least length of a lap (m)."""
    check_interval: float = 2.0
    """Least distance of two attempts to close the loop (m along the path)."""
    radius: float = 8.0
    """Distance from the first stretch of the drive within which the loop may close (m)."""
    drift: float = 0.03
    """Growth of `radius` with the path driven (m/m)."""
    overlap: float = 8.0
    """Length of the beginning that must have been driven again (m)."""
    inlier_distance: float = 0.4
    """Distance from the beginning's curve within which a detection is an inlier (m)."""
    inlier_share: float = 0.8
    """Least share of inliers among the matched detections."""
    prior_scale: float = 1.5
    """Factor of the vehicle's own standard deviations in the prior of the registration."""
    sigma_reading: float = 0.5
    """Standard deviation of a detection in the registration (m), large since many are of one cone."""
    sigma_max: float = 0.4
    """Largest standard deviation of the registered position along its worst direction (m)."""
    patience: float = 40.0
    """Length of the beginning driven again after which `sigma_patience` replaces `sigma_max` (m)."""
    sigma_patience: float = 0.85
    """After `patience`, the standard deviation of the registered position must be below this (m): detections
    on a straight leave the position along it free, however much of it is driven again. Where the vehicle is
    lost, `sigma_max` stays in force."""
    iterations: int = 2
    """Gauss-Newton steps after the loop is found, and again after simplification."""
    gauge_laps: float = 4.0
    """Laps on the closed map after which its position and heading as a whole are held, and no more is claimed
    of it than is known then. Infinite where they never are."""
