"""Registration: a drifted window beside hand-made curves is found back, or rightly refused."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import compose
from pathspace_graph.graph.variables import CALIBRATION_KEY, pose_keys
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping import path as path_module
from pathspace_graph.mapping import registration
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.registration import (
    Matches,
    Motion,
    RefinedMotion,
    Registration,
    Sightings,
    agrees,
    is_certain,
    is_within_reach,
    near_start,
    passes_start,
    register,
)
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.online import ClosingSettings

from ..scenes.drives import detections
from ..scenes.maps import boundary_through

Array = NDArray[np.float64]

RADIUS, HALF_WIDTH = 20.0, 2.0
SIDES = {LEFT: -HALF_WIDTH, RIGHT: HALF_WIDTH}
"""Counterclockwise, the left boundary is the inner one."""
POSES = 20
Shape = tuple[float, int]
OVAL: Shape = (0.35, 2)
CIRCLE: Shape = (0.0, 2)
WAVES: Shape = (0.025, 16)
"""Waves of 7.9 m and 0.5 m on a circle: turned by one wave, it is the same."""
PRIOR = np.diag([0.5, 0.5, 0.05]) ** 2


def motion(x: float, y: float, theta: float, centre: Array | None = None) -> Motion:
    return Motion(np.zeros(2) if centre is None else centre, np.array([x, y, theta]))


@dataclass
class Window:
    """Holds curves of one lap and a quarter, and poses at the beginning again, a metre apart."""

    track: CurveMap
    times: list[float]
    truth: Array
    """(P, 3) These are the poses before they drifted."""
    shape: Shape

    @property
    def poses(self) -> Array:
        return self.track.state.poses

    def drift(self, by: Motion) -> None:
        """Moves all poses rigidly, as an error of the odometry does."""
        self.poses[:, :2] = by.apply(self.poses[:, :2])
        self.poses[:, 2] += by.vector[2]

    def register(self, covariance: Array = PRIOR, **settings: float) -> RefinedMotion | None:
        closing = ClosingSettings(**settings)  # type: ignore[arg-type]
        beginning = self.truth[:1] if np.trace(covariance[:2, :2]) < 9.0 else drive(0.0, 1.4, 40, self.shape)
        return register(self.track, self.times, covariance, beginning, closing)


def rim(side: float, shape: Shape, phi: Array) -> Array:
    """Returns points (k, 2) of an oval `(RADIUS + side) (1 + dent cos(waves phi))` at angles (k,)."""
    dent, waves = shape
    r = (RADIUS + side) * (1.0 + dent * np.cos(waves * phi))
    return np.column_stack([r * np.cos(phi), r * np.sin(phi)])


def drive(begin: float, end: float, count: int, shape: Shape) -> Array:
    """Returns poses (count, 3) on the middle line, along it."""
    phi = np.linspace(begin, end, count)
    xy = rim(0.0, shape, phi)
    ahead = rim(0.0, shape, phi + 1e-5) - xy
    return np.column_stack([xy, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))])


def window(shape: Shape = OVAL) -> Window:
    """Returns a window whose detections lie exactly on the curves; a seventh has no colour.

    The newest curves explain all that have one.
    """
    state = State()
    poses = drive(0.1, 1.2, POSES, shape)
    state.variables.insert(np.array([CALIBRATION_KEY]), np.zeros(2))
    state.variables.insert(pose_keys(np.arange(POSES)), poses.ravel())
    for label, side in SIDES.items():
        state.add_boundary(label, *boundary_through(rim(side, shape, np.linspace(0.0, 2.5 * np.pi, 150))))
    track = CurveMap(MapperSettings(), state)
    for k, (x, y, theta) in enumerate(poses):
        c, s = np.cos(theta), np.sin(theta)
        ahead = np.arctan2(y, x) + np.array([0.1, 0.4, 0.7, 0.7])
        seen = np.concatenate(
            [rim(side, shape, ahead[:3]) for side in SIDES.values()] + [rim(HALF_WIDTH, shape, ahead[3:])]
        )
        labels = np.array([LEFT] * 3 + [RIGHT] * 3 + [UNKNOWN], np.intp)
        seen = (seen - [x, y]) @ np.array([[c, -s], [s, c]])
        track.detections.append(detections(0.1 * k, seen, labels), k)
    track.detections.used[:] = track.detections.label != UNKNOWN
    return Window(track, [0.1 * k for k in range(POSES)], poses.copy(), shape)


# --- motions ---------------------------------------------------------------------------------------------


def test_a_motion_turns_about_its_centre_and_then_moves() -> None:
    moved = motion(1.0, 0.0, np.pi / 2, np.array([2.0, 0.0])).apply(np.array([[2.0, 0.0], [3.0, 0.0]]))
    np.testing.assert_allclose(moved, [[3.0, 0.0], [3.0, 1.0]], atol=1e-12)


# --- registration ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("by", [(0.0, 0.0, 0.0), (0.4, -0.3, 0.02), (-0.5, 0.2, -0.03)])
def test_a_drifted_window_is_moved_back(by: tuple[float, float, float]) -> None:
    scene = window()
    scene.drift(motion(*by, scene.truth[-1, :2]))
    found = scene.register()
    assert found is not None
    np.testing.assert_allclose(found.motion.apply(scene.poses[:, :2]), scene.truth[:, :2], atol=0.12)
    assert found.motion.vector[2] == pytest.approx(-by[2], abs=0.01)


def test_matches_are_coloured_detections_beside_their_own_curve() -> None:
    scene = window()
    scene.drift(motion(0.2, 0.1, 0.01, scene.truth[-1, :2]))
    found = scene.register()
    assert found is not None
    table = scene.track.detections
    for label in SIDES:
        rows, u = found.matches.inliers(label)
        assert len(rows) == 3 * POSES and (table.label[rows] == label).all()
        points = found.motion.apply(table.points_map(rows, scene.track.variables))
        boundary, control_points = (
            scene.track.state.boundaries[label],
            scene.track.state.control_points(label),
        )
        assert np.hypot(*(boundary.evaluate(control_points, u) - points).T).max() < 0.15
        assert u.max() < 60.0


def test_only_the_newest_seconds_are_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registration, "REGISTERED_AGE", 1.0)
    scene = window()
    found = scene.register(sigma_max=1.0)
    assert found is not None
    cycles = scene.track.detections.cycle[
        np.concatenate([found.matches.inliers(label)[0] for label in SIDES])
    ]
    assert set(cycles.tolist()) == set(range(10, POSES))


def test_a_lost_vehicle_is_registered_from_the_best_place_of_the_beginning() -> None:
    """15 m along the track is farther than the iteration bridges; its own uncertainty allows it."""
    scene = window()
    scene.drift(motion(13.0, -7.0, 0.1, scene.truth[-1, :2]))
    assert scene.register() is None
    found = scene.register(np.diag([8.0, 8.0, 0.2]) ** 2)
    assert found is not None
    np.testing.assert_allclose(found.motion.apply(scene.poses[:, :2]), scene.truth[:, :2], atol=0.3)


def test_a_lost_vehicle_is_not_registered_farther_away_than_it_can_be() -> None:
    """It has drifted by 25 m, and its prior is 1.5 times as wide as what it says of itself.

    99.9 % of such drifts are within 4.04 standard deviations: here it is 2.1 or 7.6 of them.
    """
    scene = window()
    scene.drift(motion(22.0, -12.0, 0.1, scene.truth[-1, :2]))
    assert scene.register(np.diag([8.0, 8.0, 0.2]) ** 2) is not None
    assert scene.register(np.diag([2.2, 2.2, 0.2]) ** 2) is None


# --- refusals --------------------------------------------------------------------------------------------


def test_a_circle_tells_no_place_along_it() -> None:
    """The same detections on a circle leave the motion along it as uncertain as it was."""
    assert window().register(PRIOR) is not None
    assert window(CIRCLE).register(PRIOR) is None
    assert window(CIRCLE).register(PRIOR, sigma_max=2.0) is not None


def test_a_place_is_refused_if_the_prior_allows_another_that_fits_as_well() -> None:
    """Both optima are sharp: the prior alone tells how many of them are possible."""
    scene = window(WAVES)
    scene.drift(motion(0.3, -0.2, 0.01, scene.truth[-1, :2]))
    found = scene.register()
    assert found is not None
    np.testing.assert_allclose(found.motion.apply(scene.poses[:, :2]), scene.truth[:, :2], atol=0.4)
    assert scene.register(np.diag([3.0, 3.0, 0.2]) ** 2) is None
    scene = window()
    assert scene.register(np.diag([3.0, 3.0, 0.2]) ** 2) is not None


def test_detections_beside_the_curves_are_refused() -> None:
    """A track of the same shape, but a metre wider to either side."""
    scene = window()
    table = scene.track.detections
    table.measured[table.label == LEFT, 1] += 1.0
    table.measured[table.label == RIGHT, 1] -= 1.0
    assert scene.register() is None


@pytest.mark.parametrize(
    ("count", "outliers", "span", "expected"),
    [
        (30, 0, 10.0, True),
        (24, 0, 10.0, False),
        (30, 5, 10.0, True),
        (30, 8, 10.0, False),
        (30, 0, 7.0, False),
    ],
)
def test_enough_detections_agree_along_enough_of_both_curves(
    count: int, outliers: int, span: float, expected: bool
) -> None:
    """At least 25, 80 % of which are inliers, along 8 m."""
    rows = np.arange(count)
    inlier = rows >= outliers
    u = np.where(rows < count // 2, rows / (count // 2 - 1), (rows - count // 2) / (count - count // 2 - 1))
    labels = (rows >= count // 2).astype(np.intp)
    u[outliers] = 0.0
    matches = Matches(rows, labels, span * u, inlier, np.ones(count, bool), np.eye(3), np.zeros(3))
    assert agrees(matches, [LEFT, RIGHT], ClosingSettings()) is expected


def matches_along(inlier: Array, explained: Array) -> Matches:
    """Returns matches of as many detections on either boundary, in turn, along 10 m of both."""
    count = len(inlier)
    rows = np.arange(count)
    return Matches(rows, rows % 2, np.linspace(0.0, 10.0, count), inlier, explained, np.eye(3), np.zeros(3))


@pytest.mark.parametrize(("explained", "expected"), [(False, True), (True, False)])
def test_only_outliers_that_the_newest_curves_explain_contradict_a_place(
    explained: bool, expected: bool
) -> None:
    """30 inliers, and 20 detections of another stretch of the road."""
    inlier = np.arange(50) < 30
    order = np.random.default_rng(0).permutation(50)
    known = (inlier | explained)[order]
    assert agrees(matches_along(inlier[order], known), [LEFT, RIGHT], ClosingSettings()) is expected


def test_inliers_that_the_newest_curves_do_not_explain_are_no_evidence() -> None:
    """Of 40 inliers 24 or 25 are explained, and 25 are needed."""
    for count, expected in ((24, False), (25, True)):
        known = np.random.default_rng(1).permutation(np.arange(40) < count)
        found = matches_along(np.ones(40, bool), known)
        assert agrees(found, [LEFT, RIGHT], ClosingSettings()) is expected


@pytest.mark.parametrize("bad", [LEFT, RIGHT])
def test_a_place_needs_both_boundaries(bad: int) -> None:
    """One lies 40 detections along 10 m of its curve, the other one only five, along 1 m."""
    good = LEFT + RIGHT - bad
    labels = np.repeat([good, bad], [40, 5])
    u = np.concatenate([np.linspace(0.0, 10.0, 40), np.linspace(0.0, 1.0, 5)])
    known = np.ones(45, bool)
    found = Matches(np.arange(45), labels, u, known, known, np.eye(3), np.zeros(3))
    assert not agrees(found, [LEFT, RIGHT], ClosingSettings())
    assert agrees(found, [good], ClosingSettings())


@pytest.mark.parametrize(("explained", "closes"), [(False, True), (True, False)])
def test_a_window_is_registered_among_clutter_that_no_curve_explains(explained: bool, closes: bool) -> None:
    """In every cycle six more cones stand 1.2 m beside the boundaries, as those of a lane beside would."""
    scene = window()
    for k in range(POSES):
        x, y, theta = scene.truth[k]
        c, s = np.cos(theta), np.sin(theta)
        ahead = np.arctan2(y, x) + np.array([0.15, 0.45, 0.75])
        seen = np.concatenate([rim(1.6 * side, OVAL, ahead) for side in SIDES.values()])
        labels = np.repeat([LEFT, RIGHT], 3).astype(np.intp)
        seen = (seen - [x, y]) @ np.array([[c, -s], [s, c]])
        rows = scene.track.detections.append(detections(0.1 * k, seen, labels), k)
        scene.track.detections.used[rows] = explained
    scene.drift(motion(0.2, 0.1, 0.01, scene.truth[-1, :2]))
    found = scene.register()
    assert (found is not None) is closes
    if found is not None:
        np.testing.assert_allclose(found.motion.apply(scene.poses[:, :2]), scene.truth[:, :2], atol=0.2)


@pytest.mark.parametrize(("sideways", "reached"), [(0.0, True), (2.0, True), (30.0, False)])
def test_nothing_is_registered_out_of_reach_of_the_beginning(sideways: float, reached: bool) -> None:
    """A registration moves nothing where no detection reaches a curve, since its prior has a mean of zero."""
    scene = window()
    scene.drift(motion(sideways, 0.0, 0.0, scene.truth[-1, :2]))
    assert is_within_reach(scene.track, scene.times, ClosingSettings()) is reached
    assert reached or scene.register() is None


def test_a_far_uncertain_detection_weighs_less() -> None:
    """Its information across the curve is that of its own sigma and the registration's together."""
    scene = window()
    hessians = []
    for sigma in (0.1, 1.0, 3.0):
        sightings = Sightings.of_points(np.arange(6), np.array([LEFT] * 3 + [RIGHT] * 3), _seen_points(scene))
        covariances = np.tile(sigma**2 * np.eye(2), (6, 1, 1))
        seen = Sightings(sightings.rows, sightings.labels, sightings.points, covariances, np.ones(6, bool))
        hessians.append(_match_at(scene, seen))
    own = ClosingSettings().sigma_reading ** 2
    for hessian, sigma in zip(hessians[1:], (1.0, 3.0), strict=True):
        np.testing.assert_allclose(hessian, hessians[0] * (own + 0.01) / (own + sigma**2), rtol=1e-9)


def _seen_points(scene: Window) -> Array:
    """Returns the coloured detections (6, 2) of the first cycle, map frame."""
    table = scene.track.detections
    return table.points_map(slice(6), scene.track.variables)


def _match_at(scene: Window, seen: Sightings) -> Array:
    """Returns the information about a motion from sightings where they are."""
    stretches = dict.fromkeys(SIDES, (0.0, 60.0))
    state, unmoved = scene.track.state, motion(0.0, 0.0, 0.0)
    found = Registration(state, seen, stretches, ClosingSettings()).match(unmoved, 1.0)
    return found.hessian


@pytest.mark.parametrize(
    ("again", "sigma", "lost", "certain"),
    [
        (10.0, 0.2, False, True),
        (10.0, 0.5, False, False),
        (50.0, 0.5, False, True),
        (50.0, 5.0, False, False),
        (50.0, 0.5, True, False),
        (50.0, 0.2, True, True),
    ],
)
def test_a_place_must_be_certain_and_less_so_after_a_long_stretch(
    again: float, sigma: float, lost: bool, certain: bool
) -> None:
    """However long a straight is driven again, it tells no place along it; a lost vehicle gets no rebate."""
    rows, inlier = np.arange(30), np.ones(30, bool)
    matches = Matches(rows, rows % 2, np.full(30, again), inlier, inlier, np.eye(3), np.zeros(3))
    assert is_certain(matches, np.diag([0.01, sigma**2, 1.0]), ClosingSettings(), lost) is certain


# --- near the start --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pose", "near"),
    [
        ((0.0, 0.0, 0.0), True),
        ((10.0, 9.0, 0.3), True),
        ((10.0, 12.0, 0.3), False),
        ((10.0, 0.0, np.pi), False),
        ((10.0, 0.0, 2.0 * np.pi), True),
    ],
)
def test_near_the_start_is_a_matter_of_place_and_direction(
    pose: tuple[float, ...], near: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After 80 m straight on, on the first 20 m: within 8 m + 3 % of 80 m, and 0.8 rad."""
    monkeypatch.setattr(path_module, "PATH_MEMORY", 20.0)
    path, frame = DrivenPath(), np.array([3.0, -5.0, 0.7])
    for x in np.arange(0.0, 80.1, 0.5):
        path.update(compose(frame, np.array([x, 0.0, 0.0])))
    there = compose(frame, np.array(pose))
    assert near_start(path, there, ClosingSettings()) is near
    assert not near_start(path, there, ClosingSettings(min_path=100.0))


@pytest.mark.parametrize(
    ("lateral", "row", "passes"),
    [(0.0, 7.0, True), (4.9, 7.0, True), (5.1, 7.0, False), (-5.1, 7.0, False), (4.9, 2.5, False)],
)
def test_the_start_is_not_passed_on_a_neighbouring_lane(lateral: float, row: float, passes: bool) -> None:
    """The drive began at the origin along x; 300 m later it comes back beside it, up to 5 m away.

    Only a row of cones to the left is known. At 7 m it doesn't lie between the lanes, at 2.5 m it does.
    """
    path = DrivenPath()
    loop = [[0.0, 0.0], [100.0, 0.0], [100.0, -50.0], [-20.0, -50.0]]
    corners = np.array([*loop, [-20.0, lateral], [10.0, lateral]])
    for begin, end in pairwise(corners):
        heading = np.arctan2(*(end - begin)[::-1])
        for share in np.linspace(0.0, 1.0, round(float(np.hypot(*(end - begin))) * 2)):
            path.update(np.append(begin + share * (end - begin), heading))
    state, x = State(), np.arange(0.0, 40.0, 4.0)
    state.add_boundary(LEFT, *boundary_through(np.column_stack([x, np.full(10, row)])))
    assert passes_start(state, path, motion(0.0, 0.0, 0.0)) is passes
    assert not passes_start(state, path, motion(0.0, 0.0, 0.6))  # nor across the lane
