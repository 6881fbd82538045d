"""Settings of loop closing: the registration with the beginning, and place recognition after a long lap."""

from __future__ import annotations

from dataclasses import dataclass, field

from .checked import Positive


@dataclass(frozen=True)
class RecognitionSettings(Positive, group="closing.recognition"):
    """Describes how the newest stretch of the curves is recognized as one that was driven before.

    It is tried where the vehicle is less certain of its place than `closing.icp_reach`.
    """

    stretch: float = 150.0
    """This length at the end of the curves is registered with an earlier stretch (m): it is long enough to
    hold the bends that tell the place along the track."""
    interval: float = 10.0
    """Two attempts are at least this far apart (m along the path)."""
    stretch_room: float = 10.0
    """Foot points on the earlier stretch are searched this far beyond its ends (m)."""
    starts: int = 6
    """The stretch is registered with at most this number of earlier stretches, which turn as it does."""


@dataclass(frozen=True)
class ClosingSettings(Positive):
    """Describes loop closing."""

    UNLIMITED = ("gauge_laps",)

    min_path: float = 60.0
    """A lap is at least this long (m)."""
    check_interval: float = 2.0
    """Two attempts to close the loop are at least this far apart (m along the path)."""
    radius: float = 8.0
    """The loop may close within this distance from the first stretch of the drive (m), enlarged by
    `drift`."""
    drift: float = 0.03
    """The distance within which the loop may close grows by this for each metre driven (m/m)."""
    heading: float = 0.8
    """The loop may close where the heading differs by less than this from the heading at the beginning
    (rad)."""
    start_lateral: float = 5.0
    """Largest distance from the place of the start at which the vehicle crosses the line of the start again
    (m). The loop closes only after that."""
    start_heading: float = 0.5
    """Largest angle between both directions there (rad)."""
    overlap: float = 8.0
    """This length of the beginning must have been driven again (m)."""
    inlier_distance: float = 0.4
    """A detection nearer to the beginning's curve than this (m) is an inlier of the registration."""
    inlier_share: float = 0.8
    """At least this share of the matched detections must be inliers."""
    min_readings: int = 25
    """At least this number of detections must be matched to close a loop."""
    min_boundary_readings: int = 5
    """Each boundary must have at least this number of inliers."""
    window: float = 2.0
    """Detections that are at most this old (s) are registered with the beginning."""
    prior_scale: float = 1.5
    """The standard deviations of the vehicle's own uncertainty are multiplied by this in the prior of the
    registration."""
    sigma_reading: float = 0.5
    """This is the standard deviation of a detection in the registration (m); it is large, since many
    detections are of one cone."""
    sigma_max: float = 0.4
    """The standard deviation of the registered position along its worst direction must be below this (m)."""
    patience: float = 40.0
    """Once this length of the beginning has been driven again (m), `sigma_patience` replaces `sigma_max`."""
    sigma_patience: float = 0.85
    """After `patience`, the standard deviation of the registered position must be below this (m): detections
    on a straight leave the position along it free, however much of it is driven again. Where the vehicle
    itself is less certain than `icp_reach`, `sigma_max` stays in force."""
    beginning: float = 60.0
    """This length of the curves counts as their beginning (m)."""
    beginning_share: float = 0.6
    """Of a short curve, at most this share counts as its beginning."""
    icp_reach: float = 3.0
    """In the first iteration of the registration, detections nearer to the beginning than this are used
    (m)."""
    icp_shrink: float = 0.7
    """The distance `icp_reach` is multiplied by this in each further iteration, down to `inlier_distance`."""
    start_step: float = 2.0
    """Where the position of the vehicle is less certain than `icp_reach`, the registration is started from
    poses of the beginning that are this far apart (m)."""
    start_chi2: float = 16.3
    """The registration starts only from poses whose squared Mahalanobis distance under the vehicle's
    uncertainty is below this (chi-square with 3 degrees of freedom, 99.9 %)."""
    icp_iterations: int = 7
    """The registration has this number of iterations."""
    keyframe_interval: float = 12.0
    """Until the loop closes, keyframes are this far apart (m along the path); the drive so far is kept in
    their frames."""
    iterations: int = 2
    """The loop is optimized by this number of Gauss-Newton steps after it is found, and again after
    simplification."""
    sigma_step: float = 10.0
    """While the loop is optimized, a control point moves this far freely in a step (m), so it is hardly
    damped."""
    join_margin: float = 10.0
    """The seam lies within the last `beginning` plus this length of a curve (m)."""
    join_share: float = 0.5
    """On a short curve, the seam lies past this share of its length."""
    overlap_step: float = 1.0
    """Points of the overlap are placed on the beginning at this step (m)."""
    overlap_room: float = 4.0
    """A point of the overlap is searched for on the beginning within this distance of its expected place (m
    along the curve)."""
    seam_margin: float = 0.5
    """A cone nearer to the seam than this (m) was also detected at the beginning, and is not counted
    twice."""
    gauge_laps: float = 4.0
    """After this number of laps on the closed map, its position and heading as a whole are held, and no more
    is claimed of it than is known then. It is infinite where they never are."""
    recognition: RecognitionSettings = field(default_factory=RecognitionSettings)
    """These settings find the place of a vehicle that is lost after a long lap."""
