"""Settings of the front end, which judges the readings before an estimator takes them."""

from __future__ import annotations

from dataclasses import dataclass

from .checked import Positive


@dataclass(frozen=True)
class MotionSettings(Positive):
    """Describes how the motion from one perception cycle to the next is told from the detections.

    The detections of a cycle are laid on those of the cycles just before. Where that contradicts the
    odometry, the wheels slip or the readings fail, and the motion of the detections takes their place.
    """

    UNLIMITED = ("doubt", "huber")

    doubt: float = 5.0
    """The detections contradict the odometry by this number of standard deviations. It is infinite where the
    odometry is always believed."""
    doubt_again: float = 3.8
    """An odometry that was contradicted not long ago is contradicted by this number of them."""
    distrust: float = 12.0
    """An odometry that was contradicted is distrusted for this time (s)."""
    doubt_rate: float = 2.0
    """The yaw rate of an odometry that is contradicted is still believed if the detections agree with it
    within this number of standard deviations."""
    memory: float = 0.65
    """Detections are remembered for this time (s)."""
    max_remembered: int = 2000
    """At most this number of detections is remembered, the newest ones."""
    reach: float = 1.0
    """A remembered detection at distance d counts as the same cone with the weight `exp(-d^2 / 2 reach^2)`
    (m), in the first iteration."""
    reach_last: float = 0.4
    """This is the reach in the last iteration (m)."""
    iterations: int = 6
    """The detections are laid on the earlier ones in this number of iterations. The check of the odometry
    takes the first and the last one, since it begins near the solution."""
    min_weight: float = 0.7
    """A detection is matched if the weights of the remembered detections add up to this at least."""
    min_matched: int = 3
    """No motion is told from fewer matched detections than this."""
    min_doubting: int = 4
    """A contradiction of the odometry rests on this number of matched detections at least."""
    huber: float = 2.5
    """Beyond this whitened distance, the Huber loss reduces the weight of a matched detection."""
    misfit: float = 1.5
    """Where the mean square of the whitened distances is larger than this for long, detections are worse than
    they claim, and their covariances are multiplied by its excess."""
    misfit_gain: float = 0.02
    """The mean square takes over this share of each cycle's."""
    max_misfit: float = 3.0
    """No motion is told where the mean square of the whitened distances is larger than this. It is about 1
    where the vehicle has moved, and 4 and more where it was put down elsewhere."""
    misfit_odometry: float = 2.0
    """Odometry is contradicted only where the mean square at its own pose is larger than this."""
    misfit_ratio: float = 1.3
    """It must also be larger than this number of times that of the match."""
    max_change: float = 3.5
    """No motion is told that differs from the one before by more than this number of standard deviations of
    `sigma_speed`, `sigma_lateral` and `sigma_rate`."""
    sigma_cone: float = 0.05
    """This standard deviation (m) is added to that of a detection, since one side of a cone is seen."""
    sigma_latency: float = 0.05
    """Detections are older than their stamps by this (s, one sigma), before the check has learned more."""
    sigma_latency_changes: float = 0.005
    """The latency of detections changes by this in a minute (s, one sigma)."""
    sigma_yaw: float = 0.02
    """The sensor is turned by this (rad, one sigma), before the check has learned more."""
    sigma_yaw_changes: float = 0.001
    """The yaw of the sensor changes by this in a minute (rad, one sigma)."""
    before: float = 0.5
    """A contradiction may have begun a few cycles before it was noticed. So its size, times this, is added to
    the standard deviation of the motion."""
    widening: float = 1.5
    """The standard deviations of a motion told from detections are multiplied by this, since the estimator
    uses the detections again."""
    sigma_speed: float = 3.0
    """Where the odometry is not believed, the speed ahead differs from that a cycle before by this standard
    deviation (m/s)."""
    sigma_lateral: float = 1.0
    """Where the odometry is not believed, the speed to the left differs from that a cycle before by this
    standard deviation (m/s)."""
    sigma_rate: float = 0.5
    """Where the odometry is not believed, the yaw rate differs from that a cycle before by this standard
    deviation (rad/s)."""
    hold: float = 0.15
    """A twist is held for this time (s) without a loss of certainty."""
    hold_intervals: float = 3.0
    """A twist may also be held for this number of times the shortest interval between two twists."""
    stuck: int = 3
    """Readings have stuck where this number of twists in one cycle is equal to the one before, to the last
    digit, and where the vehicle could not change its velocity so."""
    acceleration: float = 5.0
    """The speeds of a twist that is held longer are uncertain by this for each second more (m/s^2)."""
    angular_acceleration: float = 1.5
    """The yaw rate of a twist that is held longer is uncertain by this for each second more (rad/s^2)."""
    rest: float = 1.0
    """The vehicle is at rest once it has stood for this time (s). Its mean yaw rate over this time measures
    the bias."""
    rest_speed: float = 0.1
    """The speed of a vehicle at rest is smaller than this (m/s), but for the noise of the odometry."""
    rest_rate: float = 0.05
    """The yaw rate of a vehicle at rest is smaller than this (rad/s), but for its noise; it is the bias."""
    rest_sigmas: float = 3.0
    """This number of standard deviations of the mean counts as noise."""
    rest_sigma: float = 5e-4
    """A vehicle at rest moves by this from cycle to cycle, as one standard deviation (m)."""
    rest_sigma_heading: float = 5e-5
    """A vehicle at rest turns by this from cycle to cycle, as one standard deviation (rad)."""

    @property
    def accelerations(self) -> tuple[float, float, float]:
        """Returns how fast the twist of a vehicle changes (m/s^2, m/s^2, rad/s^2)."""
        return self.acceleration, self.acceleration, self.angular_acceleration

    @property
    def sigmas_errors(self) -> tuple[float, float]:
        """Returns the standard deviations (rad, s) of the sensor's yaw and latency."""
        return self.sigma_yaw, self.sigma_latency

    @property
    def sigmas_changes(self) -> tuple[float, float]:
        """Returns by how much (rad, s) the sensor's yaw and latency change in a minute, as one sigma."""
        return self.sigma_yaw_changes, self.sigma_latency_changes

    @property
    def reaches(self) -> list[float]:
        """Returns the reach of each iteration (m), which shrinks by the same factor."""
        shrink = (self.reach_last / self.reach) ** (1.0 / max(self.iterations - 1, 1))
        return [self.reach * shrink**k for k in range(self.iterations)]

    @property
    def reaches_check(self) -> list[float]:
        """Returns the reach of each iteration (m) in the check of the odometry."""
        return [self.reach, self.reach_last]

    @property
    def sigmas_rest(self) -> tuple[float, float, float]:
        """Returns the standard deviations (m, m, rad) of a motion at rest."""
        return self.rest_sigma, self.rest_sigma, self.rest_sigma_heading


@dataclass(frozen=True)
class SidesSettings(Positive):
    """Describes how the side of a cone is told from the way driven."""

    reach: float = 8.0
    """Coloured cones up to this far ahead along the predicted path say what the colours mean (m)."""
    min_lateral: float = 0.5
    """The path tells the side of a cone that is farther from it than this (m)."""
    max_lateral: float = 8.0
    """The path tells the side of a cone that is nearer to it than this (m)."""
    min_votes: int = 3
    """The colours are swapped after this number of cones on the side of the other colour."""
    majority: float = 2.5
    """These must be this number of times as many as those on the side of their own colour."""
    enough_votes: int = 30
    """This number of cones settles what the colours mean."""
    colourless: float = 0.7
    """Sides are told from the rows of cones where a larger share of the detections has no colour; at 1, they
    never are."""
    remembered: float = 0.98
    """From cycle to cycle, the detections so far count by this factor less in that share."""
    min_detections: int = 6
    """The share is taken of at least this number of detections."""
    merge_radius: float = 1.0
    """Detections that are nearer to each other than this (m) are of one cone."""
    forget_after: float = 3.0
    """A cone is forgotten when it was not detected for this time (s)."""
    max_cones: int = 2000
    """At most this number of cones is remembered, the ones that were seen last."""
    sightings: int = 2
    """A cone has a side once it was detected this number of times."""
    behind: float = 8.0
    """The rows begin this far behind the vehicle (m along the path)."""
    sure: float = 3.0
    """The path tells sides up to this far ahead of the vehicle (m); beyond, the rows do."""
    beside: float = 2.0
    """Cones that are less than this apart (m along the path) stand beside each other."""
    lateral_gap: float = 0.8
    """A cone belongs to another stretch if one beside it is nearer to the path by more than this (m)."""
    half_width: float = 1.5
    """A row without any cone begins at this distance beside the vehicle (m)."""
    gap: float = 8.0
    """Neighbouring cones of a row are at most this far apart (m)."""
    turn: float = 1.3
    """A row turns by at most this from one cone to the next (rad)."""
    turn_cost: float = 2.0
    """The next cone of a row has the least `distance (1 + turn_cost turn^2)` (rad^-2)."""
    clear: float = 1.3
    """The next cone of a row would cost the other row this number of times as much, at least."""
    min_width: float = 1.8
    """A cone of one row is farther from each cone of the other row than this (m)."""
