"""Several drives of one track as one problem: one set of curves, and a chain of poses for each drive.

Cycles are numbered consecutively over all drives, without odometry between drives. Each drive has its own
calibration; drives of one vehicle share the sensor's. Common observations connect the drives: curves, their
stations, and poses of a later drive in the frame of an earlier one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.se2 import compose, inverse, move_points, path_lengths
from pathspace_graph.factors.sensor import SENSOR_SIZE
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.drives import Drives, of_sensor
from pathspace_graph.graph.elimination import owners
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import CALIBRATION_KEY, SENSOR_KEY, are_poses, pose_keys
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.places.constellation import Prior
from pathspace_graph.places.passes import NEARBY, find_return, revisit_of, seen_in
from pathspace_graph.settings.mapper import MapperSettings

from .association import locate_poses
from .mapper import BatchResult
from .objections import disagreement
from .simplification import boundary_of
from .system import BatchSystem

REVISIT_INTERVAL: Final = 20.0  # distance of the places at which a drive is laid on earlier ones (m driven)


@dataclass(frozen=True, eq=False)
class PlacedDrive:
    """A drive that was solved alone, and its place on the common map."""

    name: str
    alone: BatchResult
    motion: Array  # (3,) from the frame of the drive to that of the map
    vehicle: str = ""  # name of the vehicle, if the log has it

    @property
    def chain(self) -> LogOdometry:
        return self.alone.system.chain

    @property
    def state(self) -> State:
        """Optimum of the drive alone, in its own frame."""
        return self.alone.optimum.state

    @property
    def settings(self) -> MapperSettings:
        """Settings with the drive's own priors of its calibrations."""
        return self.alone.system.settings

    @property
    def poses(self) -> Array:
        """Poses (P, 3) of the drive alone, in the frame of the map."""
        return compose(self.motion, self.state.poses)


def drives_of(placed: Sequence[PlacedDrive]) -> Drives:
    """Lay out drives and sensors; the drives of a named vehicle share one sensor."""
    first = np.cumsum([0, *(len(one.chain) for one in placed[:-1])]).tolist()
    names = [one.vehicle or f"/{k}" for k, one in enumerate(placed)]
    known = list(dict.fromkeys(names))
    return Drives(tuple(first), tuple(known.index(name) for name in names))


class JointSystem(BatchSystem):
    """The problem of several drives with one set of curves."""

    def __init__(self, placed: Sequence[PlacedDrive]) -> None:
        self.placed, self.drives = tuple(placed), drives_of(placed)
        detections = DetectionTable.of_drives([one.alone.system.detections for one in placed], self.drives)
        own = [
            replace(one, earlier=one.earlier + begin, later=one.later + begin)
            for drive, begin in zip(placed, self.drives.first, strict=True)
            for one in drive.alone.system.revisits
        ]
        super().__init__(detections, placed[0].chain, placed[0].settings, own)
        self.chains = [one.chain for one in placed]  # the odometry of each drive
        self.priors = [one.settings for one in placed]

    def widen_priors(self, drive: int, settings: MapperSettings) -> None:
        """Take the priors of a drive's calibrations from other settings."""
        sigma = np.array(settings.odometry.sigmas)
        self.priors[drive] = settings
        self.chains[drive] = replace(self.chains[drive], calibration_sigma=sigma)

    def drive_rows(self, state: State) -> list[Rows]:
        """Rows of odometry and calibrations of each drive; only the first has a prior of its first pose."""
        groups, variables = list[Rows](), state.variables
        calibrations = variables.calibration.reshape(-1, CALIBRATION_SIZE)
        for d, part in enumerate(self.drives.parts(len(state.poses))):
            chain, poses, calibration = self.chains[d], state.poses[part], calibrations[d]
            own = [chain.odometry_rows(poses, calibration)]
            own += chain.calibration_priors(calibration) if d else chain.priors(poses[0], calibration)
            groups += [in_drive(rows, d, part.start) for rows in own]
        return groups + self._sensor_priors(state)

    def _sensor_priors(self, state: State) -> list[Rows]:
        """Rows of the prior of each sensor, from its first drive."""
        groups, sensors = [], state.variables.sensor
        for number in range(len(sensors) // SENSOR_SIZE):
            prior = self.priors[self.drives.sensors.index(number)].calibration
            root = np.diag(1.0 / np.array(prior.sigmas))
            residual = root @ (of_sensor(sensors, number) - prior.means)
            keys = np.full((SENSOR_SIZE, 1), SENSOR_KEY + number)
            groups.append(Rows(keys, root, residual, np.zeros(SENSOR_SIZE, np.intp)))
        return groups

    def disagreement_of(self, drive: int, state: State) -> str:
        """Describe how the poses of a drive contradict its odometry; empty if they agree."""
        poses = state.poses[self.drives.parts(len(state.poses))[drive]]
        one = self.placed[drive]
        back = compose(one.state.poses[0], inverse(poses[0]))
        calibration = state.variables.calibration.reshape(-1, CALIBRATION_SIZE)[drive]
        return disagreement(one.alone.system, compose(back, poses), calibration)


def in_drive(rows: Rows, number: int, first_cycle: int) -> Rows:
    """Renumber rows of a drive alone, by its number and first cycle among several drives."""
    keys = rows.keys + np.where(are_poses(rows.keys), first_cycle, number)
    return replace(rows, keys=keys, owner=rows.owner + owners(np.array(first_cycle)))


def joint_state(system: JointSystem, known: PlacedDrive) -> State:
    """Build a state of the curves of one drive and the poses of all, each as placed alone."""
    state, placed, drives = State(drives=system.drives), system.placed, system.drives
    for label, spline in known.state.splines.items():
        curve = replace(spline, control_points=move_points(known.motion, spline.control_points))
        state.add_boundary(label, *boundary_of(curve, system.settings))
    variables, poses = state.variables, np.concatenate([one.poses for one in placed])
    own = np.concatenate([one.state.variables.calibration for one in placed])
    variables.insert(CALIBRATION_KEY + np.arange(len(placed)), own)
    sensors = np.array([one.state.variables.sensor for one in placed])
    if sensors.size:
        numbers = np.array(drives.sensors)
        means = [sensors[numbers == number].mean(axis=0) for number in range(numbers.max() + 1)]
        variables.insert(SENSOR_KEY + np.arange(len(means)), np.concatenate(means))
    variables.insert(pose_keys(np.arange(len(poses))), poses.ravel())
    locate_poses(state)
    return state


def revisits_between(system: JointSystem, state: State) -> list[Revisit]:
    """Return poses of each later drive in the frame of one of an earlier drive, by their common cones."""
    settings, found = system.settings, list[Revisit]()
    table = system.detections.cones(settings.of_lines)
    table.correct(state.variables.sensor)
    driven = path_lengths(state.poses)
    for part in system.drives.parts(len(driven))[1:]:
        before, due = float(driven[part.start]), REVISIT_INTERVAL
        for newest in range(part.start, part.stop):
            if driven[newest] - before < due:
                continue
            due = driven[newest] - before + REVISIT_INTERVAL
            poses = state.poses[: newest + 1]
            again = find_return(seen_in(table), poses, before, Prior.about(poses[-1], *NEARBY), settings)
            if again is not None:
                found.append(revisit_of(again[0], poses, again[1], newest))
    return found
