"""The folder of a log: header, tables and, where known, the truth (FORMATS)."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import asdict

from pathspace_graph.errors import InputError, check_type
from pathspace_graph.factors.arrays import Array
from pathspace_graph.labels import NAMES

from . import header as headers
from .files import atomic_folder, write_table
from .log import (
    COLUMNS,
    DETECTIONS_FILE,
    LOG_FILE,
    ODOMETRY_FILE,
    TRUTH_ASSOCIATIONS_FILE,
    TRUTH_CONES_FILE,
    TRUTH_FILES,
    TRUTH_POSES_FILE,
    Log,
    SensorInfo,
    Truth,
    cycles_in,
    increasing_times,
    labels_of,
    odometry_of,
)
from .parsing import Table
from .tables import read_table


def read_log(folder: Path | str) -> Log:
    """Read and check a log folder; an InputError names the file, the row and what was expected."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "expected a log folder, found " + ("a file" if folder.exists() else "none"))
    file = folder / LOG_FILE
    header = headers.read_header(file)
    odometry, table = odometry_of(_table(folder, ODOMETRY_FILE)), _table(folder, DETECTIONS_FILE)
    return Log(
        odometry=odometry,
        cycles=cycles_in(table, float(odometry.t[0]), float(odometry.t[-1])),
        odometry_sigma=np.array(header.odometry.sigma),
        sensor=SensorInfo(**asdict(header.sensor)),
        source={key: str(value) for key, value in header.source.items()},
        odometry_stated=header.noise.odometry == headers.STATED,
        detections_stated=header.noise.detections == headers.STATED,
        odometry_drift=None if (drift := header.odometry.drift_sigmas) is None else np.array(drift),
        measured=headers.measured_noise(header, file),
        truth=_read_truth(folder, len(table), headers.true_errors(header, file)),
        scale=header.scale,
    )


def _table(folder: Path, name: str) -> Table:
    """Read a table of a log; an unknown one of the truth has no rows."""
    if name in TRUTH_FILES and not (folder / name).exists():
        return Table.of_arrays(folder / name, COLUMNS[name], np.zeros((0, len(COLUMNS[name]))))
    return read_table(folder / name, COLUMNS[name])


def _read_truth(folder: Path, detection_count: int, errors: dict[str, Array]) -> Truth | None:
    known = [(folder / name).exists() for name in TRUTH_FILES]
    if not errors and not any(known):
        return None
    poses, cones, table = (_table(folder, name) for name in TRUTH_FILES)
    t, placed, points = increasing_times(poses), poses.stack(("x", "y", "theta")), cones.stack(("x", "y"))
    truth = Truth(t, placed, points, labels_of(cones), None, **errors)
    if not known[-1]:
        return truth
    if len(table) != detection_count:
        expected = f"a row for each of {detection_count} detections"
        raise InputError(table.file, f"expected {expected}, found {len(table)}")
    index = table.numbers("cone")
    good = (index == np.floor(index)) & (index >= -1) & (index < len(points))
    table.require(good, f"expected -1 or the index of one of {len(points)} true cones")
    return replace(truth, associations=index.astype(int))


def write_log(log: Log, folder: Path | str, *, check: bool = False, force: bool = False) -> None:
    """Write a log folder that `read_log` gives back exactly, but for cycles without detections.

    It is written as by `atomic_folder`, and replaces an earlier log if `force`; with `check`, a log that
    cannot be read is an InputError instead.
    """
    check_type("log", log, Log)
    with atomic_folder(folder, LOG_FILE, force=force) as target:
        header = headers.to_toml(_sections(log), log.scale)
        (target / LOG_FILE).write_text(header, encoding="utf-8", newline="\n")
        for name, values in _columns(log).items():
            write_table(target / name, COLUMNS[name], *values)
        if check:
            read_log(target)


def _sections(log: Log) -> dict[str, dict[str, Any]]:
    truth = dict[str, Any]()
    for name, entries in headers.TRUE_ERRORS.items():
        values = getattr(log.truth, name, None)
        truth |= {} if values is None else dict(zip(entries, values, strict=True))
    return {
        "odometry": {"sigma": log.odometry_sigma, "drift_sigmas": log.odometry_drift},
        "sensor": vars(log.sensor),
        **headers.noise_sections(log.odometry_stated, log.detections_stated, log.measured),
        "source": {headers.toml_text(key): value for key, value in log.source.items()},
        **({"truth": truth} if truth else {}),
    }


def _columns(log: Log) -> dict[str, tuple[Any, ...]]:
    cycles, truth = log.cycles, log.truth
    covariances = np.concatenate([np.zeros((0, 2, 2)), *(cycle.covariances for cycle in cycles)])
    columns: dict[str, tuple[Any, ...]] = {
        ODOMETRY_FILE: (log.odometry.t, log.odometry.twist),
        DETECTIONS_FILE: (
            [cycle.t for cycle in cycles for _ in cycle.labels],
            np.concatenate([np.zeros((0, 2)), *(cycle.points_vehicle for cycle in cycles)]),
            [NAMES[label] for cycle in cycles for label in cycle.labels],
            covariances[:, [0, 0, 1], [0, 1, 1]],
        ),
    }
    if truth is not None:
        columns[TRUTH_POSES_FILE] = truth.pose_t, truth.poses
        columns[TRUTH_CONES_FILE] = truth.cones, [NAMES[label] for label in truth.cone_labels]
        if truth.associations is not None:
            columns[TRUTH_ASSOCIATIONS_FILE] = (truth.associations,)
    return columns
