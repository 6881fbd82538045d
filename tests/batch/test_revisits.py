"""Revisits of a whole drive by its cones, and what odometry and revisits say of an optimum."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.lap import BENT_SIGMAS, disagreement
from pathspace_graph.batch.simplification import own_settings
from pathspace_graph.batch.start import REVISIT_INTERVAL, aligned_odometry, find_revisits, length_of_lap
from pathspace_graph.factors.se2 import path_lengths, relative, wrap_angle
from pathspace_graph.front_end.front_end import judge_log
from pathspace_graph.front_end.log_odometry import LogOdometry
from pathspace_graph.graph.rows import Revisit
from pathspace_graph.io.log import Log
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

from ..scenes.batch import course_log, drawn_chain
from ..scenes.drives import SHORT, ahead, corridor, exact_log, noisy, true_poses

Array = NDArray[np.float64]

SETTINGS = own_settings(MapperSettings())


def found_in(log: Log) -> tuple[LogOdometry, tuple[Revisit, ...]]:
    """Return the odometry of a log, and its revisits."""
    judged = judge_log(log, log.noise, SETTINGS)
    return judged.chain, find_revisits(judged)


# --- revisits --------------------------------------------------------------------------------------------


@cache
def laps() -> Log:
    """Return a drive of three laps with the simulator's noise."""
    track = generate_track(np.random.default_rng(4), SHORT)
    return simulate(track, SimulationSettings(laps=3), 4)


def test_each_later_lap_of_a_drive_is_met_again_every_few_metres() -> None:
    """Where each pose is in the frame of the earlier one is found within centimetres."""
    log = laps()
    chain, revisits = found_in(log)
    truth = true_poses(log)
    driven = path_lengths(truth)
    lap = float(driven[revisits[0].later] - driven[revisits[0].earlier])
    assert length_of_lap(chain.dead_reckoned(np.zeros(2)), revisits[0]) == pytest.approx(lap, rel=0.02)
    later = driven[[one.later for one in revisits]]
    assert (np.diff(later[:-1]) >= REVISIT_INTERVAL - 1.0).all()  # the last may be nearer
    assert len(revisits) > 0.6 * (driven[-1] - lap) / REVISIT_INTERVAL
    off = np.array([one.local - relative(truth[one.earlier], truth[one.later]) for one in revisits])
    off[:, 2] = wrap_angle(off[:, 2])
    assert np.hypot(*off[:, :2].T).max() < 0.15 and np.abs(off[:, 2]).max() < 0.03
    rounds = (driven[[one.later for one in revisits]] - driven[[one.earlier for one in revisits]]) / lap
    np.testing.assert_allclose(rounds, np.round(rounds), atol=0.05)
    before = np.hypot(*(chain.dead_reckoned(np.zeros(2)) - truth)[:, :2].T)
    after = np.hypot(*(aligned_odometry(chain, revisits).poses - truth)[:, :2].T)
    assert after.mean() < 0.5 * before.mean()


def test_an_open_road_is_met_nowhere_again() -> None:
    log = noisy(exact_log(ahead(8.0, 12.0), *corridor(120.0)), seed=2)
    assert found_in(log)[1] == ()


# --- how far an optimum is from them ---------------------------------------------------------------------


@cache
def course() -> tuple[LogOdometry, Array]:
    """Return the exact odometry of a drive of 1.2 laps, and its poses."""
    log = course_log(1.2)
    return judge_log(log, log.noise, SETTINGS).chain, true_poses(log)


def revisit(poses: Array, error: Array | None = None) -> Revisit:
    """Return that the last pose was measured in the frame of one a lap before, with an error (sigmas)."""
    earlier, root = len(poses) // 6, np.diag([10.0, 10.0, 100.0])
    local = relative(poses[earlier], poses[-1])
    off = np.zeros(3) if error is None else error / np.diag(root)
    return Revisit(earlier, len(poses) - 1, local + off, root)


def test_the_true_drive_is_about_a_sigma_away() -> None:
    """In the mean over drives that are measured with the noise and calibration that are assumed."""
    chain, truth = course()
    rng, squares = np.random.default_rng(1), []
    for _ in range(25):
        calibration = rng.normal(chain.calibration_mean, chain.calibration_sigma)
        again = revisit(truth, rng.normal(size=3))
        measured = replace(drawn_chain(chain, calibration, rng), bias=None)
        squares.append(aligned_odometry(measured, [again]).disagreement(truth) ** 2)
    assert 0.7 < np.mean(squares) < 1.4


@pytest.mark.parametrize(
    ("sigmas", "why"), [(0.95, ""), (1.05, "the poses are {:.1f} sigmas from the odometry")]
)
def test_an_optimum_that_bends_the_drive_is_refused(sigmas: float, why: str) -> None:
    """Each node is off by so many standard deviations in each direction."""
    chain, truth = course()
    system: Any = SimpleNamespace(chains=[chain], revisits=(revisit(truth),))
    known = aligned_odometry(chain, system.revisits)
    off = BENT_SIGMAS * sigmas
    poses = known.poses.copy()
    poses[known.nodes] += off * np.linalg.cholesky(known.covariances).sum(axis=2)
    assert known.disagreement(poses) == pytest.approx(off)
    calibration = chain.calibration_mean
    assert disagreement(system, poses, calibration) == why.format(off)
    assert disagreement(system, known.poses, calibration) == ""
    system.revisits = ()
    assert disagreement(system, poses, calibration) == ""


def test_a_bias_that_the_optimum_has_found_is_no_disagreement() -> None:
    """The yaw rate is a hundred sigmas of its prior off."""
    chain, truth = course()
    calibration = chain.calibration_mean + chain.calibration_sigma * np.array([0.0, 100.0])
    measured = replace(drawn_chain(chain, calibration, np.random.default_rng(2)), bias=None)
    system: Any = SimpleNamespace(chains=[measured], revisits=(revisit(truth),))
    assert disagreement(system, truth, chain.calibration_mean) != ""
    assert disagreement(system, truth, calibration) == ""
