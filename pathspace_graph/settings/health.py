"""Settings of the monitor of an online estimate, and of the search for a lost vehicle."""

from __future__ import annotations

from dataclasses import dataclass

from .checked import Positive


@dataclass(frozen=True)
class HealthSettings(Positive):
    """Describes when an estimate is good, degraded or lost.

    The share of detections that the map explains is taken over the newest `window`. A coloured detection in
    the view of the curves is explained if it is in use, or if it lies on a closed curve of its colour farther
    along: in a hairpin the sensor sees the next stretch across the infield.
    """

    window: float = 1.0
    """Detections that are at most this old are judged together (s)."""
    min_offered: int = 12
    """At least this number of detections is judged; where the window holds fewer, older ones count as
    well."""
    blind: float = 2.0
    """The estimate is degraded once no detection has come for this time (s)."""
    share_degraded: float = 0.8
    """On a closed map, the estimate is degraded where a smaller share of the detections is explained."""
    share_lost: float = 0.55
    """On a closed map, the vehicle is lost where a smaller share of the detections is explained."""
    beside: float = 1.0
    """A detection that is not in use is explained if it is nearer than this (m) to the closed curve of its
    colour."""
    gap: float = 3.0
    """A closed curve has a gap where neighbouring cones are farther apart than this number of times their
    median distance. A detection beside a gap says nothing about the vehicle."""
    open_degraded: float = 0.35
    """While the loop is open, the estimate is degraded below this share. It is low, since detections of
    stretches that are not mapped yet lie beside the curves."""
    innovation: float = 1.2
    """The estimate is degraded where the mean squared distance of detections in use from their curve, before
    the update and in units of its variance, is larger than this, and by one sigma of the mean over the cones
    in view; it is about 1 if the model is right."""
    sigma_degraded: float = 1.0
    """The estimate is degraded where the standard deviation of the position on a closed map is larger than
    this in its worst direction (m)."""
    sigma_lost: float = 5.0
    """The vehicle is lost where that standard deviation is larger than this (m)."""


@dataclass(frozen=True)
class FindingSettings(Positive):
    """Describes how a vehicle that is lost on a closed map is found.

    The detections since it was lost, on at most the newest `memory` of its path, are laid beside each place
    of the loop.
    """

    interval: float = 0.5
    """Two attempts are at least this far apart (s)."""
    memory: float = 60.0
    """Detections on this length of the newest path are compared with the map (m)."""
    readings: int = 200
    """At most this number of detections, evenly chosen, is compared with the map."""
    min_readings: int = 40
    """No place is looked for with fewer detections."""
    step: float = 2.0
    """The places along the loop are this far apart (m)."""
    lead: float = 4.0
    """The vehicle heads for the middle of the track this far ahead (m)."""
    misfit: float = 3.0
    """A place is compared only where the path driven lies within this rms distance of the middle (m)."""
    sample: float = 0.25
    """The curves are sampled at this step for the comparison (m)."""
    reach: float = 3.0
    """A detection that is farther from its curve than this (m) counts as if it were this far."""
    starts: int = 12
    """At most this number of the best places is refined."""
    apart: float = 4.0
    """Two places that are less than this apart are one (m)."""
    sigma_position: float = 3.0
    """This is the standard deviation (m) of the vehicle's position about a place, before it is refined."""
    sigma_heading: float = 0.2
    """This is the standard deviation (rad) of the vehicle's heading about a place, before it is refined."""
    sigma_fit: float = 0.3
    """A detection at a distance d from a curve of its colour scores `exp(-d^2 / (2 sigma_fit^2))` (m). A
    place scores the mean of its detections."""
    min_score: float = 0.6
    """The place that is accepted has at least this score; the true one has about 0.85."""
    margin: float = 0.1
    """The score of every other place must be smaller by this."""
    sigma_max: float = 0.5
    """The standard deviation of the position at the place must be below this (m) in its worst direction."""
    confirmations: int = 2
    """This number of attempts, one after the other, must find the same place."""
    widening: float = 3.0
    """The standard deviations of the registration are multiplied by this in the prior of the found pose,
    since its detections are used again."""
    steps: int = 2
    """This number of Gauss-Newton steps is taken at the place that was found."""


@dataclass(frozen=True)
class MendingSettings(Positive):
    """Describes how a closed map is mended where detections keep contradicting it.

    A contradiction is a cone beside which no curve passes. A stretch where several of them stand in a row is
    led anew through them, and the whole drive is solved again as a batch.
    """

    sightings: int = 6
    """A cone contradicts the map once it was detected this number of times. The cones that the vehicle
    passes are detected about twenty times, and a place in clutter hardly more than once."""
    cones: int = 3
    """At least this number of contradictions in a row is mended."""
    beside: float = 0.5
    """A cone that is nearer to a curve than this (m) does not contradict it."""
    row: float = 11.0
    """Neighbours in a row are at most this far apart (m): two regular gaps, since a cone may never be
    detected."""
    settle: float = 1.5
    """The vehicle has passed a stretch once its cones have not been detected for this time (s)."""
    most: int = 20
    """A stretch is mended before the vehicle has passed all of it where it has passed this number of its
    contradictions."""
    memory: float = 30.0
    """A contradiction is forgotten when it has not been detected for this time (s)."""
    interval: float = 0.5
    """Contradictions are looked for again after this time (s)."""
    attempts: int = 8
    """The map is mended at most this number of times."""
    explained: float = 0.5
    """A mended map explains at least this share of the contradictions. If it does not, the old map stays, and
    the next attempt is a lap later."""
    sample: float = 0.25
    """The curves of a mended map are sampled at this step to compare them with the contradictions (m)."""
