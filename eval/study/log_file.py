"""Logs of a study in files of plain arrays, exactly as they were simulated, with their empty cycles."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import InputError
from pathspace_graph.io.log import Detections, Log, Odometry, SensorInfo, Truth

_TRUTH: Final = {
    name: name for name in ("pose_t", "poses", "cones", "cone_labels", "associations", "calibration")
} | {"sensor": "true_sensor", "noise": "true_noise"}
_SENSOR: Final = ("range_max", "fov", "rate")
_DIGEST_BYTES: Final = hashlib.sha256().digest_size
_ERRORS: Final = (OSError, ValueError, LookupError, TypeError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""Archives of something else, and arrays that do not fit each other, raise these."""


def write_log_file(file: Path, log: Log) -> None:
    """Writes the log as a numpy archive behind its SHA-256."""
    cycles, sensor = log.cycles, [getattr(log.sensor, name) for name in _SENSOR]
    arrays: dict[str, Any] = {
        "odometry_t": log.odometry.t,
        "odometry_twist": log.odometry.twist,
        "odometry_sigma": log.odometry_sigma,
        "cycle_t": np.array([cycle.t for cycle in cycles]),
        "cycle_size": np.array([len(cycle.labels) for cycle in cycles], dtype=int),
        "points": np.concatenate([np.zeros((0, 2)), *(cycle.points_vehicle for cycle in cycles)]),
        "covariances": np.concatenate([np.zeros((0, 2, 2)), *(cycle.covariances for cycle in cycles)]),
        "labels": np.concatenate([np.zeros(0, dtype=int), *(cycle.labels for cycle in cycles)]),
        "sensor": np.array([np.nan if value is None else value for value in sensor]),
        "source": np.array(json.dumps(dict(log.source))),
    }
    if log.truth is not None:
        known = {array: getattr(log.truth, name) for name, array in _TRUTH.items()}
        arrays |= {name: value for name, value in known.items() if value is not None}
    archive = io.BytesIO()
    np.savez(archive, **arrays)
    content = archive.getvalue()
    file.write_bytes(hashlib.sha256(content).digest() + content)


def read_log_file(file: Path) -> Log:
    """Returns the log of an archive; an InputError says that it is none, or damaged."""
    try:
        data = file.read_bytes()
        digest, content = data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]
        if digest != hashlib.sha256(content).digest():
            raise ValueError("it is not as it was written")
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        return _log(arrays)
    except (*_ERRORS, EOFError) as error:
        raise InputError(file, f"expected the log of a study: {error}") from error


def _log(arrays: dict[str, NDArray[Any]]) -> Log:
    at = np.cumsum(arrays["cycle_size"])[:-1]
    points, covariances, labels = (np.split(arrays[name], at) for name in ("points", "covariances", "labels"))
    cycles = zip(arrays["cycle_t"].tolist(), points, covariances, labels, strict=bool(len(arrays["cycle_t"])))
    sensor = [None if np.isnan(value) else value for value in arrays["sensor"].tolist()]
    truth = {name: arrays[array] for name, array in _TRUTH.items() if array in arrays}
    return Log(
        Odometry(arrays["odometry_t"], arrays["odometry_twist"]),
        tuple(Detections(*cycle) for cycle in cycles),
        arrays["odometry_sigma"],
        SensorInfo(*sensor),
        json.loads(str(arrays["source"])),
        truth=Truth(**truth) if truth else None,
    )
