"""A map: the track's boundaries with their joint covariance, and how it is read and written (FORMATS)."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError, SettingsError
from .files import atomic_folder
from .labels import BOUNDARIES, NAMES
from .spline import BSpline

if TYPE_CHECKING:
    from .run import CycleRecord, RunResult

Array = NDArray[np.float64]

FORMAT = "pathspace-map/1"
MAP_FILE = "map.json"

_CYCLE_COLUMNS = ("cycle", "t", "seconds", "size_left", "size_right", "readings", "lap")
_SYMMETRY_TOLERANCE = 1e-9
"""|P - P^T| <= tolerance * max|P|: what rounding leaves of a covariance's symmetry."""
_NEGATIVE_TOLERANCE = 1e-9
"""smallest eigenvalue >= -tolerance * largest: what rounding leaves of its positive semidefiniteness."""


@dataclass(frozen=True, eq=False)
class SplineBoundary:
    """A boundary as a B-spline."""

    spline: BSpline
    """The curve, map frame, in the direction of travel."""

    covariance: Array
    """(2m, 2m) m^2, joint covariance of the m distinct control points over x0, y0, x1, y1 ..."""

    @property
    def size(self) -> int:
        """The number m of distinct control points."""
        return self.spline.size


@dataclass(frozen=True, eq=False)
class PointBoundary:
    """A boundary as points: the landmarks of an estimator that doesn't know they form a curve."""

    points: Array
    """(m, 2) m, map frame, in no particular order."""

    covariance: Array
    """(2m, 2m) m^2, joint covariance over x0, y0, x1, y1 ..."""

    @property
    def size(self) -> int:
        """The number m of points."""
        return len(self.points)


Boundary = SplineBoundary | PointBoundary


@dataclass(frozen=True, eq=False)
class Map:
    """What was mapped of a track."""

    closed: bool
    """Whether the track was found to be a loop."""

    boundaries: Mapping[int, Boundary]
    """By label, LEFT and RIGHT; a boundary that could not be mapped is absent."""

    @property
    def size(self) -> int:
        """The number of control points or landmarks on both boundaries together."""
        return sum(boundary.size for boundary in self.boundaries.values())


# --- JSON ------------------------------------------------------------------------------------------------


def map_to_json(track: Map) -> dict[str, Any]:
    """The content of `map.json`, of plain Python types; every number to full precision."""
    boundaries = {
        NAMES[label]: _boundary_to_json(track.boundaries[label]) for label in sorted(track.boundaries)
    }
    return {"format": FORMAT, "closed": bool(track.closed), "boundaries": boundaries}


def _boundary_to_json(boundary: Boundary) -> dict[str, Any]:
    shared = {"covariance": boundary.covariance.tolist(), "size": boundary.size}
    if isinstance(boundary, PointBoundary):
        return {"points": boundary.points.tolist(), **shared}
    spline = boundary.spline
    return {
        "degree": int(spline.degree),
        "periodic": bool(spline.periodic),
        "knots": spline.knots.tolist(),
        "control_points": spline.control_points.tolist(),
        **shared,
    }


def map_from_json(content: Any, file: Path | str = MAP_FILE) -> Map:
    """The map of a `map.json`'s content; InputError, naming `file`, where it is not what FORMATS says."""
    reader = _Reader(Path(file))
    top = reader.object(content, "the file")
    if top.get("format") != FORMAT:
        raise reader.error(f'expected format = "{FORMAT}", found {top.get("format")!r}')
    boundaries = reader.object(reader.get(top, "boundaries", ""), "boundaries")
    unknown = sorted(set(boundaries) - {NAMES[label] for label in BOUNDARIES})
    if unknown:
        raise reader.error(f"boundaries: expected left and right, found {unknown[0]!r}")
    return Map(
        closed=reader.boolean(reader.get(top, "closed", ""), "closed"),
        boundaries={
            label: reader.boundary(boundaries[NAMES[label]], f"boundaries.{NAMES[label]}")
            for label in BOUNDARIES
            if NAMES[label] in boundaries
        },
    )


@dataclass(frozen=True)
class _Reader:
    """Takes values out of parsed JSON, checked; `where` is the dotted path that an error names."""

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
            raise self.error(f"{where}: expected true or false, found {value!r}")
        return value

    def integer(self, value: Any, where: str, least: int) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise self.error(f"{where}: expected a whole number of at least {least}, found {value!r}")
        return value

    def array(self, value: Any, where: str, columns: int | None = None) -> Array:
        """Finite numbers: a list (columns None), or rows of `columns` values."""
        expected = "a list of finite numbers" if columns is None else f"rows of {columns} finite numbers"
        try:
            array = np.asarray(value, dtype=float)
        except (TypeError, ValueError):
            raise self.error(f"{where}: expected {expected}") from None
        if columns is not None and array.size == 0:
            array = array.reshape(0, columns)
        shaped = array.ndim == 1 if columns is None else array.ndim == 2 and array.shape[1] == columns
        if not isinstance(value, list) or not shaped or not np.isfinite(array).all():
            raise self.error(f"{where}: expected {expected}")
        return array

    def boundary(self, value: Any, where: str) -> Boundary:
        fields = self.object(value, where)
        if "points" in fields:
            points = self.array(fields["points"], f"{where}.points", columns=2)
            return PointBoundary(points, self.covariance(fields, len(points), where))
        spline = self.spline(fields, where)
        return SplineBoundary(spline, self.covariance(fields, spline.size, where))

    def spline(self, fields: dict[str, Any], where: str) -> BSpline:
        degree = self.integer(self.get(fields, "degree", where), f"{where}.degree", least=1)
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
        covariance = self.array(listed, f"{where}.covariance", columns=2 * size)
        if len(covariance) != 2 * size:
            raise self.error(f"{where}.covariance: expected {2 * size} rows, found {len(covariance)}")
        if not _is_covariance(covariance):
            raise self.error(f"{where}.covariance: expected a symmetric, positive semidefinite matrix")
        return covariance


def _is_covariance(P: Array) -> bool:
    if P.size == 0:
        return True
    if np.abs(P - P.T).max() > _SYMMETRY_TOLERANCE * np.abs(P).max():
        return False
    eigenvalues = np.linalg.eigvalsh(P)
    return bool(eigenvalues[0] >= -_NEGATIVE_TOLERANCE * max(eigenvalues[-1], 0.0))


# --- folders ---------------------------------------------------------------------------------------------


def read_map(folder: Path | str) -> Map:
    """The map of a folder that follows FORMATS, as `write_result`'s do; InputError where it doesn't."""
    file = Path(folder) / MAP_FILE
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(file, f"expected a map, can't be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(file, "expected text in UTF-8") from None
    except json.JSONDecodeError as error:
        raise InputError(file, f"expected JSON ({error.msg})", row=error.lineno) from None
    return map_from_json(content, file)


def write_result(folder: Path | str, result: RunResult, summary: Mapping[str, Any]) -> None:
    """Writes map.json, trajectory.tum, cycles.csv and summary.json: all of them, or on failure nothing.

    An earlier result in `folder` is kept as a numbered backup; OutputError where anything else stands there.
    """
    with atomic_folder(Path(folder), marker=MAP_FILE) as temporary:
        _write_json(temporary / MAP_FILE, map_to_json(result.map))
        write_trajectory(temporary / "trajectory.tum", result.trajectory_t, result.trajectory)
        _write_cycles(temporary / "cycles.csv", result.cycles)
        _write_json(temporary / "summary.json", dict(summary), indent=2)


def write_trajectory(file: Path, t: ArrayLike, poses: ArrayLike) -> None:
    """TUM trajectory format, `t tx ty tz qx qy qz qw`; t: (n,) s, poses: (n, 3) [x, y, theta] map frame."""
    rows = np.column_stack([np.asarray(t, dtype=float), np.asarray(poses, dtype=float).reshape(-1, 3)])
    with file.open("w", encoding="utf-8", newline="\n") as out:
        for stamp, x, y, theta in rows.tolist():
            qz, qw = float(np.sin(theta / 2)), float(np.cos(theta / 2))
            out.write(f"{stamp!r} {x!r} {y!r} 0.0 0.0 0.0 {qz!r} {qw!r}\n")


def _write_cycles(file: Path, cycles: Any) -> None:
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(_CYCLE_COLUMNS)
        writer.writerows(_cycle_row(record) for record in cycles)


def _cycle_row(record: CycleRecord) -> list[float | int]:
    values = (getattr(record, column) for column in _CYCLE_COLUMNS)
    return [value.item() if isinstance(value, np.generic) else value for value in values]


def _write_json(file: Path, content: Mapping[str, Any], indent: int | None = None) -> None:
    text = json.dumps(_plain(content), indent=indent, allow_nan=False)
    file.write_text(text + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """Plain Python types for JSON, which knows neither arrays nor NaN (written as null)."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value
