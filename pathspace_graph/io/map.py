"""A map: the track's boundaries with their joint covariance, and its JSON (FORMATS)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.labels import BOUNDARIES, LEFT, NAMES, POINTS
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.planning import CentreLine, centre_line

from .limits import MAX_COORDINATE, MAX_DEGREE, shown
from .manifest import verified
from .parsing import read_json

Array = NDArray[np.float64]

FORMAT = "pathspace-map/1"
MAP_FILE = "map.json"

NO_COVARIANCE: Final[Array] = np.zeros((0, 0))
"""A boundary whose covariance wasn't asked for has this one, and can't be written."""

_SYMMETRY_TOLERANCE = 1e-9
"""A covariance is symmetric to rounding where |P - P^T| <= tolerance * max|P|."""
_NEGATIVE_TOLERANCE = 1e-9
"""A covariance is positive semidefinite to rounding where min eigenvalue >= -tolerance * max eigenvalue."""


@dataclass(frozen=True, eq=False)
class SplineBoundary:
    """Holds a boundary as a B-spline."""

    LENGTHS: ClassVar = {"spline": 0, "covariance": 2, "confirmed_until": 1}

    spline: BSpline
    """The curve is in the map frame, in the direction of travel."""

    covariance: Array
    """This is the joint covariance (2m, 2m) in m^2 of the m distinct control points, in the order x0, y0, x1,
    y1 and so on."""

    confirmed_until: float = math.inf
    """The curve is confirmed up to this parameter; beyond, it is tentative, and may be taken back. The whole
    of a curve is confirmed where this is infinite or the end of its domain."""

    @property
    def size(self) -> int:
        """Returns the number m of distinct control points."""
        return self.spline.size


@dataclass(frozen=True, eq=False)
class PointBoundary:
    """Holds a boundary as points: the landmarks of an estimator that does not know that they form a curve."""

    LENGTHS: ClassVar = {"points": 1, "covariance": 2}

    points: Array
    """Each row is a point (m, 2) in m, map frame, in no particular order."""

    covariance: Array
    """This is the joint covariance (2m, 2m) in m^2 of the points, in the order x0, y0, x1, y1 and so on."""

    @property
    def size(self) -> int:
        """Returns the number m of points."""
        return len(self.points)


MapBoundary = SplineBoundary | PointBoundary


@dataclass(frozen=True, eq=False)
class Map:
    """Holds what was mapped of a track."""

    LENGTHS: ClassVar = {"boundaries": 0, "joint_covariance": 2, "points": 0}

    closed: bool
    """The track was found to be a loop where this is true."""

    boundaries: Mapping[int, MapBoundary]
    """Each boundary stands under its label, LEFT or RIGHT; a boundary that could not be mapped is absent."""

    joint_covariance: Array | None = None
    """This is the joint covariance (2m, 2m) in m^2 of the points of all boundaries, in the order of their
    labels; it is None where it isn't known."""

    points: Mapping[int, PointBoundary] = field(default_factory=dict)
    """Cones of no boundary by their label, ORANGE or BIG_ORANGE, each label with one covariance."""

    @property
    def size(self) -> int:
        """Returns the number of control points or landmarks on both boundaries together."""
        return sum(boundary.size for boundary in self.boundaries.values())

    def centre_line(self, step: float = 1.0) -> CentreLine:
        """Returns the centre line with widths, heading, curvature and arc length, and their sigmas.

        Its points are `step` (m) apart. Where the joint covariance isn't known, the boundaries are taken as
        independent. A tentative stretch takes part as well. Both boundaries must be splines; otherwise, or
        where they aren't side by side, SettingsError is raised.
        """
        left, right = (self.curve(label, "a centre line") for label in BOUNDARIES)
        return centre_line(
            left.spline, right.spline, self.covariance_of(left, right), self._is_loop(left, right), step
        )

    def curve(self, label: int, purpose: str) -> SplineBoundary:
        """Returns a boundary that is a curve; a SettingsError says for which purpose one was expected."""
        boundary = self.boundaries.get(label)
        if isinstance(boundary, SplineBoundary):
            return boundary
        found = "none" if boundary is None else "points in no order"
        raise SettingsError(f"{purpose}: expected a curve as {NAMES[label]} boundary, found {found}")

    def covariance_of(self, left: SplineBoundary, right: SplineBoundary) -> Array | None:
        """Returns the covariance of both boundaries' control points; None where it wasn't asked for."""
        if self.joint_covariance is not None:
            return self.joint_covariance
        if any(boundary.covariance.shape[0] != 2 * boundary.size for boundary in (left, right)):
            return None
        return np.asarray(block_diag(left.covariance, right.covariance))

    def _is_loop(self, left: SplineBoundary, right: SplineBoundary) -> bool:
        """Returns whether the centre line is closed: both curves are."""
        if left.spline.periodic != right.spline.periodic:
            raise SettingsError(
                "a centre line: expected both boundaries closed or both open, found one of each"
            )
        return left.spline.periodic


def joint_covariance(joint: Array, boundaries: Mapping[int, MapBoundary]) -> Array:
    """Returns a joint covariance (2m, 2m) with each boundary's own covariance as its diagonal block.

    A boundary's covariance may hold what the others don't share, such as the scatter of its cones.
    """
    joint, at = joint.copy(), 0
    for _, boundary in sorted(boundaries.items()):
        own = slice(at, at := at + len(boundary.covariance))
        joint[own, own] = boundary.covariance
    return joint


# --- JSON ------------------------------------------------------------------------------------------------


def map_to_json(track: Map) -> dict[str, Any]:
    """Returns the content of `map.json` in plain Python types, every number to full precision."""
    boundaries = {
        NAMES[label]: _boundary_to_json(track.boundaries[label]) for label in sorted(track.boundaries)
    }
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
    return {
        "degree": int(spline.degree),
        "periodic": bool(spline.periodic),
        "knots": spline.knots.tolist(),
        "control_points": spline.control_points.tolist(),
        "confirmed_until": float(min(boundary.confirmed_until, spline.domain[1])),
        **shared,
    }


def map_from_json(content: Any, file: Path | str = MAP_FILE) -> Map:
    """Returns the map of a `map.json`'s content; an InputError names `file` and what breaks FORMATS."""
    reader = _Reader(Path(file))
    top = reader.object(content, "the file")
    if top.get("format") != FORMAT:
        raise reader.error(f'expected format = "{FORMAT}", found {shown(top.get("format"))}')
    boundaries = reader.object(reader.get(top, "boundaries", ""), "boundaries")
    unknown = sorted(set(boundaries) - {NAMES[label] for label in BOUNDARIES})
    if unknown:
        raise reader.error(f"boundaries: expected left and right, found {shown(unknown[0])}")
    closed = reader.boolean(reader.get(top, "closed", ""), "closed")
    mapped = {
        label: reader.boundary(boundaries[NAMES[label]], f"boundaries.{NAMES[label]}")
        for label in BOUNDARIES
        if NAMES[label] in boundaries
    }
    return Map(closed, mapped, reader.joint_covariance(top, mapped), reader.points(top))


@dataclass(frozen=True)
class _Reader:
    """Takes values out of parsed JSON and checks them; `where` is the dotted path that an error names."""

    file: Path

    def error(self, message: str) -> InputError:
        return InputError(self.file, message)

    def object(self, value: Any, where: str) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise self.error(f"{where}: expected an object, found {type(value).__name__}")
        return value

    def get(self, parent: dict[str, Any], key: str, where: str) -> Any:
        if key not in parent:
            raise self.error(f"{where + '.' if where else ''}{key}: expected, but missing")
        return parent[key]

    def boolean(self, value: Any, where: str) -> bool:
        if not isinstance(value, bool):
            raise self.error(f"{where}: expected true or false, found {shown(value)}")
        return value

    def integer(self, value: Any, where: str, least: int) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise self.error(f"{where}: expected a whole number of at least {least}, found {shown(value)}")
        return value

    def array(
        self, value: Any, where: str, columns: int | None = None, largest: float = MAX_COORDINATE
    ) -> Array:
        """Returns finite numbers: a list where `columns` is None, or rows of `columns` values.

        Each is at most `largest` in size.
        """
        expected = "a list of finite numbers" if columns is None else f"rows of {columns} finite numbers"
        try:
            array = np.asarray(value)
        except (TypeError, ValueError):
            raise self.error(f"{where}: expected {expected}") from None
        if array.dtype.kind not in "iuf":  # texts and null would be turned into numbers
            raise self.error(f"{where}: expected {expected}")
        array = array.astype(float)
        if columns is not None and array.size == 0:
            array = array.reshape(0, columns)
        shaped = array.ndim == 1 if columns is None else array.ndim == 2 and array.shape[1] == columns
        if not isinstance(value, list) or not shaped or not np.isfinite(array).all():
            raise self.error(f"{where}: expected {expected}")
        if array.size and np.abs(array).max() > largest:
            raise self.error(f"{where}: expected numbers of at most {largest:g} in size, found larger ones")
        return array

    def boundary(self, value: Any, where: str) -> MapBoundary:
        fields = self.object(value, where)
        if "points" in fields:
            points = self.array(fields["points"], f"{where}.points", columns=2)
            return PointBoundary(points, self.covariance(fields, len(points), where))
        spline = self.spline(fields, where)
        covariance = self.covariance(fields, spline.size, where)
        return SplineBoundary(spline, covariance, self.confirmed_until(fields, spline, where))

    def confirmed_until(self, fields: dict[str, Any], spline: BSpline, where: str) -> float:
        """Returns the parameter up to which a curve is confirmed: all of it where that isn't said."""
        low, high = spline.domain
        until = self.array([fields.get("confirmed_until", high)], f"{where}.confirmed_until").item()
        if not low <= until <= high:
            message = f"expected a parameter from {low:g} to {high:g}, found {until:g}"
            raise self.error(f"{where}.confirmed_until: {message}")
        return until

    def points(self, top: dict[str, Any]) -> dict[int, PointBoundary]:
        """Returns the cones of no boundary by label; a file need not have any."""
        names, found = {NAMES[label]: label for label in POINTS}, {}
        for name, value in self.object(top.get("points", {}), "points").items():
            own = self.boundary(value, f"points.{name}")
            if name not in names or not isinstance(own, PointBoundary):
                raise self.error(f"points: expected points of {', '.join(names)}, found {shown(name)}")
            found[names[name]] = own
        return found

    def spline(self, fields: dict[str, Any], where: str) -> BSpline:
        degree = self.integer(self.get(fields, "degree", where), f"{where}.degree", least=1)
        if degree > MAX_DEGREE:
            raise self.error(f"{where}.degree: expected at most {MAX_DEGREE}, found {degree}")
        periodic = self.boolean(self.get(fields, "periodic", where), f"{where}.periodic")
        knots = self.array(self.get(fields, "knots", where), f"{where}.knots")
        points = self.array(self.get(fields, "control_points", where), f"{where}.control_points", columns=2)
        try:
            return BSpline(knots, points, degree, periodic)
        except SettingsError as error:
            raise self.error(f"{where}: {error}") from None

    def covariance(self, fields: dict[str, Any], size: int, where: str) -> Array:
        stated = self.integer(self.get(fields, "size", where), f"{where}.size", least=0)
        if stated != size:
            raise self.error(f"{where}.size: expected {size} (what is listed), found {stated}")
        listed = self.get(fields, "covariance", where)
        covariance = self.array(listed, f"{where}.covariance", 2 * size, MAX_COORDINATE**2)
        if len(covariance) != 2 * size:
            raise self.error(f"{where}.covariance: expected {2 * size} rows, found {len(covariance)}")
        if not _is_covariance(covariance):
            raise self.error(f"{where}.covariance: expected a symmetric, positive semidefinite matrix")
        return covariance

    def joint_covariance(self, top: dict[str, Any], boundaries: Mapping[int, MapBoundary]) -> Array | None:
        """Returns the joint covariance of both boundaries, or None where the file doesn't have it."""
        where = "cross_covariance"
        if where not in top:
            return None
        if len(boundaries) != len(BOUNDARIES):
            raise self.error(f"{where}: expected both boundaries, found {len(boundaries)}")
        left, right = (boundaries[label].covariance for label in BOUNDARIES)
        cross = self.array(top[where], where, len(right), MAX_COORDINATE**2)
        if len(cross) != len(left):
            raise self.error(f"{where}: expected {len(left)} rows, found {len(cross)}")
        joint = np.block([[left, cross], [cross.T, right]])
        if not _is_covariance(joint):
            raise self.error(f"{where}: expected a joint covariance that is positive semidefinite")
        return joint


def _is_covariance(P: Array) -> bool:
    if P.size == 0:
        return True
    if np.abs(P - P.T).max() > _SYMMETRY_TOLERANCE * np.abs(P).max():
        return False
    eigenvalues = np.linalg.eigvalsh(P)
    return bool(eigenvalues[0] >= -_NEGATIVE_TOLERANCE * max(eigenvalues[-1], 0.0))


# --- folders ---------------------------------------------------------------------------------------------


def read_map(folder: Path | str) -> Map:
    """Returns the map of a folder that follows FORMATS, as those of `write_result` do."""
    file = Path(folder) / MAP_FILE
    with verified(Path(folder), MAP_FILE):
        return map_from_json(read_json(file, "a map"), file)
