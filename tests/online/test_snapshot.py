"""Snapshots of the mapper: at any moment of a drive it is saved and restored, and goes on as if it never was.

Nothing is compared with a tolerance: state, results and maps are the same to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from pathspace_graph import FixedLagMapper, InputError, SettingsError
from pathspace_graph.health import LOST
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.labels import LEFT, UNKNOWN
from pathspace_graph.loop.closed import Closed
from pathspace_graph.loop.lost import Lost
from pathspace_graph.loop.map_repair import REPAIRED
from pathspace_graph.loop.relocalization import FOUND
from pathspace_graph.loop.returns import ReturnFinder
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import skidpad

from ..scenes.digest import digest
from ..scenes.drives import ODOMETRY_SIGMA, ahead, bean_track, beginning, corridor, exact_log, map_log, replay
from ..scenes.holes import unseen
from ..scenes.kidnapped import laps_log, pear_track, put_down

AFTERWARDS = 30
"""Number of cycles that a restored mapper goes on, if it is not saved again before: a whole window."""


@dataclass(frozen=True)
class Drive:
    """A log, and moments of it by name, each the first cycle after which something is true."""

    log: Log
    moments: dict[str, Callable[[FixedLagMapper, CycleResult], bool]]
    settings: MapperSettings = field(default_factory=MapperSettings)
    registers: bool = True


def laps() -> Drive:
    settings = MapperSettings()
    return Drive(
        simulate(bean_track(), SimulationSettings(laps=3), seed=2),
        {
            "first cycle": lambda mapper, _: True,
            "second cycle": lambda mapper, _: mapper.road.smoother.next_cycle == 2,
            "submap": lambda mapper, _: (
                mapper.road.smoother.submaps is not None and bool(mapper.road.smoother.submaps.finished)
            ),
            "inactive": lambda mapper, _: len(mapper.road.smoother.inactive) > 0,
            "more inactive": lambda mapper, _: len(mapper.road.smoother.inactive) > 2,
            "closing": lambda mapper, _: mapper.closed,
            "batch": lambda mapper, result: (
                mapper.closed and result.jump is None and mapper.road.smoother.next_cycle % 5 == 0
            ),
            "before the swap": lambda mapper, _: (
                mapper.drive.solver._batch is not None
                and mapper.drive.solver._batch.due == mapper.road.smoother.next_cycle
            ),
            "swap": lambda mapper, result: result.jump is not None,
            "after the swap": lambda mapper, result: mapper.drive.lap_seconds > 0.0 and result.jump is None,
            "gauge": lambda mapper, _: mapper.road.smoother.held is not None,
        },
        replace(settings, closing=replace(settings.closing, gauge_laps=0.4)),
    )


def lost() -> Drive:
    log = put_down(laps_log(pear_track()), 20.0, 30.0)
    return Drive(
        log,
        {
            "driving on": lambda mapper, result: result.t > 19.0,
            "lost": lambda mapper, result: result.health.condition == LOST,
            "searching": lambda mapper, result: (
                isinstance(mapper.phase, Lost) and round(10 * result.t) % 10 == 0
            ),
            "found": lambda mapper, result: result.notice == FOUND,
        },
    )


def repaired() -> Drive:
    return Drive(
        unseen(laps_log(pear_track()), [LEFT], 6.0, 11.0),
        {
            "contradicted": lambda mapper, _: (
                isinstance(mapper.phase, Closed) and mapper.drive.solver.is_busy
            ),
            "repaired": lambda mapper, result: result.notice.startswith(REPAIRED),
        },
    )


def recurring() -> Drive:
    """A loop that no registration closes, which a batch from odometry closes."""
    return Drive(
        simulate(bean_track(), SimulationSettings(laps=3), seed=6),
        {
            "tried": lambda mapper, _: not mapper.closed and mapper.drive.solver.first_kept is not None,
            "closed": lambda mapper, _: mapper.closed,
        },
        registers=False,
    )


def revisited() -> Drive:
    """Both rounds to the right of a skidpad."""
    return Drive(
        beginning(simulate(skidpad(), SimulationSettings(), seed=2), 180),
        {
            "revisit": lambda mapper, result: result.jump is not None,
            "afterwards": lambda mapper, _: (
                len(mapper.revisits) == 1 and mapper.road.smoother.next_cycle % 10 == 0
            ),
            "second": lambda mapper, _: len(mapper.revisits) == 2,
        },
    )


def standing() -> Drive:
    cones, labels = corridor(80.0)
    log = exact_log(np.concatenate([ahead(0.0, 3.0), ahead(8.0, 6.0)]), cones, labels)
    return Drive(log, {"at rest": later_than(2.0), "driving": later_than(4.0)})


def colours() -> Drive:
    """A lap without colours in one third, and with swapped ones in another."""
    log = simulate(bean_track(), SimulationSettings(laps=1), seed=3)
    end, rng = log.cycles[-1].t, np.random.default_rng(0)
    cycles = []
    for cycle in log.cycles:
        labels = cycle.labels.copy()
        if 0.3 * end < cycle.t < 0.5 * end:
            labels[:] = UNKNOWN
        elif cycle.t > 0.5 * end:
            swapped = rng.uniform(size=len(labels)) < 0.1
            labels[swapped & (labels != UNKNOWN)] ^= 1
        cycles.append(replace(cycle, labels=labels))
    every = {f"{share:.0%}": later_than(share * end) for share in (0.35, 0.45, 0.6, 0.8)}
    return Drive(replace(log, cycles=tuple(cycles)), every)


def later_than(t: float) -> Callable[[FixedLagMapper, CycleResult], bool]:
    return lambda mapper, result: result.t > t


def assert_same(result: CycleResult, expected: CycleResult) -> None:
    np.testing.assert_array_equal(result.pose, expected.pose)
    np.testing.assert_array_equal(result.jump, expected.jump)
    for name in ("t", "sizes", "readings", "closed", "notice", "health", "dropped", "refused"):
        assert getattr(result, name) == getattr(expected, name), name


def assert_same_map(track: Map, expected: Map) -> None:
    assert track.boundaries.keys() == expected.boundaries.keys()
    for label, boundary in track.boundaries.items():
        known = expected.boundaries[label]
        assert isinstance(boundary, SplineBoundary) and isinstance(known, SplineBoundary)
        np.testing.assert_array_equal(boundary.spline.control_points, known.spline.control_points)
        np.testing.assert_array_equal(boundary.covariance, known.covariance)


@pytest.mark.parametrize("make", [laps, lost, repaired, recurring, revisited, standing, colours])
def test_a_restored_mapper_goes_on_to_the_same_result(
    make: Callable[[], Drive], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drive = make()
    if not drive.registers:
        monkeypatch.setattr(ReturnFinder, "_by_curves", lambda *_: None)
    waiting, restored, last = dict(drive.moments), None, 0
    mapper = FixedLagMapper(drive.settings, drive.log.odometry_sigma)
    for number, cycle in enumerate(split_odometry(drive.log)):
        if not waiting and number > last + AFTERWARDS:
            break
        result = replay(mapper, *cycle)
        if restored is not None:
            assert_same(replay(restored, *cycle), result)
            if waiting and number == last + AFTERWARDS:
                assert digest(restored) == digest(mapper)
                restored = None
        reached = [name for name, is_reached in waiting.items() if is_reached(mapper, result)]
        if reached:
            last = number
            if restored is not None:
                assert digest(restored) == digest(mapper), reached
            for name in reached:
                del waiting[name]
            file, before = tmp_path / f"{number}.snap", digest(mapper)
            mapper.save(file)
            assert digest(mapper) == before, reached
            restored = FixedLagMapper.restore(file)
            assert digest(restored) == before, reached
    assert not waiting
    assert restored is not None and restored is not mapper
    assert_same_map(restored.map(), mapper.map())
    state, expected = restored.vehicle_state(), mapper.vehicle_state()
    np.testing.assert_array_equal(state.covariance, expected.covariance)
    assert digest(restored) == digest(mapper)


# --- what cannot be saved --------------------------------------------------------------------------------


def straight() -> Log:
    cones, labels = corridor(80.0)
    return exact_log(ahead(8.0, 8.0), cones, labels)


def test_a_mapper_that_has_done_nothing_is_saved(tmp_path: Path) -> None:
    mapper = FixedLagMapper(odometry_sigma=ODOMETRY_SIGMA)
    mapper.save(tmp_path / "new.snap")
    restored = FixedLagMapper.restore(tmp_path / "new.snap")
    assert digest(restored) == digest(mapper)
    assert digest(map_log(straight(), restored)[0]) == digest(map_log(straight(), mapper)[0])


def test_a_factor_of_the_user_is_refused_until_it_is_part_of_the_prior(tmp_path: Path) -> None:
    mapper, file = FixedLagMapper(odometry_sigma=ODOMETRY_SIGMA), tmp_path / "own.snap"
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    cycles = [*split_odometry(straight())]
    begin = cycles[0][1].t
    for odometry, detections in cycles:
        own = [gtsam.PriorFactorPose2(mapper.next_pose_key, gtsam.Pose2(), noise)]
        mapper.update(odometry, detections, own if detections.t == begin else [])
        if detections.t <= begin + mapper.settings.lag:
            with pytest.raises(SettingsError, match="expected no factors of your own in the window, found 1"):
                mapper.save(file)
            assert not file.exists()
    mapper.save(file)
    assert digest(FixedLagMapper.restore(file)) == digest(mapper)


# --- files -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mapped() -> FixedLagMapper:
    return map_log(straight())[0]


@pytest.fixture
def file(mapped: FixedLagMapper, tmp_path: Path) -> Iterator[Path]:
    mapped.save(tmp_path / "mapper.snap")
    yield tmp_path / "mapper.snap"
    assert not list(tmp_path.glob(".*"))


def test_an_earlier_snapshot_is_replaced(file: Path) -> None:
    FixedLagMapper(odometry_sigma=ODOMETRY_SIGMA).save(file)
    assert FixedLagMapper.restore(file).road.smoother.next_cycle == 0


@pytest.mark.parametrize("share", [0.0, 0.001, 0.01, 0.5, 0.999])
def test_a_file_that_was_cut_is_refused(share: float, file: Path) -> None:
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(InputError, match=r"mapper\.snap: expected"):
        FixedLagMapper.restore(file)
