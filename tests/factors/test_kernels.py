"""The compiled functions of arrays against those in numpy."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from pathlib import Path
from types import BuiltinFunctionType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.bspline import SpanPolynomials
from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.se2 import to_vehicle
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    INDEX_BITS,
    ORIGIN_KEY,
    Layout,
    control_keys,
    pose_keys,
)

from ..oracles import cones, curves, footpoint, front_end, measuring, rows, spans

Arguments = Callable[[np.random.Generator], tuple[Any, ...]]
COUNT = 17
"""Rows of each argument."""

KERNELS = {name: one for name, one in vars(kernels).items() if isinstance(one, BuiltinFunctionType)}
ORACLES = {
    name: one
    for module in (cones, curves, footpoint, front_end, measuring, rows)
    for name, one in vars(module).items()
    if name in KERNELS and one.__module__ == module.__name__
}


class Laid(NamedTuple):
    """What both kinds of curves are made of."""

    bases: list[SpanPolynomials]
    offsets: list[int]
    distinct: list[int]


def poses(rng: np.random.Generator, count: int | None = None) -> np.ndarray:
    return rng.normal(size=(COUNT if count is None else count, 3)) * np.array([30.0, 30.0, 2.0])


def covariances(rng: np.random.Generator) -> np.ndarray:
    roots = rng.normal(size=(COUNT, 2, 2))
    return roots @ roots.transpose(0, 2, 1)


def information(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return root @ root.T + np.eye(size)


def rows_of_a_system(rng: np.random.Generator) -> tuple[Any, ...]:
    """Two groups of rows, and a factor with its keys in any order."""
    layout, rows = rows_with_keys(rng)
    factor = rng.permutation(layout.keys)[:4], np.asfortranarray(information(rng, 13))
    return (
        layout,
        [factor],
        [kernels.RowStore([rows]), kernels.RowStore([rows] * 2)],
        rng.normal(size=layout.size),
    )


def links(rng: np.random.Generator) -> tuple[Any, ...]:
    """Values of a calibration, four points, and poses of the origin, an anchor and two more; two links."""
    point, pose = control_keys(0, np.arange(4)), pose_keys(np.arange(3))
    keys = np.concatenate([[CALIBRATION_KEY], point, pose, [ORIGIN_KEY]])
    layout, both = Layout(np.sort(keys)), []
    for left, given in (
        (np.array([point[0], ORIGIN_KEY]), np.array([CALIBRATION_KEY, point[1]])),
        (np.array([point[1], pose[0]]), np.array([CALIBRATION_KEY, point[2], point[3], pose[1]])),
    ):
        y, z = Layout(np.sort(left)), Layout(np.sort(given))
        numbers = [rng.normal(size=shape) for shape in ((y.size, z.size), (y.size,), (y.size, y.size))]
        both.append(
            SimpleNamespace(
                leaving=y, others=z, **dict(zip(("gain", "offset", "noise"), numbers, strict=True))
            )
        )
    frames = layout.columns(pose[[0, 2]])
    columns = (
        layout.entries(np.concatenate([getattr(k, of).keys for k in both])) for of in ("leaving", "others")
    )
    return rng.normal(size=layout.size), both, frames, *columns


def rows_with_keys(rng: np.random.Generator) -> tuple[Layout, Rows]:
    """Rows on three of ten poses; neighbouring rows share their first keys."""
    keys = pose_keys(np.sort(rng.choice(1000, 10, replace=False)))
    sought = np.array([rng.permutation(10)[:3] for _ in range(COUNT)], np.intp).reshape(COUNT, 3)
    sought[1::3] = sought[: len(sought) - 1 : 3]
    return Layout(keys), some_rows(rng, keys[sought], 9)


def some_rows(rng: np.random.Generator, keys: np.ndarray, width: int) -> Rows:
    return Rows(keys, rng.normal(size=(COUNT, width)), rng.normal(size=COUNT), rng.integers(0, 9, COUNT))


def some_columns(rng: np.random.Generator) -> tuple[Any, ...]:
    """Rows on a pose and two points, some of which the layout does not hold."""
    poses, points = pose_keys(np.arange(20)), control_keys(0, np.arange(20))
    sought = [rng.choice(poses, (COUNT, 1)), rng.choice(points, (COUNT, 2))]
    return Layout(np.append(points[1::2], poses[5:])), some_rows(rng, np.hstack(sought), 7)


def detections(rng: np.random.Generator, sensor: int) -> tuple[Any, ...]:
    points, measured, twists = rng.normal(size=(COUNT, 2)), rng.normal(size=(COUNT, 2)) * 9.0, poses(rng)
    angle = rng.uniform(-3.0, 3.0, COUNT)
    normals, basis = np.column_stack([np.cos(angle), np.sin(angle)]), rng.uniform(size=(COUNT, 4))
    rest = (measured, twists, 0.1 * rng.normal(size=sensor), 0.07)
    return points, covariances(rng), poses(rng), normals, rng.normal(size=COUNT), basis, *rest


def scan(rng: np.random.Generator) -> tuple[Any, ...]:
    recent = rng.uniform(-8.0, 8.0, (200, 2))
    return recent, rng.uniform(-8.0, 8.0, (COUNT, 2)), rng.uniform(0.01, 0.1, COUNT), 0.1 * poses(rng, 1)[0]


def table(rng: np.random.Generator) -> tuple[Any, ...]:
    """Rows of a table of detections, its cycles and points, and the poses from cycle 5 on."""
    rows, cycles = np.arange(COUNT)[::2], 5 + np.sort(rng.integers(0, 3, COUNT))
    return rows, cycles, 9.0 * rng.normal(size=(COUNT, 2)), poses(rng), poses(rng, 3), 5


def gate(rng: np.random.Generator) -> tuple[Any, ...]:
    rows, cycles, _, _, own, first = table(rng)
    count = len(rows)
    foot = rng.normal(size=(count, 2)), rng.normal(size=count), rng.choice([True, False], count)
    limits = (0.1, 0.05, 2.0, 1.0, 0.5, 2)
    return rows, cycles, rng.integers(0, 3, COUNT), covariances(rng), own, first, foot, limits


def tracks(rng: np.random.Generator) -> tuple[Any, ...]:
    """Detections near tracks, beside them in their smeared noise, and far from any."""
    known = 2 * COUNT
    inform = np.linalg.inv(np.tile(0.05 * np.eye(2), (known, 1, 1)))
    columns = 4.0 * rng.normal(size=(known, 2)), inform, rng.integers(1, 9, known), rng.uniform(size=known)
    smeared = 0.2 * covariances(rng) + 0.01 * np.eye(2)
    return columns, 5.0 * rng.normal(size=(COUNT, 2)), smeared, 0.7, (0.5, 2.0, 2.5)


def constellations(rng: np.random.Generator) -> tuple[Any, ...]:
    """Cones of two labels, the same with noise from a pose, and what is expected of it."""
    points, labels, pose = rng.uniform(-12.0, 12.0, (COUNT, 2)), rng.integers(0, 2, COUNT), poses(rng, 1)
    seen = to_vehicle(points + pose[0, :2], pose) + 0.1 * rng.normal(size=(COUNT, 2))
    known = points + pose[0, :2], 0.01 * covariances(rng), labels
    about = pose[0] + (0.7, -0.4, 0.1), 0.1 * information(rng, 3)
    views = np.column_stack(
        [pose[0] + rng.normal(size=(3, 3)), rng.uniform(5.0, 15.0, 3), rng.uniform(0.3, 2.0, 3)]
    )
    return (
        (seen, 0.01 * covariances(rng), labels),
        known,
        views,
        *about,
        (4.0, 0.3),
        (0.25, 9.0, 0.5, 0.05, 1.0, 10.0, 2.0, 20.0),
    )


def at_stations(rng: np.random.Generator, sensed: int) -> tuple[Any, ...]:
    """Detections at stations of curves of degree 3."""
    points, known, own, _, _, _, measured, twists, sensor, _ = detections(rng, sensed)
    basis = *rng.normal(size=(2, COUNT, 4)), rng.normal(size=(COUNT, 4, 2))
    return points, known, own, *basis, measured, twists, sensor, rng.uniform(0.0, 1.0, COUNT)


def seen_curves(rng: np.random.Generator, periodic: bool) -> tuple[Any, ...]:
    """Curves, and detections in use on them, of two cycles of three."""
    laid, control_points = two_curves(rng, periodic, 3)
    keys = rng.permutation(1000)[: len(control_points)]
    own = control_points, np.array([0, 1]), keys, np.array([9.0, 30.0]), np.array([3.0, -np.inf])
    cycles, boundary = 5 + np.sort(rng.integers(0, 3, COUNT)), rng.integers(0, 2, COUNT)
    measured, twists = 9.0 * rng.normal(size=(COUNT, 2)), poses(rng)
    where = rng.choice([True, True, False], COUNT), rng.uniform(0.0, 20.0, COUNT)
    seen = (cycles, boundary, *where, measured, twists, covariances(rng) + 0.01 * np.eye(2))
    limits = (4.0, 2, 0.1, 1.5)
    poses_seen = 0.1 * poses(rng, 3), 5, 0.01 * rng.normal(size=5)
    return laid, own, seen, np.array([5, 7]), *poses_seen, limits, (100, 50)


def views(rng: np.random.Generator, periodic: bool) -> tuple[Any, ...]:
    laid, control_points = two_curves(rng, periodic, 3)
    beside = [rng.uniform(0.0, 20.0, 4) for _ in range(2)]
    where = 9.0 * rng.normal(size=(COUNT, 2)), rng.integers(0, 2, COUNT), rng.integers(0, 5, COUNT)
    rooms = (5.0, 15.0, 2.0, 4.0)
    known = np.array([9.0, np.inf])
    return laid, control_points, known, *where, beside, poses(rng, 1)[0], rooms, 0.7, 50


def keys_to_lay_out(rng: np.random.Generator) -> tuple[Any, ...]:
    """Keys of letters 1 to 6, of which 3 is that of the sensors' calibrations, and 5 the first of poses."""
    letter = 1 << INDEX_BITS
    keys = np.sort(rng.integers(1, 7, COUNT) * letter + rng.integers(0, 9, COUNT))
    return keys, 3 * letter, 5 * letter, (2, 5, 3), letter * np.arange(1, 7)


CASES: dict[str, Arguments] = {
    "summed": rows_of_a_system,
    "blocks_of": lambda rng: ((system := rows_with_keys(rng))[0], [system[1]] * 2),
    "moved_residual": lambda rng: (*rows_with_keys(rng), rng.normal(size=30)),
    "laid_out": keys_to_lay_out,
    "columns_of": some_columns,
    "spread": lambda rng: (rng.integers(0, 99, COUNT), rng.integers(0, 4, COUNT)),
    "shifted": lambda rng: (rng.normal(size=(COUNT, 2)) * 9.0, poses(rng), rng.normal(size=5)),
    "to_map": lambda rng: (rng.normal(size=(COUNT, 2)), poses(rng)),
    "detection_rows": lambda rng: detections(rng, 5),
    "station_rows": lambda rng: at_stations(rng, 5),
    "placed": lambda rng: (*table(rng), 0.1 * rng.normal(size=5)),
    "open_rows": lambda rng: (
        np.array([0, 1]),
        np.array([0, min(COUNT, 4)]),
        *rng.integers(0, 3, (2, COUNT)),
        rng.choice([True, False], COUNT),
        2,
    ),
    "gated": gate,
    "merged": tracks,
    "merged_in_turn": lambda rng: (*(given := tracks(rng))[1:3], given[4]),
    "laid": constellations,
    "curve_rows": lambda rng: seen_curves(rng, False),
    "in_view": lambda rng: views(rng, False),
    "whitened_odometry": lambda rng: (
        *(poses(rng) for _ in range(3)),
        rng.normal(size=(COUNT, 3, 3)),
        rng.normal(size=(COUNT, 3, 2)),
        rng.normal(size=2),
    ),
    "along_and_across": lambda rng: (poses(rng)[:, :2], poses(rng, 40)[:, :2], np.sort(rng.normal(size=40))),
    "odometry_residuals": lambda rng: (poses(rng), poses(rng), poses(rng)),
    "integrated": lambda rng: (rng.uniform(0.0, 0.1, COUNT), poses(rng), rng.uniform(0.1, 0.2, (COUNT, 3))),
    "weighted_means": lambda rng: (*rng.normal(size=(2, COUNT, 2)), 0.6, 3.0),
    "matched": lambda rng: (*scan(rng), [1.0, 0.7], (3.0, 0.7, 2.5, 0.05, 3, 1e-6)),
    "followed": lambda rng: (
        np.array([0, COUNT // 3, COUNT // 3, COUNT]),
        np.array([0.5, 1.0, 1.5]),
        rng.normal(size=(3, 2)),
        6.0 * rng.normal(size=(COUNT, 2)),
        rng.integers(0, 2, COUNT),
        rng.uniform(1.0, 9.0, COUNT),
        *rng.uniform(1.0, 3.0, (2, COUNT)),
        (
            6.0 * rng.normal(size=(COUNT // 2, 2)),
            rng.integers(0, 2, COUNT // 2),
            rng.uniform(1.0, 9.0, COUNT // 2),
            rng.uniform(-0.5, 0.5, COUNT // 2),
            np.arange(COUNT // 2),
        ),
        COUNT // 2,
        (1.0, 0.5, 0.15),
    ),
    "off_prediction": lambda rng: (
        poses(rng, 1)[0],
        information(rng, 3),
        1.2,
        poses(rng, 1)[0],
        information(rng, 3),
    ),
    "relative_block": lambda rng: (
        rng.normal(size=(COUNT, 9)),
        rng.normal(size=COUNT),
        *(rng.normal(size=size) for size in (9, 12, 12)),
        Layout(np.append(np.append(CALIBRATION_KEY, control_keys(0, np.arange(2))), pose_keys(np.arange(1)))),
    ),
    "link_means": links,
    "origin_by_active": lambda rng: (*links(rng), 19),
    "squared": lambda rng: (
        rng.normal(size=3),
        information(rng, 3),
        rng.normal(size=(3, 2)),
        information(rng, 2),
    ),
    "learned": lambda rng: (
        rng.normal(size=2),
        *(information(rng, 2) for _ in range(2)),
        rng.normal(size=3),
        information(rng, 3),
        rng.normal(size=(3, 2)),
        0.3,
    ),
    "centred": lambda rng: (
        np.arange(0, COUNT, 5),
        covariances(rng),
        rng.normal(size=(COUNT, 2, 7)),
        rng.normal(size=(COUNT, 2)),
    ),
    "by_constants": lambda rng: (
        9.0 * rng.normal(size=(COUNT, 2)),
        *(poses(rng) for _ in range(3)),
        np.arange(COUNT) // 3 * 3,
        8.0,
    ),
    "references": lambda rng: (
        np.sort(rng.integers(0, 3, COUNT)),
        *rng.uniform(0.5, 9.0, (3, COUNT)),
        rng.normal(size=(COUNT, 4)),
        (0.6, 6.0),
    ),
    "usable": lambda rng: (
        rng.normal(size=(COUNT, 2)),
        covariances(rng) * rng.choice([1.0, -1.0], (COUNT, 1, 1)),
        (0.5, 2.0, 1e-6, 1e-2, 0.3, 1.5),
    ),
    "whitener": lambda rng: (information(rng, 3), 1e-3),
}


def results(function: Callable[..., Any], arguments: tuple[Any, ...]) -> list[Any]:
    """What a function returns, where of a Hessian only the lower triangle is told."""
    lay_out = kernels.Curves if isinstance(function, BuiltinFunctionType) else spans.lay_out
    arguments = tuple(lay_out(*one) if isinstance(one, Laid) else one for one in arguments)
    found = function(*arguments)
    if function.__name__.endswith("summed"):
        return [np.tril(found[0]), found[1]]
    return [*flat(found)]


def flat(found: Any) -> Iterator[Any]:
    """The arrays and numbers in nested tuples and lists."""
    for one in found if isinstance(found, tuple | list) else (found,):
        yield from flat(one) if isinstance(one, tuple | list) else (one,)


def assert_equal(found: list[Any], expected: list[Any]) -> None:
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert np.shape(one) == np.shape(other)
        assert np.asarray(one).dtype == np.asarray(other).dtype
        scale = max(float(np.abs(np.asarray(other, float)).max(initial=0.0)), 1.0)
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12 * scale)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", CASES)
def test_a_compiled_function_is_the_one_in_numpy(name: str, seed: int) -> None:
    arguments = CASES[name](np.random.default_rng(seed))
    assert_equal(results(KERNELS[name], arguments), results(ORACLES[name], arguments))


@pytest.mark.parametrize("name", sorted(set(CASES) - {"integrated", "columns_of", "laid"}))
def test_no_rows_are_no_rows(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing is seen; none is asked for steps without twists, columns or places without rows."""
    monkeypatch.setitem(globals(), "COUNT", 0)
    arguments = CASES[name](np.random.default_rng(0))
    assert_equal(results(KERNELS[name], arguments), results(ORACLES[name], arguments))


def test_every_compiled_function_is_tested() -> None:
    assert set(KERNELS) == set(ORACLES) == set(CASES)


def test_every_compiled_function_has_a_signature() -> None:
    stub = ast.parse(Path(str(kernels.__file__)).with_name("_kernels.pyi").read_text())
    declared = [node for node in stub.body if isinstance(node, ast.FunctionDef)]
    assert {function.name for function in declared} == set(KERNELS)
    assert all(ast.get_docstring(function) for function in declared)
    for function in declared:
        assert f"arg{len(function.args.args) - 1}:" in str(KERNELS[function.name].__doc__)
        assert f"arg{len(function.args.args)}:" not in str(KERNELS[function.name].__doc__)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("to_map", lambda rng: (rng.normal(size=(COUNT, 2)), poses(rng, 1))),
        ("to_map", lambda rng: (rng.normal(size=(1, 2)), poses(rng))),
        ("to_map", lambda rng: (np.zeros((0, 2)), poses(rng, 1))),
        ("detection_rows", lambda rng: detections(rng, 0)),
        ("station_rows", lambda rng: at_stations(rng, 0)),
        ("placed", lambda rng: (*table(rng), np.zeros(0))),
        ("curve_rows", lambda rng: seen_curves(rng, True)),
        ("in_view", lambda rng: views(rng, True)),
        ("odometry_residuals", lambda rng: (poses(rng), poses(rng), 1e-5 * poses(rng))),
        ("matched", lambda rng: (np.zeros((0, 2)), *scan(rng)[1:], [1.0], (3.0, 0.7, 2.5, 0.05, 3, 1e-6))),
        ("integrated", lambda rng: (np.full(3, 0.1), np.zeros((3, 3)), np.full((3, 3), 0.1))),
    ],
)
def test_cases_at_the_edge(name: str, arguments: Arguments) -> None:
    """One pose for all points, no points, no calibration, small angles, nothing remembered, at rest."""
    chosen = arguments(np.random.default_rng(3))
    assert_equal(results(KERNELS[name], chosen), results(ORACLES[name], chosen))


def two_curves(rng: np.random.Generator, periodic: bool, degree: int) -> tuple[Laid, np.ndarray]:
    """Two curves laid out together, and their control points."""
    tables, points = [], []
    for k in range(2):
        count = 14 + 3 * k
        if periodic:
            breaks = np.cumsum(rng.uniform(1.0, 3.0, count + 1))
            steps = np.diff(breaks)
            before, after = (
                breaks[0] - np.cumsum(steps[::-1][:degree])[::-1],
                breaks[-1] + np.cumsum(steps[:degree]),
            )
            knots = np.concatenate([before, breaks, after])
        else:
            breaks = np.cumsum(rng.uniform(1.0, 3.0, count - degree + 1))
            knots = np.concatenate([np.full(degree, breaks[0]), breaks, np.full(degree, breaks[-1])])
        tables.append(SpanPolynomials(knots, degree, periodic))
        angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        ring = (8.0 + 3.0 * k) * np.column_stack([np.cos(angle), np.sin(angle)])
        points.append(ring + rng.normal(size=ring.shape))
    sizes = [len(own) for own in points]
    return Laid(tables, [0, sizes[0]], sizes), np.concatenate(points)


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("seed", range(8))
def test_foot_points(seed: int, periodic: bool, degree: int) -> None:
    """Stretches across the seam, whole periods, reversed and empty ones; points far off and at a centre."""
    rng = np.random.default_rng(seed)
    laid, control_points = two_curves(rng, periodic, degree)
    points, curve = rng.normal(size=(60, 2)) * 9.0, rng.integers(0, 2, 60)
    points[0] = 0.0
    low = rng.uniform(-10.0, 40.0, 60)
    high = low + rng.choice([-1.0, 0.0, 5.0, 15.0, 200.0], 60)
    start = rng.uniform(-10.0, 50.0, 60)
    compiled, known = kernels.Curves(*laid), spans.lay_out(*laid)
    on = control_points, points, curve
    stretch = low, high
    pairs = (
        (compiled.search(*on, *stretch, 0.7, 50), footpoint.searched(known, *on, *stretch, 0.7, 50)),
        (compiled.refine(*on, start, *stretch, 2), footpoint.refined(known, *on, start, *stretch, 2)),
    )
    for found, expected in ((FootPoints(*one), FootPoints(*other)) for one, other in pairs):
        for name in ("u", "position", "tangent_unit", "normal_unit", "distance", "basis"):
            np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-9)
        for name in ("interior", "span", "columns"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="shapes that fit"):
        kernels.to_map(np.zeros((3, 2)), np.zeros((2, 3)))
