"""A map: the track's boundaries with their joint covariance, and its JSON (FORMATS)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Self

import numpy as np
from msgspec import Meta, Struct
from scipy.linalg import block_diag

from pathspace_graph.brief import Brief, Shown
from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import move_points, rotation
from pathspace_graph.labels import BOUNDARIES, LABELS, LEFT, NAMES, RIGHT
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.centre_line import find_line
from pathspace_graph.spline.planning import CentreLine, centre_line

from .parsing import MAX_COORDINATE, read_json, shown, typed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMAT = "pathspace-map/1"
MAP_FILE = "map.json"
NO_COVARIANCE: Final[Array] = np.zeros((0, 0))  # not requested; such a map can't be written
NO_CONES: Final[Array] = np.zeros((0, 2))


@dataclass(frozen=True, eq=False, repr=False)
class SplineBoundary(Brief):
    """A boundary as a B-spline."""

    LENGTHS: ClassVar = {"spline": 0, "covariance": 2, "confirmed_until": 1, "cones": 1}

    spline: BSpline
    """Curve in the map frame, in the direction of travel."""
    covariance: Array
    """Joint covariance (2m, 2m) in m^2 of the distinct control points, in the order x0, y0, x1 and so on."""
    confirmed_until: float = math.inf
    """Parameter up to which the curve is confirmed; beyond, it is tentative and may be retracted."""
    cones: Array = field(default_factory=NO_CONES.copy)
    """Cones (k, 2) on the curve whose places are known: parameters, and standard deviations along it (m)."""

    @property
    def size(self) -> int:
        """Number m of distinct control points."""
        return self.spline.size

    def moved(self, motion: Array) -> Self:
        """Move the boundary by a motion (3,); parameters along it stay."""
        spline = replace(self.spline, control_points=move_points(motion, self.spline.control_points))
        return replace(self, spline=spline, covariance=_turned(self.covariance, motion))


@dataclass(frozen=True, eq=False, repr=False)
class PointBoundary(Brief):
    """A boundary as points: the landmarks of an estimator that does not know that they form a curve."""

    LENGTHS: ClassVar = {"points": 1, "covariance": 2}

    points: Array
    """Points (m, 2) in m, map frame, in no particular order."""
    covariance: Array
    """Joint covariance (2m, 2m) in m^2 of the points, in the order x0, y0, x1 and so on."""

    @property
    def size(self) -> int:
        return len(self.points)

    def moved(self, motion: Array) -> Self:
        """Move the points by a motion (3,)."""
        covariance = _turned(self.covariance, motion)
        return replace(self, points=move_points(motion, self.points), covariance=covariance)


MapBoundary = SplineBoundary | PointBoundary


class Boundaries(Mapping[Any, MapBoundary]):
    """Boundaries by label or by its name: `boundaries[LEFT]` is `boundaries["left"]`."""

    def __init__(self, boundaries: Mapping[Any, MapBoundary]) -> None:
        self._by_label: dict[int, MapBoundary] = dict(boundaries)

    def __getitem__(self, label: Any) -> MapBoundary:
        return self._by_label[LABELS.get(label, label)]

    def __iter__(self) -> Iterator[int]:
        return iter(self._by_label)

    def __len__(self) -> int:
        return len(self._by_label)


@dataclass(frozen=True, eq=False, repr=False)
class Map(Shown):
    """Map of a track."""

    LENGTHS: ClassVar = {"boundaries": 0, "joint_covariance": 2, "points": 0}

    closed: bool
    """Whether the track was found to be a loop."""
    boundaries: Mapping[Any, MapBoundary]
    """Boundaries by label, LEFT or RIGHT, or by its name; one that could not be mapped is absent."""
    joint_covariance: Array | None = None
    """Joint covariance (2m, 2m) in m^2 of the points of all boundaries, in the order of their labels."""
    points: Mapping[int, PointBoundary] = field(default_factory=dict)
    """Cones of no boundary by their label, ORANGE or BIG_ORANGE, each label with one covariance."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "boundaries", Boundaries(self.boundaries))

    def __repr__(self) -> str:
        sides = [
            f"{NAMES[label]}: {own.size} points"
            if isinstance(own, PointBoundary)
            else f"{NAMES[label]}: {own.size} control points on {own.spline.length():.0f} m"
            for label, own in sorted(self.boundaries.items())
        ]
        cones = [f"{own.size} {NAMES[label].replace('_', ' ')} cones" for label, own in self.points.items()]
        loop = "closed" if self.closed else "open"
        return f"Map({', '.join([loop, *(sides or ['no boundary']), *cones])})"

    @property
    def left(self) -> MapBoundary:
        """Left boundary; a SettingsError where it could not be mapped."""
        return self._boundary(LEFT)

    @property
    def right(self) -> MapBoundary:
        """Right boundary; a SettingsError where it could not be mapped."""
        return self._boundary(RIGHT)

    def _boundary(self, label: int) -> MapBoundary:
        if label not in self.boundaries:
            raise SettingsError(f"map.{NAMES[label]}: expected a mapped boundary, found none")
        return self.boundaries[label]

    def moved(self, motion: Array) -> Self:
        """Move the map and its covariances by a motion (3,) of its frame."""
        boundaries = {label: one.moved(motion) for label, one in self.boundaries.items()}
        points = {label: one.moved(motion) for label, one in self.points.items()}
        joint = None if self.joint_covariance is None else _turned(self.joint_covariance, motion)
        return replace(self, boundaries=boundaries, joint_covariance=joint, points=points)

    def plot(self, **options: Any) -> Figure:
        """Draw the map; the options are those of `eval.figures.drawing.plot_map`."""
        figure: Figure = import_module("pathspace_graph.eval.figures.drawing").plot_map(self, **options)
        return figure

    @property
    def size(self) -> int:
        return sum(boundary.size for boundary in self.boundaries.values())

    def centre_line(self, step: float = 1.0) -> CentreLine:
        """Centre line with widths, heading, curvature and arc length, and their sigmas.

        Its points are `step` (m) apart, also along a tentative stretch. Without a joint covariance the
        boundaries are taken as independent. SettingsError unless both are splines and side by side.
        """
        left, right = self.curves("a centre line")
        covariance = self.covariance_of(left, right)
        return centre_line(left.spline, right.spline, covariance, step)

    @property
    def splines(self) -> dict[int, BSpline]:
        """Boundaries that are curves, by label."""
        boundaries = self.boundaries.items()
        return {label: one.spline for label, one in boundaries if isinstance(one, SplineBoundary)}

    def curves(self, purpose: str) -> tuple[SplineBoundary, SplineBoundary]:
        """Both boundaries, which must be curves, and both closed or both open."""
        left, right = (self.curve(label, purpose) for label in BOUNDARIES)
        if left.spline.periodic != right.spline.periodic:
            raise SettingsError(f"{purpose}: expected both boundaries closed or both open, found one of each")
        return left, right

    def curve(self, label: int, purpose: str) -> SplineBoundary:
        """Boundary that must be a curve; a SettingsError names the purpose."""
        boundary = self.boundaries.get(label)
        if isinstance(boundary, SplineBoundary):
            return boundary
        found = "none" if boundary is None else "points in no order"
        raise SettingsError(f"{purpose}: expected a curve as {NAMES[label]} boundary, found {found}")

    def covariance_of(self, left: SplineBoundary, right: SplineBoundary) -> Array | None:
        """Covariance of both boundaries' control points; None where it was not requested."""
        if self.joint_covariance is not None:
            return self.joint_covariance
        if any(boundary.covariance.shape[0] != 2 * boundary.size for boundary in (left, right)):
            return None
        return np.asarray(block_diag(left.covariance, right.covariance))


def _turned(covariance: Array, motion: Array) -> Array:
    """Rotate a covariance (2m, 2m) of points."""
    turn, count = rotation(float(motion[2])), len(covariance) // 2
    turned = np.einsum("ij,ajbk,lk->aibl", turn, covariance.reshape(count, 2, count, 2), turn)
    return np.asarray(turned.reshape(covariance.shape), np.float64)


def joint_covariance(joint: Array, boundaries: Mapping[int, MapBoundary]) -> Array:
    """Replace the diagonal blocks of a joint covariance (2m, 2m) by each boundary's own."""
    joint, at = joint.copy(), 0
    for _, boundary in sorted(boundaries.items()):
        own = slice(at, at := at + len(boundary.covariance))
        joint[own, own] = boundary.covariance
    return joint


def map_to_json(track: Map) -> dict[str, Any]:
    """Content of `map.json` in plain Python types, every number to full precision."""
    boundaries = {NAMES[label]: _boundary_to_json(own) for label, own in sorted(track.boundaries.items())}
    content = {"format": FORMAT, "closed": bool(track.closed), "boundaries": boundaries}
    if track.joint_covariance is not None and len(track.boundaries) == len(BOUNDARIES):
        left = 2 * track.boundaries[LEFT].size
        content["cross_covariance"] = track.joint_covariance[:left, left:].tolist()
    if track.points:
        content["points"] = {NAMES[label]: _boundary_to_json(own) for label, own in track.points.items()}
    return content


def _boundary_to_json(boundary: MapBoundary) -> dict[str, Any]:
    shared = {"covariance": boundary.covariance.tolist(), "size": boundary.size}
    if isinstance(boundary, PointBoundary):
        return {"points": boundary.points.tolist(), **shared}
    spline = boundary.spline
    cones = {"cones": boundary.cones.tolist()} if len(boundary.cones) else {}
    return {
        "degree": int(spline.degree),
        "periodic": bool(spline.periodic),
        "knots": spline.knots.tolist(),
        "control_points": spline.control_points.tolist(),
        "confirmed_until": float(min(boundary.confirmed_until, spline.domain[1])),
        **cones,
        **shared,
    }


Coordinate = Annotated[float, Meta(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]  # finite: a NaN is refused too
Point = tuple[Coordinate, Coordinate]
Matrix = list[list[Annotated[float, Meta(ge=-(MAX_COORDINATE**2), le=MAX_COORDINATE**2)]]]


class _Points(Struct):
    """Points as they stand in a file."""

    points: list[Point]
    covariance: Matrix
    size: int


class _Curve(Struct):
    """A curve as it stands in a file."""

    degree: Annotated[int, Meta(ge=1, le=20)]
    periodic: bool
    knots: list[Coordinate]
    control_points: list[Point]
    covariance: Matrix
    size: int
    confirmed_until: Coordinate = math.inf
    cones: list[Point] = []


class _File(Struct):
    """The content of `map.json`."""

    closed: bool
    boundaries: dict[Annotated[str, Meta(pattern="^(left|right)$")], Any]
    cross_covariance: Matrix | None = None
    points: dict[Annotated[str, Meta(pattern="^(orange|big_orange)$")], _Points] = {}


def map_from_json(content: Any, file: Path | str = MAP_FILE) -> Map:
    """Build the map of a `map.json`'s content; an InputError names `file` and what breaks FORMATS."""
    file = Path(file)
    stated = typed(content, dict[str, Any], file).get("format")
    if stated != FORMAT:
        raise InputError(file, f'expected format = "{FORMAT}", found {shown(stated)}')
    top = typed(content, _File, file)
    boundaries: dict[int, MapBoundary] = {}
    for name, entry in sorted(top.boundaries.items()):
        kind: type[_Points | _Curve] = _Points if isinstance(entry, dict) and "points" in entry else _Curve
        where = f"boundaries.{name}"
        boundaries[LABELS[name]] = _boundary(typed(entry, kind, file, where), file, where)
    points: Any = {LABELS[name]: _boundary(own, file, f"points.{name}") for name, own in top.points.items()}
    if top.cross_covariance is None:
        return Map(top.closed, boundaries, None, points)
    where = "cross_covariance"
    if len(boundaries) != len(BOUNDARIES):
        raise InputError(file, f"{where}: expected both boundaries, found {len(boundaries)}")
    left, right = (boundaries[label].covariance for label in BOUNDARIES)
    block = _matrix(top.cross_covariance, (len(left), len(right)), file, where)
    joint = np.block([[left, block], [block.T, right]])
    if not _is_covariance(joint):
        raise InputError(file, f"{where}: expected a joint covariance that is positive semidefinite")
    return Map(top.closed, boundaries, joint, points)


def _boundary(read: _Points | _Curve, file: Path, where: str) -> MapBoundary:
    """Check what a file says of a boundary, and take it."""
    if isinstance(read, _Points):
        places = np.array(read.points, float).reshape(-1, 2)
        size = len(places)
    else:
        places = np.array(read.control_points, float).reshape(-1, 2)
        try:
            spline = BSpline(np.array(read.knots), places, read.degree, read.periodic)
        except SettingsError as error:
            raise InputError(file, f"{where}: {error}") from None
        (low, high), until, size = spline.domain, read.confirmed_until, spline.size
        if until < low or high < until < math.inf:
            expected = f"expected a number from {low:g} to {high:g}, found {until:g}"
            raise InputError(file, f"{where}.confirmed_until: {expected}")
        cones = np.array(read.cones, float).reshape(-1, 2)
        if not ((cones >= [low, 0.0]) & (cones[:, :1] <= high)).all():
            expected = f"expected parameters from {low:g} to {high:g} and sigmas from 0 on"
            raise InputError(file, f"{where}.cones: {expected}")
    if read.size != size:
        raise InputError(file, f"{where}.size: expected {size} (what is listed), found {read.size}")
    covariance = _matrix(read.covariance, (2 * size, 2 * size), file, f"{where}.covariance")
    if not _is_covariance(covariance):
        raise InputError(file, f"{where}.covariance: expected a symmetric, positive semidefinite matrix")
    if isinstance(read, _Points):
        return PointBoundary(places, covariance)
    return SplineBoundary(spline, covariance, min(until, high), cones)


def _matrix(rows: Matrix, shape: tuple[int, int], file: Path, where: str) -> Array:
    if len(rows) != shape[0] or any(len(row) != shape[1] for row in rows):
        raise InputError(file, f"{where}: expected {shape[0]} rows of {shape[1]} finite numbers")
    return np.array(rows, float).reshape(shape)


def _is_covariance(P: Array) -> bool:
    """Whether a matrix is symmetric and positive semidefinite, to rounding."""
    if P.size == 0:
        return True
    if np.abs(P - P.T).max() > 1e-9 * np.abs(P).max():
        return False
    eigenvalues = np.linalg.eigvalsh(P)
    return bool(eigenvalues[0] >= -1e-9 * max(eigenvalues[-1], 0.0))


def read_map(folder: Path | str) -> Map:
    """Read the map of a folder that follows FORMATS, or of its map file."""
    file = Path(folder) if Path(folder).is_file() else Path(folder) / MAP_FILE
    return map_from_json(read_json(file, "a map"), file)


# --- one centre line with a width ------------------------------------------------------------------------


def as_ribbon(track: Map, sigma_shape: float) -> Map:
    """Replace the boundaries of a map by the edges of its ribbon; SettingsError where none fits.

    `sigma_shape` (m) is what a ribbon cannot follow, one sigma, added to each control point of its edges.
    Open edges are confirmed as far as their boundaries.
    """
    curves = left, right = track.curves("a centre line")
    line, P = find_line(left.spline, right.spline), track.covariance_of(left, right)
    edges, joint = [line.ribbon.edge(label) for label in BOUNDARIES], None
    if P is not None:
        change = np.concatenate([by_ribbon for _, by_ribbon in edges]) @ line.by_boundaries
        joint = change @ P @ change.T
        joint = 0.5 * (joint + joint.T) + sigma_shape**2 * np.eye(len(joint))
    boundaries, at = {}, 0
    for side, (label, curve) in enumerate(zip(BOUNDARIES, curves, strict=True)):
        edge, by_ribbon = edges[side]
        block, until = slice(at, at := at + len(by_ribbon)), edge.domain[1]
        if not edge.periodic:
            end = np.array([min(curve.confirmed_until, curve.spline.domain[1])])
            until = float(line.ribbon_parameters(side, end)[0])
        own = NO_COVARIANCE if joint is None else joint[block, block].copy()
        boundaries[label] = SplineBoundary(edge, own, until)
    return Map(line.ribbon.periodic, boundaries, joint, track.points)
