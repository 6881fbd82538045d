"""The least-squares problem of one or several logs, and its optimum by Gauss-Newton in rounds."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import gtsam
import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.batch.association import (
    DIRECTION_PENALTY,
    associate,
    cone_stations,
    headings,
    locate_poses,
    nearest_by,
)
from pathspace_graph.batch.simplification import reknot
from pathspace_graph.errors import SettingsError, SingularSystemError
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.linear import keys_of_factor
from pathspace_graph.factors.noise import huber_loss, huber_weights
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.se2 import rotation, to_map
from pathspace_graph.factors.sensor import SENSOR_SIZE
from pathspace_graph.front_end.log_odometry import LogOdometry, half_square, sensor_prior
from pathspace_graph.graph.elimination import Elimination, bayes_net, fix_map, linear_graph, owners, step_by
from pathspace_graph.graph.rows import Revisit, Rows, at_values, by_widths, odometry_factor, revisit_rows
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    POINT,
    POSE,
    Layout,
    are_poses,
    of_sensor,
    pose_key,
)
from pathspace_graph.graph.window import check_keys, check_linear, user_rows
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.mapping.curve_map import CurveMap, curve_factors
from pathspace_graph.mapping.detection_rows import NO_ROWS, DetectionRows, Stations, WeakPriors, rows_across
from pathspace_graph.mapping.detections import NO_STATION, DetectionTable
from pathspace_graph.mapping.state import GivenFactor, State
from pathspace_graph.settings.mapper import GaugeSettings, MapperSettings

LOOSE_GATE: Final = 8.0  # gate of the first round (sigmas)
SETTLE_FEET: Final = 16  # largest number of refinements of the foot points before a step
SETTLED_FOOT: Final = 1e-3  # largest move of a converged foot point (m along the curve)
HELD_SPACING: Final = 0.05  # `gauge.sigma_spacing` of curves without stations

OwnFactors = Sequence[gtsam.NonlinearFactor] | Callable[[State], Sequence[gtsam.NonlinearFactor]]
"""The user's factors in a batch: those on control points are made of its present curves."""


def weak_priors(state: State, settings: GaugeSettings, until: int | None = None) -> dict[int, WeakPriors]:
    """Keep all control points where they are, as seen from the poses of cycles before `until` beside them."""
    return {
        label: WeakPriors.of(state, label, curve.everything, _nearest_poses(state, label, until), settings)
        for label, curve in state.boundaries.items()
    }


def _nearest_poses(state: State, label: int, until: int | None) -> IntArray:
    """Find the pose (m,) in the curve's direction nearest to the point where each control point acts.

    On an open curve, which may have drifted over itself, its parameter is within the mean distance of control
    points of the nearest parameter.
    """
    boundary, points, poses = state.boundaries[label], state.control_points(label), state.poses[:until]
    u, pose_u, heads = boundary.abscissae, state.pose_u[label][:until], headings(poses)
    position, tangent = (boundary.evaluate(points, u, order) for order in (0, 1))
    away, _ = map(np.asarray, KDTree(pose_u[:, None]).query(u[:, None]))
    room = away + (np.inf if boundary.periodic else float(np.mean(boundary.nominal)))

    def unfit(i: IntArray, j: IntArray) -> Array:
        """Penalty (m^2) of poses j that drive against the curve beside control points i, or elsewhere."""
        against = np.where((tangent[i] * heads[j]).sum(axis=-1) <= 0.0, DIRECTION_PENALTY**2, 0.0)
        return np.where(np.abs(u[i] - pose_u[j]) > room[i], np.inf, against)

    return nearest_by(position, poses[:, :2], unfit)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The problem at one state."""

    state: State
    across: DetectionRows  # used detections across the curves; infinite sigma beyond an end
    u: Array  # (m,) parameters of their foot points (m)
    along: DetectionRows  # used detections at their stations
    drive: list[Rows]  # rows of odometry, priors, revisits, and of the user's factors
    cost: float  # half the sum of squares, with the robust losses of the detections and of the user's factors
    own_cost: float  # share of the user's factors


class BatchSystem:
    """Problem of minimizing `sum rho(detections) + 1/2 |odometry, revisits, gauge, priors|^2`.

    Cycles are numbered consecutively over all drives, without odometry from one drive to the next. Each drive
    has its own calibration; drives of one vehicle share the sensor's.
    """

    def __init__(
        self,
        detections: DetectionTable,
        chains: Sequence[LogOdometry],
        priors: Sequence[MapperSettings],
        revisits: Sequence[Revisit] = (),
        given: Sequence[GivenFactor] = (),
        own: OwnFactors = (),
    ) -> None:
        self.detections = detections
        self.chains = [*chains]  # odometry of each drive
        self.priors = [*priors]  # settings of each drive, for the priors of its calibrations
        self.revisits = tuple(revisits)  # relative poses of cycles on the same road
        self.own: tuple[gtsam.NonlinearFactor, ...] = ()  # the user's factors, linearized at every step
        self._own, self._given = own, given
        self._given_rows: list[Rows] = []  # the user's factors of an online drive, at values of zero
        self.gate = LOOSE_GATE  # of the detections in use (sigmas)
        self.weak: dict[int, WeakPriors] = {}  # of the control points of each boundary
        self.stations: Stations | None = None  # stations of closed curves, if they are used
        self._sigma = np.ones((2, len(detections)))  # across and along the curves, of this round (m)

    def widen_priors(self, drive: int, settings: MapperSettings) -> None:
        """Take the priors of a drive's calibrations from other settings."""
        sigma = np.array(settings.odometry.sigmas)
        self.priors[drive] = settings
        self.chains[drive] = replace(self.chains[drive], calibration_sigma=sigma)

    def begin(self, state: State, stations: bool = False) -> None:
        """Rebuild weak priors and the user's factors on the present control points, after knots have changed.

        With `stations`, the cones of closed curves constrain the detections along them. SettingsError for a
        user's factor that cannot be used.
        """
        self.own, variables = tuple(self._own(state) if callable(self._own) else self._own), state.variables
        check_keys(self.own, variables.keys, "poses, control points and calibrations of the batch")
        check_linear(self.own, lambda one: variables.gtsam_values(keys_of_factor(one)), constant=False)
        self._given_rows = by_widths([rows for one in self._given for rows in one.on(state)])
        self.stations = cone_stations(state, self.detections, self.settings) if stations else None
        self.weak = weak_priors(state, self.gauge)

    @property
    def gauge(self) -> GaugeSettings:
        """Settings of the weak priors. Only stations determine a slide, so only they leave room for one."""
        gauge = self.settings.gauge
        return gauge if self.stations is not None else replace(gauge, sigma_spacing=HELD_SPACING)

    @property
    def settings(self) -> MapperSettings:
        """Settings of the problem, those of the first drive."""
        return self.priors[0]

    def drive_rows(self, state: State) -> list[Rows]:
        """Rows of odometry and calibrations of each drive; only the first has a prior of its first pose."""
        groups, variables, sensors = list[Rows](), state.variables, state.drives.sensors
        calibrations = variables.calibration.reshape(-1, CALIBRATION_SIZE)
        for d, part in enumerate(state.drives.parts(len(state.poses))):
            chain, poses, calibration = self.chains[d], state.poses[part], calibrations[d]
            if d == 0:
                groups += chain.rows(poses, calibration)
                continue
            own = [chain.odometry_rows(poses, calibration), *chain.calibration_priors(calibration)]
            for rows in own:  # numbered as those of a drive alone
                keys = rows.keys + np.where(are_poses(rows.keys), part.start, d)
                groups.append(replace(rows, keys=keys, owner=rows.owner + owners(np.array(part.start))))
        for number in range(len(variables.sensor) // SENSOR_SIZE):  # each by its first drive
            prior = self.priors[sensors.index(number)].calibration
            groups.append(sensor_prior(of_sensor(variables.sensor, number), prior, number))
        return groups

    def evaluate(self, state: State, hold: bool = False) -> Evaluation:
        """Evaluate the problem at a state; foot points are refined from the parameters of the detections.

        `hold` fixes the sigmas for later evaluations. Their dependence on the curve's direction has no
        derivative.
        """
        drive = self.drive_rows(state) + revisit_rows(self.revisits, state.poses)
        drive += [at_values(rows, state.variables) for rows in self._given_rows]
        across, u = self._across(state, hold) if state.boundaries else (NO_ROWS, np.zeros(0))
        along = self._along(state, self.stations, hold) if self.stations else NO_ROWS
        unused = len(self.detections) - int(np.isfinite(across.sigma).sum())  # each as one at the gate
        whitened = np.concatenate([across.whitened, along.whitened, np.full(unused, self.gate)])
        cost = half_square(drive) + float(huber_loss(whitened, self.settings.gate.huber).sum())
        cost += half_square(self._priors(state, self.weak))
        own_rows, own_cost = by_widths(user_rows(self.own, state.variables)), 0.0
        if self.own:
            values = state.variables.gtsam_values(state.variables.keys)
            own_cost = sum(factor.error(values) for factor in self.own)
        drive += [at_values(rows, state.variables) for rows in own_rows]
        return Evaluation(state, across, u, along, drive, cost + own_cost, own_cost)

    def _across(self, state: State, hold: bool) -> tuple[DetectionRows, Array]:
        """Linearize used detections across the curves; return them and the foot points' parameters (m,).

        Sigmas are fixed during a round, and so is whether a foot point is interior. So the cost does not jump
        when an open end slides past a detection.
        """
        detections = self.detections
        rows = np.flatnonzero(detections.used)
        points = detections.points_map(rows, state.variables)
        foot = self._feet(state, rows, points)
        seen = rows_across(state, detections, rows, points, foot, self.settings.spline.sigma_model)
        if hold:
            self._sigma[0, rows] = np.where(foot.interior, seen.sigma, np.inf)
        return replace(seen, sigma=self._sigma[0, rows]), foot.u

    def _feet(self, state: State, rows: IntArray, points: Array) -> FootPoints:
        """Refine the foot points of used detections (m,) at points (m, 2)."""
        detections, curves = self.detections, state.curves
        u, s = detections.u[rows], next(iter(state.boundaries.values())).settings
        curve = curves.labels.searchsorted(detections.boundary[rows])
        stretch = u, u - s.refine_room, np.minimum(u + s.refine_room, state.trusted[curve])
        search = *stretch, s.refine_iterations
        return FootPoints(*curves.searched.refine(state.map_points, points, curve, *search))

    def associate(self, state: State, gate: float, strict: bool) -> int:
        """Associate all detections again by `association:associate`; return the number that has changed.

        The foot points are refined until they converge; otherwise the cost would change without a step.
        """
        detections = self.detections
        before = np.where(detections.used, detections.boundary, UNKNOWN)
        self.gate = gate
        detections.correct(state.variables.sensor)
        associate(state, detections, self.settings, gate, strict)
        used = rows = np.flatnonzero(detections.used)
        for _ in range(SETTLE_FEET if state.boundaries else 0):
            u = detections.u[rows]
            foot = self._feet(state, rows, detections.points_map(rows, state.variables))
            detections.refine(rows, foot.u)
            rows = rows[np.abs(foot.u - u) > SETTLED_FOOT]
            if len(rows) == 0:
                break
        if self.stations is not None:
            foot = self._feet(state, used, detections.points_map(used, state.variables))
            self.stations.match(state, detections, used, foot.tangent_unit)
        return int((np.where(detections.used, detections.boundary, UNKNOWN) != before).sum())

    def _along(self, state: State, stations: Stations, hold: bool) -> DetectionRows:
        """Linearize the used detections at their stations, with the sigmas of this round."""
        rows = np.flatnonzero(self.detections.used & (self.detections.station != NO_STATION))
        seen = stations.rows(state, self.detections, rows)
        if hold:
            self._sigma[1, rows] = seen.sigma
        return replace(seen, sigma=self._sigma[1, rows])

    def rows(self, at: Evaluation, weak: Mapping[int, WeakPriors] | None = None) -> list[Rows]:
        """All whitened rows of Gauss-Newton at a state; rows of detections have robust weights."""
        groups = [*at.drive]
        for seen in (at.along, at.across):
            owner = owners(self.detections.cycle[seen.rows], self.detections.boundary[seen.rows])
            groups.append(seen.weighted(huber_weights(seen.whitened, self.settings.gate.huber), owner))
        return groups + self._priors(at.state, weak or self.weak)

    def _priors(self, state: State, weak: Mapping[int, WeakPriors]) -> list[Rows]:
        """Rows of the weak priors, by label."""
        groups = [(label, rows) for label, one in weak.items() for rows in one.rows(state.variables)]
        return [replace(rows, owner=owners(rows.owner, label)) for label, rows in groups]

    def linear_graph(self, at: Evaluation) -> gtsam.GaussianFactorGraph:
        """Linear graph of all rows; its solution is the change from the state."""
        return linear_graph(self.rows(at), at.state.variables)

    def eliminated(self, at: Evaluation) -> Elimination:
        """Linear problem with its poses eliminated."""
        return Elimination(self.linear_graph(at), at.state.variables.layout)

    def damping(self, state: State, sigma: float) -> list[Rows]:
        """Rows that damp the motion of control points relative to the poses beside them, to sigma (m)."""
        groups = list[Rows]()
        for label, one in self.weak.items():
            root = np.tile(np.eye(POINT) / sigma, (len(one.keys), 1, 1))
            rows = replace(one, whitener=root).places(state.variables)
            groups.append(replace(rows, residual=np.zeros(len(rows)), owner=owners(rows.owner, label)))
        return groups

    def retract(self, state: State, step: Array) -> State:
        """Return the state after a step (n,) in relative coordinates.

        A pose changes relative to the pose before, a control point relative to the pose beside it. So the map
        keeps its shape in a rotation by a large angle.
        """
        linear = moved(state, step)
        after, poses, goal = linear.copy(), state.poses, linear.poses
        for part in state.drives.parts(len(poses)):
            own, aim = poses[part], goal[part]
            driven = seen_after_step(own[1:, :2], own[:-1], aim[1:, :2], aim[:-1])
            after.poses[part][1:, :2] = aim[0, :2] + np.cumsum(turned(driven, aim[:-1, 2]), axis=0)
        for label, one in self.weak.items():
            points, k = after.control_points(label), one.cycle
            seen = seen_after_step(state.control_points(label), poses[k], points, goal[k])
            points[:] = to_map(seen, after.poses[k])
        return after

    def poses_alone(self, at: Evaluation) -> Array:
        """Step (3 P,) of the poses with fixed map and calibration."""
        rows, variables = fix_map(self.rows(at)), at.state.variables
        layout = Layout(variables.keys[are_poses(variables.keys)])
        return step_by(bayes_net(linear_graph(rows, variables), layout), rows, layout)[0]


def seen_after_step(points: Array, poses: Array, points_after: Array, poses_after: Array) -> Array:
    """Transform points (m, 2), map frame, to the frames of poses (m, 3) after a step, to first order."""
    arm, change = points - poses[:, :2], points_after - points - poses_after[:, :2] + poses[:, :2]
    turn = (poses_after[:, 2] - poses[:, 2])[:, None]
    return turned(arm + change + turn * np.column_stack([arm[:, 1], -arm[:, 0]]), -poses[:, 2])


def turned(vectors: Array, angles: Array) -> Array:
    """Rotate vectors (m, 2), each by its angle (m,) in rad."""
    return to_map(vectors, np.column_stack([np.zeros((len(angles), 2)), angles]))


def moved(state: State, step: Array) -> State:
    """Return the state after a step (n,) of all variables, or of the poses alone, in map coordinates."""
    after = state.copy()
    after.variables.values[len(after.variables.values) - len(step) :] += step
    return after


# --- the problem as GTSAM's own factors ------------------------------------------------------------------


def nonlinear_graph(system: BatchSystem, at: Evaluation) -> gtsam.NonlinearFactorGraph:
    """Build every factor of the problem, on the keys of `graph.variables`.

    It has the associations of `at`. At an optimum it has the linearization of the optimization, and its error
    is the cost, without the constant share of detections that are not in use. SettingsError for several
    drives.
    """
    factors, graph = [*drive_factors(system, at)], gtsam.NonlinearFactorGraph()
    track = CurveMap(system.settings, at.state)
    track.detections, track.stations, track.weak = system.detections, system.stations, system.weak
    for label in at.state.boundaries:
        factors += curve_factors(track, label)
    for factor in factors:
        graph.add(factor)
    return graph


def drive_factors(system: BatchSystem, at: Evaluation) -> Iterator[gtsam.NonlinearFactor]:
    """Yield factors of poses and calibrations, and the user's; SettingsError for several drives."""
    if len(at.state.drives) > 1:
        raise SettingsError(f"graph: expected the batch of one drive, found {len(at.state.drives)} drives")
    for k, interval in enumerate(system.chains[0].odometry.intervals):
        yield odometry_factor(k, interval)
    for one in system.revisits:
        root = one.root.copy()  # GTSAM's tangents are in the frame of the later pose
        root[:, :2] = root[:, :2] @ rotation(one.local[2])
        noise = gtsam.noiseModel.Gaussian.Information(root.T @ root)
        ends = pose_key(one.earlier), pose_key(one.later)
        yield gtsam.BetweenFactorPose2(*ends, gtsam.Pose2(*one.local), noise)
    chain, calibration, noises = system.chains[0], system.settings.calibration, gtsam.noiseModel
    map_from_pose = np.eye(POSE)  # GTSAM's tangents of a pose are in its own frame
    map_from_pose[:2, :2] = rotation(at.state.poses[0, 2])
    noise = noises.Gaussian.Information(map_from_pose.T @ chain.first_information @ map_from_pose)
    yield gtsam.PriorFactorPose2(pose_key(0), gtsam.Pose2(*chain.first), noise)
    sigmas = noises.Diagonal.Sigmas(chain.calibration_sigma)
    yield gtsam.PriorFactorPoint2(CALIBRATION_KEY, chain.calibration_mean, sigmas)
    if chain.bias is not None:
        row = gtsam.JacobianFactor(  # an infinite sigma of the scale would make text that GTSAM cannot read
            CALIBRATION_KEY,
            np.array([[0.0, 1.0]]),
            np.array([chain.bias.value - chain.calibration_mean[1]]),
            noises.Isotropic.Sigma(1, chain.bias.sigma),
        )
        about = gtsam.Values()
        about.insert(CALIBRATION_KEY, np.asarray(chain.calibration_mean))
        yield gtsam.LinearContainerFactor(row, about)
    sensor_key = at.state.variables.sensor_key
    if sensor_key is not None:
        sigmas = noises.Diagonal.Sigmas(np.array(calibration.sigmas))
        yield gtsam.PriorFactorVector(sensor_key, np.array(calibration.means), sigmas)
    yield from system.own


# --- the optimum --------------------------------------------------------------------------------------------


GATE_FACTOR: Final = 0.7  # factor of the gate from each round to the next, down to `batch.gate`
CHANGED_SHARE: Final = 1e-3  # largest share of detections that change in the last round of associations
SIGMAS_DAMPED: Final = (10.0, 1.0, 0.1)  # of a step of a control point beside its pose, while singular (m)
TOLERANCE_DECREASE: Final = 0.05  # largest predicted decrease of the cost in the last step; one sigma is 1/2
GAIN: Final = 0.8  # least decrease of the cost, relative to the predicted one, to keep the information
ROUGH_TOLERANCE: Final = 100.0  # factor of the tolerance while knots or stations still change
CREEP_SHARES: Final = (0.3, 0.97)  # ratio of a step to the last one between which it is extrapolated


@dataclass(frozen=True, eq=False)
class Convergence:
    """End of an optimization."""

    converged: bool
    reason: str
    rounds: int  # number of refreshes of foot points, gates and weights
    steps: int  # Gauss-Newton steps, including rejected lengths
    cost: float  # half the sum of squares with robust losses at the end
    gradient: float
    """Norm `sqrt(g' H^-1 g)` of the gradient g, with the information H of all variables: the length of the
    last step in joint sigmas. A slow motion of the whole map counts as much as the motion of one control
    point."""


@dataclass(frozen=True)
class Effort:
    """Limits of the search for the optimum of a log."""

    rough_rounds: int = 24  # largest number of rounds of the first optimization, on the knots of the start
    rounds: int = 80  # largest number of rounds of later ones; all used means not converged
    tolerance: float = 1.0  # factor of the tolerance


@dataclass(frozen=True)
class Stage:
    """Part of a search: what changes before it, and what ends it."""

    gate: float  # gate of the first round (sigmas); it shrinks to `batch.gate`
    rounds: int  # largest number of rounds
    tolerance: float = 1.0  # factor of the tolerance
    refit: bool = False  # whether curves are first fitted again through their cones
    stations: bool = False  # whether detections are matched to the cones of closed curves


class Optimizer:
    """Gauss-Newton from a state to the minimum; `on_round` is called after each round."""

    def __init__(
        self, system: BatchSystem, effort: Effort | None = None, on_round: Callable[[], None] | None = None
    ) -> None:
        self.system, self.settings = system, system.settings.batch
        self.effort, self._on_round = effort or Effort(), on_round
        self.steps = 0  # number of steps tried
        self._last_step: Array | None = None  # last step of the map and the calibration
        self._net: gtsam.GaussianBayesNet | None = None  # information of an earlier step, for the next one

    def find(self, state: State) -> tuple[Evaluation, Convergence]:
        """Find the optimum on curves with about one knot for each cone, which meet the cones.

        On closed curves, stations constrain the detections along them in the last stage.
        """
        gate, rounds, rough = self.settings.gate, self.effort.rounds, self.effort.tolerance * ROUGH_TOLERANCE
        first_gate = gate if self.system.revisits else LOOSE_GATE
        state = self.align_poses(state, first_gate)
        at, _ = self.run(state, Stage(first_gate, self.effort.rough_rounds, rough, refit=True))
        curves = state.boundaries.values()
        stations = self.system.settings.stations and bool(curves) and all(one.periodic for one in curves)
        return self.run(at.state, Stage(gate, rounds, self.effort.tolerance, refit=True, stations=stations))

    def align_poses(self, state: State, gate: float) -> State:
        """Take one Gauss-Newton step of the poses alone, with fixed map and calibration."""
        self.system.begin(state)
        locate_poses(state)
        self.system.associate(state, gate, strict=False)
        return moved(state, self.system.poses_alone(self.system.evaluate(state, hold=True)))

    def run(self, state: State, stage: Stage) -> tuple[Evaluation, Convergence]:
        """Optimize in rounds until a step is short, and return the problem after it.

        Each round takes one step. The gate (sigmas) shrinks to that of the settings (graduated
        non-convexity), and the search ends only afterwards. When hardly any association changes, all of them
        and the sigmas are fixed: between two near rows, some would change forever.
        """
        system, gate, rounds = self.system, stage.gate, stage.rounds
        tolerance = TOLERANCE_DECREASE * stage.tolerance
        if stage.refit:
            state = reknot(state, system.detections, system.settings)
        locate_poses(state)
        system.begin(state, stage.stations)
        self._net, self._last_step, searching, converged, stuck, done = None, None, True, False, False, 0
        while not (converged or stuck) and done < rounds:
            done, gate = done + 1, max(gate, self.settings.gate)
            strict = gate <= self.settings.gate
            if searching:
                if not strict and done > 1:
                    locate_poses(state)
                changed = system.associate(state, gate, strict)
                at = system.evaluate(state, hold=True)
                settled = strict and changed <= CHANGED_SHARE * len(system.detections)
                self._net = self._net if settled else None
                searching = not (settled or (strict and done > rounds // 2))
            at, decrease = self._step(at)
            stuck, state = not searching and at.state is state, at.state
            if self._on_round is not None:
                self._on_round()
            converged = not searching and decrease <= tolerance
            gate *= GATE_FACTOR
        reason = "no part of the last step decreases the cost" if stuck else "no round left"
        reason = "nothing changes any more" if converged else reason
        norm = float(np.sqrt(2.0 * max(decrease, 0.0)))
        return at, Convergence(converged, reason, done, self.steps, at.cost, norm)

    def _step(self, at: Evaluation) -> tuple[Evaluation, float]:
        """Take a Gauss-Newton step, halved until the cost does not grow; return the decrease it predicts.

        The problem stays as it is if no part of the step decreases the cost. While the information of a step
        predicts the decrease well, the next one has only a new gradient. On a long road, a whole step turns
        the map by more than its linearization holds for, and round-off may leave a control point free: then
        the step is damped, and the decrease infinite, since it may be short without convergence.
        """
        system, state, layout, cost = self.system, at.state, at.state.variables.layout, at.cost
        system.detections.refine(at.across.rows, at.u)  # later evaluations refine these foot points
        rows = system.rows(at)
        for sigma in (np.inf, *SIGMAS_DAMPED):
            damped = system.damping(state, sigma) if sigma < np.inf else []
            try:
                net = self._net or bayes_net(linear_graph([*rows, *damped], state.variables), layout)
                break
            except SingularSystemError:
                if sigma == SIGMAS_DAMPED[-1]:
                    raise
        step, decrease = step_by(net, rows, layout)
        decrease = np.inf if damped else decrease
        before, self._last_step = self._last_step, None
        for share in 0.5 ** np.arange(8):
            self.steps += 1
            trial = system.evaluate(system.retract(state, share * step))
            if trial.cost <= cost:
                break
        else:
            if self._net is None:
                return at, decrease
            self._net = None
            return self._step(at)
        self._net = net if cost - trial.cost > GAIN * decrease else None
        if share == 1.0:
            self._last_step = step[: layout.size - state.poses.size]
            factor = 1.0 if before is None else extrapolation_factor(self._last_step, before)
            if factor != 1.0:
                other = system.evaluate(system.retract(state, factor * step))
                trial = min(trial, other, key=lambda evaluation: evaluation.cost)
        system.detections.refine(trial.across.rows, trial.u)
        return trial, decrease


def extrapolation_factor(step: Array, before: Array) -> float:
    """Factor `1 / (1 - r)` of a step (n,), where r is its ratio to the step before (Aitken's process).

    r is found by least squares. The factor is 1 if |r| is not between `CREEP_SHARES`. Robust weights, fixed
    sigmas and foot points on a bend make Gauss-Newton converge only linearly: it creeps (r > 0), or
    oscillates (r < 0) and a shorter step ends it.
    """
    square = float(before @ before)
    share = float(step @ before) / square if square > 0.0 else 0.0
    return 1.0 / (1.0 - share) if CREEP_SHARES[0] < abs(share) < CREEP_SHARES[1] else 1.0
