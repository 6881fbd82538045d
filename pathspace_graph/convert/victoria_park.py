"""Victoria Park, a public data set: a truck drives 4 km among trees, which a laser scanner detects.

GTSAM brings the file, without stamps and colours: poses are taken as evenly spaced in time, and all trees are
given to one boundary. The truth in the log is no survey, but GTSAM's optimum with the file's associations.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.io.log import Truth, covariances_of
from pathspace_graph.io.parsing import read_text, shown
from pathspace_graph.labels import LEFT

from .messages import Points
from .recording import Recording, twists_of

EXAMPLE: Final = "victoria_park.txt"  # name of the file that GTSAM brings
PERIOD: Final = 0.2  # time from pose to pose (s), nearly as the drive had it; the file has none
SIGMA_ODOMETRY: Final = (0.055, 0.025, 0.08)
"""Sigmas (m/s, m/s, rad/s) of white noise with the effect of the odometry's errors: their rms against the
reference times the root of their integrated autocorrelation, as they last for a hundred poses. The file
has 0.05, 0.01, 0.01 from pose to pose, as if they were white."""
FIELDS: Final = {"ODOMETRY": 11, "LANDMARK": 7}  # numbers in a row, by its first word
ANCHOR_SIGMA: Final = 1e-4  # standard deviation of the first pose of the reference (m, m, rad)
POSES_A_STEP: Final = 10  # of the reference, which no batch finds after the drift of 4 km


@dataclass(frozen=True, eq=False)
class VictoriaDrive:
    """Rows of the file, with poses numbered from 0 in order."""

    moves: Array  # (n, 3) moves from each pose to the next one, in m, m and rad
    sigmas: Array  # (3,) standard deviations of a move (m, m, rad)
    pose: IntArray  # (r,) number of the pose that each detection is from
    tree: IntArray  # (r,) number of the tree of each detection, from 0, as the file has it
    points: Array  # (r, 2) detections in the vehicle frame, in m
    covariances: Array  # (r, 2, 2) their covariances in m^2


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
        {
            "data": f"Victoria Park, {file.name} of GTSAM",
            "time": f"assumed: the file has no stamps, and poses are taken to be {PERIOD:g} s apart",
            "labels": "assumed: trees have no colour, and all are given to the left boundary",
            "sigma": "the odometry's is white noise of the effect that its correlated errors have",
            "truth": "no survey: the optimum of GTSAM over all rows with the associations of the file",
        },
        truth=_reference(drive, t),
        odometry_sigma=np.array(SIGMA_ODOMETRY),
    )


def example_file() -> Path:
    find: Any = gtsam.findExampleDataFile
    return Path(find(EXAMPLE))


def _read(file: Path) -> VictoriaDrive:
    rows: dict[str, list[list[float]]] = {kind: [] for kind in FIELDS}
    for number, line in enumerate(read_text(file).splitlines(), start=1):
        kind, *words = line.split() or [""]
        if not kind:
            continue
        found = shown(" ".join([kind, *words]))
        if len(words) != FIELDS.get(kind):
            expected = " or ".join(f"{kind} and {size} numbers" for kind, size in FIELDS.items())
            raise InputError(file, f"expected {expected}, found {found}", number)
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = [np.nan]
        if not np.isfinite(values).all():
            raise InputError(file, f"expected numbers after {kind}, found {found}", number)
        rows[kind].append(values)
    moves, seen = (np.array(rows[kind]).reshape(-1, size) for kind, size in FIELDS.items())
    if not len(moves) or not len(seen):
        raise InputError(file, "expected rows ODOMETRY and LANDMARK, found none")
    if (moves[1:, 0] != moves[:-1, 1]).any():
        raise InputError(file, "expected each row ODOMETRY to begin at the pose where the one before ends")
    ids = np.append(moves[0, 0], moves[:, 1])
    order = np.argsort(ids)
    place = order[np.searchsorted(ids, seen[:, 0], sorter=order).clip(max=len(ids) - 1)]
    if (ids[place] != seen[:, 0]).any():
        raise InputError(file, "expected each row LANDMARK to begin with a pose of the rows ODOMETRY")
    by_pose = np.argsort(place, kind="stable")
    seen, (xx, xy, yy) = seen[by_pose], seen[by_pose, 4:].T
    return VictoriaDrive(
        moves=moves[:, 2:5],
        sigmas=np.sqrt(moves[0, [5, 8, 10]]),
        pose=place[by_pose],
        tree=np.unique(seen[:, 1], return_inverse=True)[1],
        points=seen[:, 2:4],
        covariances=covariances_of(xx, xy, yy),
    )


def _reference(drive: VictoriaDrive, t: Array) -> Truth:
    values = _optimum(drive)
    poses = [values.atPose2(X(index)) for index in range(len(t))]
    trees = np.array([values.atPoint2(L(index)) for index in range(int(drive.tree.max()) + 1)])
    heading = np.unwrap([pose.theta() for pose in poses])
    placed = np.column_stack([[pose.x() for pose in poses], [pose.y() for pose in poses], heading])
    return Truth(t, placed - placed[0], trees, np.full(len(trees), LEFT), drive.tree)


def _optimum(drive: VictoriaDrive) -> Any:
    graph, values, whole = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.NonlinearFactorGraph()
    smoother, seen, pose = gtsam.ISAM2(), set[int](), gtsam.Pose2()
    noise = gtsam.noiseModel.Diagonal.Sigmas(drive.sigmas)
    ends = np.searchsorted(drive.pose, np.arange(len(drive.moves) + 2))
    anchor = gtsam.noiseModel.Isotropic.Sigma(3, ANCHOR_SIGMA)
    graph.push_back(gtsam.PriorFactorPose2(X(0), pose, anchor))
    for index in range(len(drive.moves) + 1):
        if index:
            move = gtsam.Pose2(*drive.moves[index - 1])
            pose = pose.compose(move)
            graph.push_back(gtsam.BetweenFactorPose2(X(index - 1), X(index), move, noise))
        values.insert(X(index), pose)
        for row in range(ends[index], ends[index + 1]):
            graph.push_back(_sighting(drive, row))
            if drive.tree[row] not in seen:
                seen.add(int(drive.tree[row]))
                values.insert(L(int(drive.tree[row])), pose.transformFrom(drive.points[row]))
        if index % POSES_A_STEP == 0 or index == len(drive.moves):
            whole.push_back(graph)
            smoother.update(graph, values)
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            pose = smoother.calculateEstimatePose2(X(index))
    return gtsam.LevenbergMarquardtOptimizer(whole, smoother.calculateEstimate()).optimize()


def _sighting(drive: VictoriaDrive, row: int) -> Any:
    """Return the factor of a detection: its covariance is turned to the bearing and the range."""
    point, distance = drive.points[row], float(np.hypot(*drive.points[row]))
    along = point / distance
    to_polar = np.array([[-along[1] / distance, along[0] / distance], along])
    noise = gtsam.noiseModel.Gaussian.Covariance(to_polar @ drive.covariances[row] @ to_polar.T)
    bearing = gtsam.Rot2(float(np.arctan2(point[1], point[0])))
    keys = X(int(drive.pose[row])), L(int(drive.tree[row]))
    return gtsam.BearingRangeFactor2D(*keys, bearing, distance, noise)
