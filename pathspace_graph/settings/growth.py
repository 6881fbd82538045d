"""Settings of growth: the driven path, the open ends of the curves, and their tentative stretches."""

from __future__ import annotations

from dataclasses import dataclass

from .checked import Positive


@dataclass(frozen=True)
class PathSettings(Positive):
    """Describes the driven path, and the prediction of the path ahead."""

    step: float = 0.3
    """Neighbouring positions of the stored path are at least this far apart (m)."""
    memory: float = 60.0
    """The path is stored for this distance behind the vehicle (m). The first stretch of the drive, as long as
    this, is stored for loop closing."""
    beginning_step: float = 1.0
    """Neighbouring poses of the stored first stretch are at least this far apart (m)."""
    max_curvature: float = 0.3
    """The curvature of the path predicted ahead of the vehicle is at most this (1/m)."""
    curvature_gain: float = 0.4
    """The smoothed curvature takes over this share of each cycle's measured curvature."""
    min_speed: float = 1.0
    """Below this speed (m/s), the curvature is not measured, since yaw rate over speed is too uncertain."""


@dataclass(frozen=True)
class GrowthSettings(Positive):
    """Describes how the open end of a curve grows."""

    UNLIMITED = ("forget_after",)

    reach: float = 7.0
    """A boundary is extended up to this far ahead of the vehicle (m along the predicted path)."""
    sightings: int = 3
    """A tentative track is confirmed by this number of detections within `merge_radius`."""
    sigma: float = 0.4
    """A curve is extended through a track once it is known to this standard deviation in every direction
    (m): a far, uncertain one waits until it was seen near."""
    merge_radius: float = 1.0
    """Detections of one label that are nearer to each other than this (m) belong to one tentative track."""
    forget_after: float = 6.0
    """A tentative track is dropped when it has not been detected for this time (s)."""
    threshold: float = 0.7
    """A tentative track nearer to the end of the curve than this (m) does not extend it."""
    max_lateral: float = 10.0
    """A boundary begins with tentative tracks nearer to the driven path than this (m); circuits are up to 15
    m wide."""
    lateral_change: float = 1.5
    """The next tentative track may be this much farther from the path than the newest cones of the curve
    (m)."""
    lateral_rate: float = 0.2
    """For each metre along the path, the next tentative track may be this much farther from the path, in
    addition to `lateral_change` (m/m)."""
    beside: float = 2.0
    """Tentative tracks that are less than this apart (m along the path) stand beside each other."""
    lateral_gap: float = 0.8
    """A tentative track is left out if another one beside it is nearer to the path by more than this (m)."""
    station_margin: float = 0.3
    """A tentative track must lie at least this far past the end of the curve (m along the path) to extend
    it."""
    end_behind: float = 5.0
    """The end of a curve is at most this far behind the vehicle (m along the path), since a stranded end is
    carried on. An older stretch of the path across the infield may be nearer to it, which means nothing."""
    recall: float = 25.0
    """Cones along this length of the curve at its end (m) are checked to be in the order in which the vehicle
    passed them."""
    stranded: float = 2.0
    """An end farther behind the vehicle than this (m along the path), with nothing ahead that extends it, is
    stranded and is carried on along the path."""
    stranded_left: float = 0.5
    """A stranded end is carried on to this share of `stranded` behind the vehicle."""
    min_lateral: float = 0.5
    """A carried end keeps at least this distance from the path (m)."""
    min_carry: float = 0.5
    """An end is carried on by at least this distance (m), or not at all."""
    max_size: float = 5000.0
    """An open curve grows no further once it has this number of control points."""
    length_driven: float = 2.0
    """It grows no further, either, once it is longer than `length_free` plus this number of times the path
    driven. A curve that zigzags between false cones gets longer than that."""
    max_unseen: float = 500.0
    """An open curve goes on without any cone for at most this length (m): it is not carried on any farther
    behind the vehicle, and not led on to a cone beyond that."""
    max_tracks: int = 1000
    """At most this number of tentative tracks of each label is kept, the ones that were seen last."""
    length_free: float = 50.0
    """This length of an open curve is not held against the path driven (m)."""


@dataclass(frozen=True)
class TentativeSettings(Positive):
    """Describes the tentative stretch of an open curve, from its confirmed end on.

    It is fitted anew whenever the map is asked for. No estimate depends on it.
    """

    reach: float = 12.5
    """The stretch leads through tentative tracks up to this far from the vehicle (m)."""
    memory: float = 0.35
    """A tentative track that is not confirmed counts for this time after it was last detected (s), because a
    detection of nothing is not repeated."""
    gap: float = 11.0
    """Neighbouring tracks of a row are at most this far apart (m); these are two regular gaps, since a cone
    may never be detected."""
    turn: float = 2.0
    """A row turns by at most this from one track to the next (rad), less what `turn_rate` takes away."""
    turn_rate: float = 0.1
    """The turn that is allowed shrinks by this for each metre to the next track (rad/m)."""
    turn_cost: float = 1.0
    """The next track of a row has the least `distance (1 + turn_cost turn^2)` (rad^-2)."""
    min_width: float = 1.5
    """A row is at least this far from the other boundary (m)."""
    width_ratio: float = 1.8
    """The next track of a row is at most this many times as far from the other boundary as the one before,
    plus `width_slack`."""
    width_slack: float = 1.0
    """The next track of a row may be this much farther from the other boundary (m), in addition to
    `width_ratio`."""
    tail: float = 20.0
    """This length at the end of the confirmed curves (m) tells where the track leads and how wide it is."""
    tail_step: float = 1.0
    """The confirmed curves are sampled at this step (m)."""
    begin_lateral: float = 1.5
    """The row of a boundary that has not begun is searched from this far beside the vehicle on (m)."""
    sigma_cone: float = 0.1
    """This is the standard deviation of a cone's distance from a smooth curve (m), added to a track's own."""
    sigma_bend: float = 1.0
    """The second difference of the control points has this standard deviation (m) about that of a straight
    line; it widens the band between tracks that are far apart, and beyond the last one."""
