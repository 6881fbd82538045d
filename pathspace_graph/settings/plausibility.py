"""Settings of the hints: when a log is said to have a certain mistake in it."""

from dataclasses import dataclass

from pathspace_graph.settings.checked import Positive


@dataclass(frozen=True)
class PlausibilitySettings(Positive):
    """Tests of a log before it is mapped."""

    least_twists: int = 20
    """Least number of twists of a log of which anything is said."""
    min_detections: int = 2
    """Least number of detections of a cycle that is compared."""
    most_detections: int = 14
    """Most detections of a cycle that are compared, the nearest ones."""
    cycles: int = 200
    """Approximate number of cycles from which the spacing of the cones is told."""
    gaps: tuple[int, ...] = (1, 2, 4, 8)
    """Numbers of cycles between the two that are compared."""
    pairs: int = 60
    """Approximate number of pairs of cycles that are compared for each of the gaps."""
    longest: float = 1.3
    """Longest time between the cycles of a pair (s), if cycles do not come more rarely."""
    reach: float = 0.2
    """Distance from another detection, over the cones' spacing, that counts as the same by `exp(-1/2)`."""
    overlap: float = 0.5
    """Share of a cycle's detections that another could have seen, from which the two are compared."""
    turn: float = 15.0
    """Step of the angles that the frame of the detections is tried at (degrees)."""
    equal: float = 0.02
    """Difference of explained shares below which hypotheses are equally good."""
    sided: float = 0.2
    """Further share of the labels on its side by which one of equally good hypotheses is better."""
    telling: float = 0.2
    """Difference of explained shares from which a pair tells two hypotheses apart."""
    chance: float = 1e-8
    """Probability of winning as many of the pairs by chance below which a hypothesis is believed."""
    far_better: float = 1.8
    """Least ratio of what a believed hypothesis explains to what the log as it is written does."""
    least_share: float = 0.3
    """Least share of the detections that a believed hypothesis explains."""
    shortest_step: float = 2e-4
    """Shortest usual time between rows (s)."""
    longest_step: float = 5.0
    """Longest usual time between rows (s)."""
    farthest: float = 120.0
    """Usual greatest range of a detector of cones (m)."""
    far: float = 20.0
    """Range within which cones decide between two units that both give possible positions (m)."""
    nearest: float = 0.05
    """Usual least range of cones (m)."""
    fastest: float = 100.0
    """Speed that no vehicle exceeds in a tenth of its time (m/s)."""
    fastest_turn: float = 8.0
    """Yaw rate that no vehicle exceeds in a tenth of its time (rad/s)."""
    iterations: int = 5
    """Gauss-Newton steps that find the mounting of the sensor."""
    least_matches: int = 60
    """Least number of matched detections from which the mounting is found."""
    worst_condition: float = 1e6
    """Largest condition number of the normal equations at which the mounting is found."""
    latest: float = 10.0
    """Largest delay or lead of detections that is tried (s)."""
    late_step: float = 0.25
    """Step of these (s)."""
    turned: float = 5.0
    """Turn of the sensor beyond which it is told (degrees)."""
    turned_sigma: float = 1.0
    """Largest standard deviation of the turn at which it is told (degrees)."""
    arm: float = 1.0
    """Distance of the sensor from the point that the odometry describes beyond which it is told (m)."""
    arm_sigma: float = 0.2
    """Largest standard deviation of its place at which it is told, as a share of the distance."""
    claimed_less: float = 10.0
    """Ratio of one cone's scatter to the claimed one from which covariances are too small."""
    claimed_more: float = 30.0
    """Ratio of the claimed scatter to one cone's from which covariances are too large."""
    least_scatter: float = 0.02
    """Scatter that detections which scatter less count as (m)."""
    noise_factor: float = 1.5
    """Factor between measured and stated noise of the odometry from which the stated one is wrong."""
    noise_agreement: float = 1.2
    """Largest factor between the noise by differences of different orders where odometry has white noise."""
    scatter_factor: float = 2.0
    """Factor between the scatter of detections and their covariances from which these are wrong. It is told
    less well, from a few cones, and with the errors of odometry and stamps in it."""
    noise_share: float = 0.75
    """Share of the detections from which on wrong covariances are told."""
    noise_cycles: int = 300
    """Most cycles on which the noise of detections is measured."""
    both_sides: float = 0.15
    """Distance from a half of the share of a label's cones on its own side at which they are on both."""
    near: float = 0.25
    """Move by a share of the usual range, and turn (rad), below which two cycles see the same cones."""
    many: int = 6
    """Least number of detections that such cycles have together."""
    least_near: int = 30
    """Least number of such pairs of cycles that are counted."""
    unexplained: float = 0.15
    """Share of the detections that the best motion must explain, or else none does."""
    line: float = 0.1
    """Ratio of the variations of two coordinates below which detections lie on a line."""
