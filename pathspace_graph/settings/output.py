"""Settings of what is made of a map or a run: a speed profile, a recording for the live viewer, a film."""

from dataclasses import dataclass

from pathspace_graph.settings.checked import Positive


@dataclass(frozen=True)
class SpeedSettings(Positive):
    """How fast a vehicle may be on its tyres; the defaults are those of a careful Formula Student car."""

    UNLIMITED = ("top",)

    lateral: float = 10.0
    """Largest lateral acceleration, m/s^2: the friction coefficient times gravity."""
    forward: float = 5.0
    """Largest acceleration on a straight, m/s^2."""
    braking: float = 8.0
    """Largest deceleration on a straight, m/s^2."""
    top: float = 30.0
    """Largest speed, m/s."""


@dataclass(frozen=True)
class RecordingSettings(Positive):
    """The recording of a run for the live viewer."""

    band_every: int = 10
    """Cycles from one band to the next, since a band needs the joint covariance of the map; where the map is
    replaced, it has one too. The curves are shown in every cycle."""
    samples_per_span: int = 6
    """Lines in each span of a curve."""


@dataclass(frozen=True)
class FilmSettings(Positive):
    """The film of a run."""

    UNLIMITED = ("laps",)

    seconds_per_lap: float = 10.0
    """Time of film for a lap, s."""
    frames_per_second: float = 12.5
    """Frames in a second; a frame of a .gif begins at a multiple of 0.01 s."""
    width: int = 780
    """Width of a frame, pixels."""
    height: int = 520
    """Height of a frame, pixels."""
    laps: float = float("inf")
    """Laps after which the film ends; the mapping goes on without it."""
    hold: float = 2.0
    """Time for which the last frame is shown, s."""


# --- plausibility --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PlausibilitySettings(Positive):
    """Describes how a log is judged before it is mapped."""

    least_twists: int = 20
    """Nothing is said of a log with fewer twists than this."""
    min_detections: int = 2
    """Cycles with fewer detections than this are not compared."""
    most_detections: int = 14
    """At most this number of detections of a cycle is compared, the nearest ones."""
    cycles: int = 200
    """The spacing of the cones is told from about this number of cycles."""
    gaps: tuple[int, ...] = (1, 2, 4, 8)
    """A cycle is compared with those that come this number of cycles later."""
    pairs: int = 60
    """About this number of pairs of cycles is compared for each of the gaps."""
    longest: float = 1.3
    """The cycles of a pair are at most this far apart (s), if cycles do not come more rarely."""
    reach: float = 0.2
    """A detection at this share of the cones' spacing from another one counts as the same cone by
    `exp(-1/2)`."""
    overlap: float = 0.5
    """Two cycles are compared if by the odometry one could have seen this share of the other's detections."""
    turn: float = 15.0
    """The frame of the detections is tried in steps of this angle (degrees)."""
    equal: float = 0.02
    """Hypotheses whose explained shares differ by less than this are equally good."""
    sided: float = 0.2
    """Of equally good hypotheses, one is better if this share more of the labels is on its side."""
    telling: float = 0.2
    """A pair tells two hypotheses apart if their explained shares of it differ by more than this."""
    chance: float = 1e-8
    """A hypothesis is believed where it would win so many of the pairs with this probability by chance."""
    far_better: float = 1.8
    """A hypothesis that is believed explains this number of times as much as the log as it is written."""
    least_share: float = 0.3
    """A hypothesis that is believed explains at least this share of the detections."""
    shortest_step: float = 2e-4
    """Rows follow each other after this time at least, as a rule (s)."""
    longest_step: float = 5.0
    """Rows follow each other after this time at most, as a rule (s)."""
    farthest: float = 120.0
    """No detector of cones sees them farther away than this, as a rule (m)."""
    far: float = 20.0
    """Of two units that both give possible positions, the one is told in which cones are nearer than this
    (m)."""
    nearest: float = 0.05
    """No cones are nearer than this, as a rule (m)."""
    fastest: float = 100.0
    """No vehicle is faster than this in a tenth of its time (m/s)."""
    fastest_turn: float = 8.0
    """No vehicle turns faster than this in a tenth of its time (rad/s)."""
    iterations: int = 5
    """The mounting of the sensor is found in this number of Gauss-Newton steps."""
    least_matches: int = 60
    """The mounting is found from this number of matched detections at least."""
    worst_condition: float = 1e6
    """The mounting is not found where the condition number of its normal equations is larger than this."""
    latest: float = 10.0
    """Detections are tried up to this much too late or too early (s)."""
    late_step: float = 0.25
    """They are tried in steps of this (s)."""
    turned: float = 5.0
    """A sensor that is turned by more than this is told (degrees)."""
    turned_sigma: float = 1.0
    """The turn is told if its standard deviation is at most this (degrees)."""
    arm: float = 1.0
    """A sensor that sits farther than this from the point that the odometry describes is told (m)."""
    arm_sigma: float = 0.2
    """Its place is told if its standard deviation is at most this share of the distance."""
    claimed_less: float = 10.0
    """Covariances are too small if detections of one cone are this number of times as far apart."""
    claimed_more: float = 30.0
    """Covariances are too large if detections of one cone are this number of times nearer to each other."""
    least_scatter: float = 0.02
    """Detections that scatter less than this count as scattering by it (m)."""
    noise_factor: float = 1.5
    """Stated noise of the odometry is wrong if the measured one is larger or smaller by this factor."""
    noise_agreement: float = 1.2
    """Odometry has white noise if its differences of different orders agree up to this factor."""
    scatter_factor: float = 2.0
    """Covariances are wrong if detections scatter by this factor more or less. That is told less well, from
    a few cones, and with the errors of odometry and stamps in it."""
    noise_share: float = 0.75
    """Covariances are wrong if they are so in this share of the detections."""
    noise_cycles: int = 300
    """The noise of detections is measured on at most this number of cycles."""
    both_sides: float = 0.15
    """Cones of one label are on both sides if their share on its own side is so near to a half."""
    near: float = 0.25
    """Two cycles see the same cones if the vehicle moved by less than this share of the usual range between
    them, and turned by less than this (rad)."""
    many: int = 6
    """Such cycles have at least this number of detections together."""
    least_near: int = 30
    """Such pairs of cycles are counted from this number on."""
    unexplained: float = 0.15
    """No motion explains the detections if the best one explains less than this share of them."""
    line: float = 0.1
    """Detections lie on a line if one coordinate varies by less than this share of the other."""
