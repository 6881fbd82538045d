"""Maps on disk: the contract of FORMATS, held against scipy and against everything a bad file may hold."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import BSpline as ScipyBSpline

from pathspace_graph.errors import InputError
from pathspace_graph.io.files import write_json
from pathspace_graph.io.map import (
    MAP_FILE,
    Map,
    PointBoundary,
    SplineBoundary,
    as_ribbon,
    map_from_json,
    map_to_json,
    read_map,
)
from pathspace_graph.labels import BOUNDARIES, LEFT, ORANGE, RIGHT
from pathspace_graph.spline.bspline import BSpline, fit_spline

from ..scenes.maps import SIGMA, open_map, ring_map


def covariance(size: int, seed: int) -> np.ndarray:
    root = np.random.default_rng(seed).normal(0.0, 0.1, (2 * size, 2 * size))
    return root @ root.T


def closed_spline(seed: int = 0, m: int = 9) -> BSpline:
    rng = np.random.default_rng(seed)
    angle = np.arange(m) * 2 * np.pi / m
    points = 30.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.normal(0.0, 1.0, (m, 2))
    return BSpline.periodic_from(np.concatenate([[0.0], np.cumsum(rng.uniform(5.0, 30.0, m))]), points)


def spline_map() -> Map:
    rng = np.random.default_rng(1)
    opened = BSpline.clamped_from(np.linspace(0.0, 50.0, 6), rng.normal(0.0, 20.0, (7, 2)), degree=2)
    return Map(
        closed=True,
        boundaries={
            RIGHT: SplineBoundary(opened, covariance(7, 2)),
            LEFT: SplineBoundary(closed_spline(), covariance(9, 3)),
        },
    )


def test_a_map_says_up_to_where_a_curve_is_confirmed() -> None:
    """Older maps don't say it: all of their curves is confirmed."""
    track = spline_map()
    right = replace(track.boundaries[RIGHT], confirmed_until=31.5)
    content = map_to_json(Map(False, {**track.boundaries, RIGHT: right}))
    assert content["boundaries"]["right"]["confirmed_until"] == 31.5
    again = map_from_json(content).boundaries
    assert [again[label].confirmed_until for label in (LEFT, RIGHT)] == [closed_spline().domain[1], 31.5]
    del content["boundaries"]["right"]["confirmed_until"]
    assert map_from_json(content).boundaries[RIGHT].confirmed_until == 50.0


@pytest.mark.parametrize("until", [-0.1, 50.1, float("nan"), "far", None, [1.0]])
def test_a_curve_is_confirmed_up_to_a_parameter_of_its_domain(until: Any) -> None:
    content = map_to_json(spline_map())
    content["boundaries"]["right"]["confirmed_until"] = until
    with pytest.raises(InputError, match=r"right\.confirmed_until"):
        map_from_json(content)


def test_the_places_of_cones_are_written_and_older_maps_have_none() -> None:
    track, cones = spline_map(), np.array([[3.0, 0.02], [17.5, 0.1]])
    right = replace(track.boundaries[RIGHT], cones=cones)
    content = json.loads(json.dumps(map_to_json(Map(False, {**track.boundaries, RIGHT: right}))))
    again = map_from_json(content).boundaries
    np.testing.assert_array_equal(again[RIGHT].cones, cones)
    assert again[LEFT].cones.shape == (0, 2)
    assert "cones" not in content["boundaries"]["left"]


@pytest.mark.parametrize("cones", [[[50.1, 0.1]], [[-0.1, 0.1]], [[3.0, -0.1]], [[3.0]], "many", None])
def test_cones_lie_on_their_curve(cones: Any) -> None:
    content = map_to_json(spline_map())
    content["boundaries"]["right"]["cones"] = cones
    with pytest.raises(InputError, match=r"right\.cones"):
        map_from_json(content)


def test_scipy_evaluates_the_written_map_the_same() -> None:
    track = spline_map()
    written = json.loads(json.dumps(map_to_json(track)))
    for name, label in (("left", LEFT), ("right", RIGHT)):
        content, boundary = written["boundaries"][name], track.boundaries[label]
        assert isinstance(boundary, SplineBoundary)
        knots, points, degree = (np.array(content[key]) for key in ("knots", "control_points", "degree"))
        n = len(points)
        assert len(knots) == n + degree + 1
        u = np.linspace(knots[degree], knots[n], 101)
        np.testing.assert_allclose(
            ScipyBSpline(knots, points, int(degree))(u), boundary.spline.evaluate(u), atol=1e-12
        )


@pytest.mark.parametrize("named", ["", MAP_FILE])
def test_what_is_written_is_read_back_exactly(tmp_path: Path, named: str) -> None:
    original = spline_map()
    write_json(tmp_path / MAP_FILE, map_to_json(original))
    track = read_map(tmp_path / named)
    assert track.closed and track.size == 16 and sorted(track.boundaries) == [LEFT, RIGHT]
    for label, boundary in original.boundaries.items():
        read = track.boundaries[label]
        assert isinstance(read, SplineBoundary) and isinstance(boundary, SplineBoundary)
        np.testing.assert_array_equal(read.spline.knots, boundary.spline.knots)
        np.testing.assert_array_equal(read.spline.control_points, boundary.spline.control_points)
        np.testing.assert_array_equal(read.covariance, boundary.covariance)
        assert (read.spline.degree, read.spline.periodic) == (
            boundary.spline.degree,
            boundary.spline.periodic,
        )


def joint_map() -> Map:
    """The same map with the joint covariance of both boundaries, whose blocks are their own."""
    joint, boundaries = covariance(16, 4), spline_map().boundaries
    own = {LEFT: joint[:18, :18], RIGHT: joint[18:, 18:]}
    return Map(True, {k: replace(boundaries[k], covariance=own[k]) for k in own}, joint)


def test_the_joint_covariance_is_read_back_exactly() -> None:
    track = joint_map()
    assert np.shape(map_to_json(track)["cross_covariance"]) == (18, 14)
    again = map_from_json(json.loads(json.dumps(map_to_json(track))))
    np.testing.assert_array_equal(again.joint_covariance, track.joint_covariance)
    assert map_from_json(map_to_json(spline_map())).joint_covariance is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda content: content["cross_covariance"].pop(), "expected 18 rows of 14 finite numbers"),
        (lambda content: content["cross_covariance"][0].pop(), "expected 18 rows of 14 finite numbers"),
        (lambda content: content["cross_covariance"][0].__setitem__(0, 1e3), "positive semidefinite"),
        (lambda content: content["boundaries"].pop("left"), "expected both boundaries, found 1"),
    ],
)
def test_a_cross_covariance_that_is_none(change: Callable[[Any], None], said: str) -> None:
    content = map_to_json(joint_map())
    change(content)
    with pytest.raises(InputError, match=rf"cross_covariance: .*{said}"):
        map_from_json(content)


def test_a_map_of_points_and_an_empty_one_make_the_round_trip() -> None:
    points = np.random.default_rng(5).normal(0.0, 10.0, (4, 2))
    original = Map(False, {RIGHT: PointBoundary(points, covariance(4, 6)), LEFT: _no_points()})
    track = map_from_json(json.loads(json.dumps(map_to_json(original))))
    right = track.boundaries[RIGHT]
    assert isinstance(right, PointBoundary)
    np.testing.assert_array_equal(right.points, points)
    assert (track.size, track.boundaries[LEFT].size) == (4, 0)
    assert map_from_json(map_to_json(Map(False, {}))).size == 0


def _no_points() -> PointBoundary:
    return PointBoundary(np.zeros((0, 2)), np.zeros((0, 0)))


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("format", "pathspace-map/9", "pathspace-map/1"),
        ("closed", 1, "closed"),
        ("boundaries.middle", {}, "expected one of left|right"),
        ("boundaries.left", {}, "boundaries.left.degree: expected, but missing"),
        ("boundaries.left.degree", 0, "boundaries.left.degree"),
        ("boundaries.left.degree", 2.5, "boundaries.left.degree"),
        ("boundaries.left.knots", [0.0, 1.0], "boundaries.left: "),
        ("boundaries.left.knots", [1e9], "boundaries.left.knots[0]"),
        ("boundaries.left.knots", [float("nan")], "row 1: expected JSON"),
        ("boundaries.left.control_points", [[1.0]], "boundaries.left.control_points[0]"),
        ("boundaries.left.size", 12, "boundaries.left.size: expected 9 (what is listed), found 12"),
        ("boundaries.left.covariance", np.eye(18)[:17].tolist(), "covariance: expected 18 rows of 18"),
        ("boundaries.left.covariance", (np.eye(18) + np.eye(18, k=1)).tolist(), "symmetric"),
        ("boundaries.left.covariance", (-np.eye(18)).tolist(), "positive"),
    ],
)
def test_a_bad_map_is_refused_by_name(tmp_path: Path, path: str, value: Any, named: str) -> None:
    content: Any = map_to_json(spline_map())
    *parents, last = path.split(".")
    reduce(getitem, parents, content)[last] = value
    (tmp_path / "map.json").write_text(json.dumps(content))
    with pytest.raises(InputError) as refusal:
        read_map(tmp_path)
    assert named in str(refusal.value)
    assert refusal.value.file == tmp_path / "map.json"
    assert "\n" not in str(refusal.value)


def test_what_is_no_map_at_all_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"map\.json"):
        read_map(tmp_path / "nowhere")
    (tmp_path / "map.json").write_text("[1, 2]")
    with pytest.raises(InputError, match="object"):
        read_map(tmp_path)


def test_cones_of_no_boundary_are_read_back() -> None:
    cones = {ORANGE: PointBoundary(np.array([[1.0, 2.0]]), 0.04 * np.eye(2))}
    content = json.loads(json.dumps(map_to_json(replace(spline_map(), points=cones))))
    again = map_from_json(content).points
    np.testing.assert_array_equal(again[ORANGE].points, cones[ORANGE].points)
    np.testing.assert_array_equal(again[ORANGE].covariance, cones[ORANGE].covariance)
    content["points"]["left"] = content["points"].pop("orange")
    with pytest.raises(InputError, match=r"points: expected one of orange\|big_orange"):
        map_from_json(content)


# --- after a motion of the frame -------------------------------------------------------------------------

QUARTER = np.array([1.0, 2.0, 0.5 * np.pi])


def test_points_and_covariances_turn_with_the_frame() -> None:
    """A point that is uncertain along x is so along y after a quarter turn; what is joint stays joint."""
    points, joint = np.array([[3.0, 0.0], [0.0, 4.0]]), np.diag([4.0, 1.0, 9.0, 1.0])
    joint[0, 2] = joint[2, 0] = 2.0
    line, _ = fit_spline(np.column_stack([np.arange(8.0), np.zeros(8)]), 5, False)
    boundaries = {LEFT: SplineBoundary(line, np.eye(10)), RIGHT: PointBoundary(points, joint)}
    cones = {ORANGE: PointBoundary(points, joint)}
    found = Map(False, boundaries, np.eye(14), cones).moved(QUARTER)
    right = found.boundaries[RIGHT]
    assert isinstance(right, PointBoundary)
    for own in (right, found.points[ORANGE]):
        np.testing.assert_allclose(own.points, [[1.0, 5.0], [-3.0, 2.0]], atol=1e-12)
        np.testing.assert_allclose(np.diag(own.covariance), [1.0, 4.0, 1.0, 9.0], atol=1e-12)
        assert own.covariance[1, 3] == 2.0
    np.testing.assert_allclose(found.splines[LEFT].evaluate(np.array([0.0])), [[1.0, 2.0]], atol=1e-9)
    np.testing.assert_allclose(found.splines[LEFT].length(), line.length())
    np.testing.assert_allclose(found.joint_covariance, np.eye(14), atol=1e-12)


# --- one centre line with a width ------------------------------------------------------------------------


RADII = {LEFT: 18.0, RIGHT: 22.0}


def curve_of(track: Map, label: int) -> SplineBoundary:
    return track.curve(label, "a test")


def test_the_edges_of_a_ribbon_are_the_boundaries() -> None:
    track = as_ribbon(ring_map(), SIGMA)
    assert track.closed and track.joint_covariance is not None
    for label, radius in RADII.items():
        spline = curve_of(track, label).spline
        at = np.linspace(*spline.domain, 50)
        np.testing.assert_allclose(np.hypot(*spline.evaluate(at).T), radius, atol=0.01)


def test_a_ribbon_is_found_again_from_its_own_edges() -> None:
    """Their covariance is that of the edges across themselves."""
    track = as_ribbon(ring_map(), SIGMA)
    again = as_ribbon(track, 0.0)
    for label, radius in RADII.items():
        first, second = (curve_of(one, label) for one in (track, again))
        at = np.linspace(*first.spline.domain, 50)
        np.testing.assert_allclose(np.hypot(*second.spline.evaluate(at).T), radius, atol=0.01)
        sigmas = [one.spline.normal_sigma(at, one.covariance) for one in (first, second)]
        assert 0.3 < np.median(sigmas[1] / sigmas[0]) < 1.5


def test_an_open_ribbon_is_confirmed_as_far_as_its_boundaries() -> None:
    whole = open_map()
    half = replace(curve_of(whole, LEFT), confirmed_until=15.0)
    track = as_ribbon(replace(whole, boundaries={LEFT: half, RIGHT: curve_of(whole, RIGHT)}), SIGMA)
    assert not track.closed
    left = curve_of(track, LEFT)
    place = left.spline.evaluate(np.array([left.confirmed_until]))[0]
    expected = half.spline.evaluate(np.array([15.0]))[0]
    np.testing.assert_allclose(place, expected, atol=0.3)
    right = curve_of(track, RIGHT)
    assert right.confirmed_until == pytest.approx(right.spline.domain[1], abs=0.5)


def test_an_outline_has_no_covariance() -> None:
    bare = {label: replace(curve_of(ring_map(), label), covariance=np.zeros((0, 0))) for label in BOUNDARIES}
    track = as_ribbon(Map(True, bare), SIGMA)
    assert track.joint_covariance is None and curve_of(track, RIGHT).covariance.shape == (0, 0)
