"""Victoria Park, a public data set: a truck drives 4 km among trees, which a laser scanner detects.

GTSAM brings the file. It has no stamps: its poses are taken as evenly spaced in time. It has no colours: all
trees are given to one boundary. Its associations of trees are used for the reference only, which is the
optimum of GTSAM and stands in the log as truth, since no survey of the park is in the file.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import gtsam
import numpy as np

from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.io.log import Truth, covariances_of
from pathspace_graph.io.parsing import read_text, shown
from pathspace_graph.labels import LEFT

from .messages import Points
from .recording import Recording, twists_of

EXAMPLE: Final = "victoria_park.txt"
"""GTSAM brings the file under this name."""
PERIOD: Final = 0.2
"""Poses are taken to be this far apart (s), as the scans of the drive nearly were; the file has no times."""
SIGMA_ODOMETRY: Final = (0.055, 0.025, 0.08)
"""White noise of these standard deviations (m/s, m/s, rad/s) has the effect of the odometry's errors.

The file claims 0.05, 0.01 and 0.01 from pose to pose. Against the reference, the errors are correlated over a
hundred poses, and that of the yaw rate has a mean of 0.005 rad/s. The standard deviations here are the rms of
the errors times the square root of their integrated autocorrelation."""
FIELDS: Final = {"ODOMETRY": 11, "LANDMARK": 7}
"""A row that begins with this word has this number of numbers after it."""
ANCHOR_SIGMA: Final = 1e-4
"""The first pose of the reference has this standard deviation (m, m, rad)."""
POSES_A_STEP: Final = 10
"""The reference is first built up in steps of this number of poses, since the drift of 4 km is far beyond
where a batch finds its way."""


@dataclass(frozen=True, eq=False)
class Drive:
    """Holds the rows of the file, with poses numbered from 0 in order."""

    moves: Array
    """(n, 3) Each row leads from a pose to the next one, in m, m and rad."""
    sigmas: Array
    """(3,) These are the standard deviations of a move (m, m, rad)."""
    pose: IntArray
    """(r,) Each detection is from the pose with this number."""
    tree: IntArray
    """(r,) Each detection is of the tree with this number, from 0, as the file has it."""
    points: Array
    """(r, 2) Each row is a detection in the vehicle frame, in m."""
    covariances: Array
    """(r, 2, 2) These are their covariances in m^2."""


def read_victoria_park(file: Path | None = None) -> Recording:
    """Return the drive of a file, by default of the one that GTSAM brings, with the reference as truth."""
    file = example_file() if file is None else file
    drive = _read(file)
    t = np.asarray(PERIOD * np.arange(len(drive.moves) + 1), dtype=float)
    cycles, first = np.unique(drive.pose, return_index=True)
    spans = [slice(a, b) for a, b in zip(first, [*first[1:], len(drive.pose)], strict=True)]
    labels = np.full(len(drive.pose), LEFT)
    scans = [Points(drive.points[own], drive.covariances[own], labels[own]) for own in spans]
    return Recording(
        t[:-1],
        twists_of(drive.moves) / PERIOD,
        t[cycles],
        scans,
        _source(file),
        truth=_reference(drive, t),
        odometry_sigma=np.array(SIGMA_ODOMETRY),
    )


def example_file() -> Path:
    """Return the file that GTSAM brings."""
    find: Any = gtsam.findExampleDataFile
    return Path(find(EXAMPLE))


def _source(file: Path) -> dict[str, str]:
    return {
        "data": f"Victoria Park, {file.name} of GTSAM",
        "time": f"assumed: the file has no stamps, and poses are taken to be {PERIOD:g} s apart",
        "labels": "assumed: trees have no colour, and all are given to the left boundary",
        "sigma": "the odometry's is white noise of the effect that its correlated errors have",
        "truth": "no survey: the optimum of GTSAM over all rows with the associations of the file",
    }


# --- the file --------------------------------------------------------------------------------------------


def _read(file: Path) -> Drive:
    rows: dict[str, list[list[float]]] = {kind: [] for kind in FIELDS}
    for number, line in enumerate(read_text(file).splitlines(), start=1):
        words = line.split()
        if words:
            rows[_kind(file, words, number)].append(_numbers(file, words, number))
    moves, found = (np.array(rows[kind]).reshape(-1, size) for kind, size in FIELDS.items())
    if not len(moves) or not len(found):
        raise InputError(file, "expected rows ODOMETRY and LANDMARK, found none")
    if (moves[1:, 0] != moves[:-1, 1]).any():
        raise InputError(file, "expected each row ODOMETRY to begin at the pose where the one before ends")
    ids = np.append(moves[0, 0], moves[:, 1])
    order = np.argsort(ids)
    place = order[np.searchsorted(ids, found[:, 0], sorter=order).clip(max=len(ids) - 1)]
    if (ids[place] != found[:, 0]).any():
        raise InputError(file, "expected each row LANDMARK to begin with a pose of the rows ODOMETRY")
    by_pose = np.argsort(place, kind="stable")
    found, (xx, xy, yy) = found[by_pose], found[by_pose, 4:].T
    return Drive(
        moves=moves[:, 2:5],
        sigmas=np.sqrt(moves[0, [5, 8, 10]]),
        pose=place[by_pose],
        tree=np.unique(found[:, 1], return_inverse=True)[1],
        points=found[:, 2:4],
        covariances=covariances_of(xx, xy, yy),
    )


def _kind(file: Path, words: list[str], number: int) -> str:
    if words[0] not in FIELDS or len(words) != FIELDS[words[0]] + 1:
        expected = " or ".join(f"{kind} and {size} numbers" for kind, size in FIELDS.items())
        raise InputError(file, f"expected {expected}, found {shown(' '.join(words))}", number)
    return words[0]


def _numbers(file: Path, words: list[str], number: int) -> list[float]:
    try:
        values = [float(word) for word in words[1:]]
    except ValueError:
        values = [np.nan]
    if not np.isfinite(values).all():
        raise InputError(file, f"expected numbers after {words[0]}, found {shown(' '.join(words))}", number)
    return values


# --- the reference ---------------------------------------------------------------------------------------


def _reference(drive: Drive, t: Array) -> Truth:
    """Return the optimum of GTSAM with the associations of the file."""
    values = _optimum(drive)
    poses = [values.atPose2(_x(index)) for index in range(len(t))]
    trees = np.array([values.atPoint2(_l(index)) for index in range(int(drive.tree.max()) + 1)])
    heading = np.unwrap([pose.theta() for pose in poses])
    placed = np.column_stack([[pose.x() for pose in poses], [pose.y() for pose in poses], heading])
    return Truth(t, placed - placed[0], trees, np.full(len(trees), LEFT), drive.tree)


def _optimum(drive: Drive) -> Any:
    graph, values, whole = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.NonlinearFactorGraph()
    smoother, seen, pose = gtsam.ISAM2(), set[int](), gtsam.Pose2()
    noise = gtsam.noiseModel.Diagonal.Sigmas(drive.sigmas)
    ends = np.searchsorted(drive.pose, np.arange(len(drive.moves) + 2))
    anchor = gtsam.noiseModel.Isotropic.Sigma(3, ANCHOR_SIGMA)
    graph.push_back(gtsam.PriorFactorPose2(_x(0), pose, anchor))
    for index in range(len(drive.moves) + 1):
        if index:
            move = gtsam.Pose2(*drive.moves[index - 1])
            pose = pose.compose(move)
            graph.push_back(gtsam.BetweenFactorPose2(_x(index - 1), _x(index), move, noise))
        values.insert(_x(index), pose)
        for row in range(ends[index], ends[index + 1]):
            graph.push_back(_sighting(drive, row))
            if drive.tree[row] not in seen:
                seen.add(int(drive.tree[row]))
                values.insert(_l(drive.tree[row]), pose.transformFrom(drive.points[row]))
        if index % POSES_A_STEP == 0 or index == len(drive.moves):
            whole.push_back(graph)
            smoother.update(graph, values)
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            pose = smoother.calculateEstimatePose2(_x(index))
    return gtsam.LevenbergMarquardtOptimizer(whole, smoother.calculateEstimate()).optimize()


def _sighting(drive: Drive, row: int) -> Any:
    """Return the factor of a detection: its covariance is turned to the bearing and the range."""
    point, distance = drive.points[row], float(np.hypot(*drive.points[row]))
    along = point / distance
    to_polar = np.array([[-along[1] / distance, along[0] / distance], along])
    noise = gtsam.noiseModel.Gaussian.Covariance(to_polar @ drive.covariances[row] @ to_polar.T)
    bearing = gtsam.Rot2(float(np.arctan2(point[1], point[0])))
    return gtsam.BearingRangeFactor2D(_x(int(drive.pose[row])), _l(drive.tree[row]), bearing, distance, noise)


def _x(index: int) -> int:
    return int(gtsam.symbol("x", index))


def _l(index: int) -> int:
    return int(gtsam.symbol("l", int(index)))
