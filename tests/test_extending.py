"""The examples of the pages on extending do what their page says."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import ModuleType

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph import FixedLagMapper, Log, Odometry
from pathspace_graph.graph.exchange import read_graph
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import Variables, pose_keys
from pathspace_graph.graph.window import WindowFactors
from pathspace_graph.io.log_files import write_log
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from .scenes.drives import exact_log, noisy_lap, replay, true_poses
from .scenes.jacobians import numeric_jacobian
from .scenes.paths import ROOT
from .scenes.pretenders import write_round_track
from .test_docs import PACKAGE, csv_rows, eight_seconds, file_blocks

Array = NDArray[np.float64]

EXTENDING = ROOT / "examples" / "extending"
ESTIMATOR = ROOT / "examples" / "dead_reckoning"


def module_of(name: str, code: str) -> ModuleType:
    module = ModuleType(name)
    exec(compile(code, f"{name}.py", "exec"), vars(module))
    return module


@pytest.fixture(scope="module")
def log() -> Log:
    return eight_seconds()


@pytest.fixture
def page(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """The modules of the examples by their names, which import one another."""

    def imported(name: str) -> ModuleType:
        module = module_of(name, (EXTENDING / f"{name}.py").read_text())
        monkeypatch.setitem(sys.modules, name, module)
        return module

    return imported


# --- a new sensor ----------------------------------------------------------------------------------------

RADIUS, HALF_WIDTH = 25.0, 2.0
"""A road that bends to the left about (0, RADIUS), between two walls (m)."""


def scan_of(pose: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Ranges (n,) within 12 m at bearings (n,) of the nearer wall, with 3 cm of noise."""
    bearings = np.sort(rng.uniform(-1.2, 1.2, 120))
    ray = np.column_stack([np.cos(bearings + pose[2]), np.sin(bearings + pose[2])])
    origin = pose[:2] - [0.0, RADIUS]
    ranges = np.full(len(bearings), np.inf)
    for radius in (RADIUS - HALF_WIDTH, RADIUS + HALF_WIDTH):
        middle = -ray @ origin
        square = middle**2 - origin @ origin + radius**2
        half = np.sqrt(np.where(square > 0.0, square, np.inf))
        hits = middle + np.where(middle > half, -half, half)  # behind the vehicle they are negative
        ranges = np.where((hits > 0.0) & (hits < ranges), hits, ranges)
    seen = ranges < 12.0
    return ranges[seen] + rng.normal(0.0, 0.03, seen.sum()), bearings[seen]


def test_the_new_sensor_maps_walls_by_points(page: Callable[[str], ModuleType]) -> None:
    walls, rng = page("walls"), np.random.default_rng(0)
    twist = np.array([6.0, 0.0, 6.0 / RADIUS])
    mapper = FixedLagMapper(walls.SETTINGS, np.array([0.05, 0.05, 0.01]))
    for t in 0.1 * np.arange(90):
        angle = twist[2] * t
        pose = np.array([RADIUS * np.sin(angle), RADIUS * (1.0 - np.cos(angle)), angle])
        since = t - 0.1 + 0.02 * np.arange(5 if t else 0)
        odometry = Odometry(since, np.tile(twist, (len(since), 1)))
        mapper.update(odometry, walls.wall_detections(t, *scan_of(pose, rng)), strict=True)
    np.testing.assert_allclose(mapper.poses[-1], pose, atol=0.02)
    for label, radius in ((LEFT, RADIUS - HALF_WIDTH), (RIGHT, RADIUS + HALF_WIDTH)):
        boundary = mapper.boundaries[label]
        assert boundary.confirmed_end > 45.0
        curve = boundary.evaluate(mapper.control_points(label), np.linspace(0.0, boundary.confirmed_end, 400))
        np.testing.assert_allclose(np.hypot(*(curve - [0.0, RADIUS]).T), radius, atol=0.05)


# --- a new factor ----------------------------------------------------------------------------------------


def test_the_new_factor_has_the_jacobian_that_it_says(page: Callable[[str], ModuleType]) -> None:
    factor = page("compass").compass_factor(0, 3.1, 0.5)

    def whitened(pose: np.ndarray) -> np.ndarray:
        values = gtsam.Values()
        values.insert(0, gtsam.Pose2(1.0, 2.0, -3.0).retract(pose))
        return np.asarray(factor.whitenedError(values))

    values = gtsam.Values()
    values.insert(0, gtsam.Pose2(1.0, 2.0, -3.0))
    jacobian, _ = factor.linearize(values).jacobian()
    np.testing.assert_allclose(jacobian, numeric_jacobian(whitened, np.zeros(3)), atol=1e-6)
    np.testing.assert_allclose(whitened(np.zeros(3)), [(2.0 * np.pi - 6.1) / 0.5])


def test_the_new_factor_holds_the_heading(log: Log, page: Callable[[str], ModuleType]) -> None:
    page("compass")
    drive = page("drive").drive
    assert log.truth is not None
    stamps = [cycle.t for cycle in log.cycles]
    headings = np.interp(stamps, log.truth.pose_t, np.unwrap(log.truth.poses[:, 2]))
    offset = drive(log, headings + 0.05).poses[-1, 2] - drive(log, headings).poses[-1, 2]
    assert 0.02 < offset < 0.06


def test_the_new_rows_have_the_jacobian_that_they_say(page: Callable[[str], ModuleType]) -> None:
    no_slip, cycles = page("no_slip"), np.array([3, 4, 5])
    poses = np.array([[1.0, 2.0, 0.3], [1.5, 2.4, 0.9], [1.2, 3.0, 2.5]])

    def rows_at(flat: Array) -> Rows:
        variables = Variables()
        variables.first_cycle = 3
        variables.insert(pose_keys(cycles), flat)
        rows: Rows = no_slip.no_slip_rows(variables, cycles)
        return rows

    rows = rows_at(poses.ravel())
    np.testing.assert_array_equal(rows.owner, [3, 4])  # the newest pose has no next one
    np.testing.assert_array_equal(rows.keys, pose_keys(np.array([[3, 4], [4, 5]])))
    numeric = numeric_jacobian(lambda flat: rows_at(flat).residual, poses.ravel())
    np.testing.assert_allclose(rows.jacobian[0], numeric[0, :6], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(rows.jacobian[1], numeric[1, 3:], rtol=1e-6, atol=1e-6)
    assert rows.residual[0] == pytest.approx((-0.5 * np.sin(0.6) + 0.4 * np.cos(0.6)) / 0.005)


def test_the_new_rows_keep_a_car_from_slipping(
    page: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five seconds straight on at 5 m/s, while the odometry claims 0.2 m/s to the left."""
    none = np.zeros((0, 2))
    drive = exact_log(np.tile([5.0, 0.2, 0.0], (251, 1)), none, np.zeros(0, np.intp))

    def last_pose() -> Array:
        mapper = FixedLagMapper(odometry_sigma=np.array([0.05, 1.0, 0.005]))
        for cycle in split_odometry(drive):
            mapper.update(*cycle, strict=True)
        return mapper.poses[-1]

    np.testing.assert_allclose(last_pose(), [25.0, 1.0, 0.0], atol=1e-9)
    page("no_slip")
    window = module_of("window", file_blocks(ROOT / "docs" / "extending.md")["graph/window.py"])
    monkeypatch.setattr(WindowFactors, "_rows", window._rows)
    np.testing.assert_allclose(last_pose(), [25.0, 0.0, 0.0], atol=0.02)


# --- a new phase -----------------------------------------------------------------------------------------


def test_the_new_phase_freezes_the_map_in_the_pit_lane(
    page: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cones half a metre beside the boundaries, seen in the lane only, change nothing there."""
    pit_lane, circuit = page("pit_lane"), page("circuit")
    drive = noisy_lap()
    beside, middle = np.array([0.0, 0.5]), true_poses(drive)[180, :2]
    monkeypatch.setattr(circuit.Circuit, "lane", (middle, 8.0))
    mapper, frozen, conditions = circuit.PitMapper(odometry_sigma=drive.odometry_sigma), [], []
    for odometry, seen in islice(split_odometry(drive), 205):
        if isinstance(mapper.phase, pit_lane.PitLane):
            result = replay(mapper, odometry, replace(seen, points_vehicle=seen.points_vehicle + beside))
            frozen.append(np.concatenate([mapper.control_points(label) for label in BOUNDARIES]))
            conditions.append((result.readings, result.health.condition))
        else:
            result = replay(mapper, odometry, seen)
    assert 15 < len(frozen) < 30  # 16 m at 8 m/s
    np.testing.assert_allclose(frozen[-1], frozen[0], atol=0.002)
    assert set(conditions[:-1]) == {(0, "degraded")}
    assert isinstance(mapper.phase, circuit.Circuit)
    assert result.readings > 5 and result.health.condition == "good"


# --- another part ----------------------------------------------------------------------------------------


def mapped(mapper: FixedLagMapper, log: Log) -> FixedLagMapper:
    for odometry, detections in split_odometry(log):
        mapper.update(odometry, detections, strict=True)
    return mapper


def test_another_loss_weighs_the_rows(log: Log, page: Callable[[str], ModuleType]) -> None:
    """The rows r w of a residual r by Cauchy's loss have the root weight w = 1 / sqrt(1 + (r / 2)^2)."""
    cauchy = page("cauchy")
    plain = MapperSettings(gate=replace(MapperSettings().gate, huber=np.inf))
    mapper = mapped(cauchy.CauchyMapper(plain, log.odometry_sigma), log)
    curves = mapper.road.smoother.map
    assert isinstance(curves, cauchy.CauchyMap)
    cycles = mapper.road.smoother.cycles
    (own, *_), (unweighted, *_) = curves.rows(cycles), CurveMap.rows(curves, cycles)
    large = np.abs(unweighted.residual).argmax()
    assert abs(unweighted.residual[large]) > 1.0
    weight = 1.0 / np.sqrt(1.0 + (unweighted.residual / 2.0) ** 2)
    np.testing.assert_allclose(own.residual, weight * unweighted.residual)
    np.testing.assert_allclose(own.jacobian[large], weight[large] * unweighted.jacobian[large])
    usual = mapped(FixedLagMapper(odometry_sigma=log.odometry_sigma), log)
    apart = mapper.poses[-1] - usual.poses[-1]
    assert 1e-6 < np.hypot(*apart[:2]) < 0.2


def test_another_association_uses_what_it_says(log: Log, page: Callable[[str], ModuleType]) -> None:
    """Growth uses what it has grown through, until the next cycle's association."""
    near = page("near").NearMapper(odometry_sigma=log.odometry_sigma)
    usual = mapped(FixedLagMapper(odometry_sigma=log.odometry_sigma), log)

    def farthest(mapper: FixedLagMapper) -> float:
        detections = mapper.road.smoother.map.detections
        return float(np.hypot(*detections.measured[detections.used].T).max(initial=0.0))

    found = list[float]()
    for odometry, detections in split_odometry(log):
        near.update(odometry, detections, strict=True)
        if not near.road.grown and detections.t > 3.0:  # both curves have begun
            found.append(farthest(near))
    assert len(found) > 20
    assert 4.0 < max(found) <= 8.0 < farthest(usual)
    assert np.hypot(*(near.poses[-1] - usual.poses[-1])[:2]) < 0.5


# --- a new estimator -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the page's estimator as pip would install it: the module beside its metadata."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copy(ESTIMATOR / "dead_reckoning.py", folder)
    project = tomllib.loads((ESTIMATOR / "pyproject.toml").read_text())["project"]
    info = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    groups = [
        "\n".join([f"[{group}]", *(f"{name} = {target}" for name, target in points.items())])
        for group, points in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(groups) + "\n")
    return folder


@pytest.fixture(scope="module")
def log_folder(installed: Path, log: Log) -> Path:
    """The short drive as a log folder."""
    write_log(log, installed / "log")
    return installed / "log"


def run_command(folder: Path, command: str) -> str:
    """What a command prints; the folder is both where it runs and where the estimator is installed."""
    paths = [str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    arguments = [sys.executable, "-m", PACKAGE, *command.split()]
    done = subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_new_estimator_maps_online(installed: Path, log_folder: Path) -> None:
    printed = run_command(installed, f"online {log_folder} --out map --estimator dead-reckoning")
    assert "loop not closed" in printed
    assert len((installed / "map" / "trajectory.tum").read_text().splitlines()) == 80


@pytest.mark.slow
def test_the_new_estimator_is_compared(installed: Path, log_folder: Path) -> None:
    names = ["dead-reckoning", "landmark-fixed-lag"]
    run_command(installed, f"compare {log_folder} --out comparison --estimators {' '.join(names)}")
    rows = csv_rows(installed / "comparison" / "table.csv")
    assert [row["estimator"] for row in rows] == names
    assert all(0.0 < float(row["rmse"]) < 1.0 and float(row["missed"]) < 0.9 for row in rows)


@pytest.mark.slow
def test_the_new_estimator_is_ablated(installed: Path) -> None:
    shutil.copy(ESTIMATOR / "dead_reckoning.toml", installed / "study.toml")
    track = write_round_track(installed)
    run_command(installed, f"ablate study.toml --out study --tracks {track} --jobs 1")
    rows = csv_rows(installed / "study" / "results.csv")
    assert {row["estimator"] for row in rows} == {"fixed-lag", "dead-reckoning"}
    assert all(0.0 < float(row["rmse"]) < 1.0 and float(row["missed"]) < 0.9 for row in rows)


@pytest.mark.slow
def test_the_new_estimator_is_scaled(installed: Path) -> None:
    run_command(installed, "scale --out scaling --quick --estimators dead-reckoning")
    rows = csv_rows(installed / "scaling" / "points.csv")
    assert {row["estimator"] for row in rows} == {"dead-reckoning"}


# --- a factor of one's own in every estimator ------------------------------------------------------------

COMPASS_POINTS = """[pathspace_graph.online]
compass-fixed-lag = compass_mappers:CompassFixedLag
[pathspace_graph.batch]
compass-batch = compass_mappers:CompassBatch
"""
COMPASS_STUDY = """estimators = ["fixed-lag", "compass-fixed-lag", "spline", "compass-batch"]
tracks = ["round.csv"]
laps = 1
metrics = ["ate"]
"""


@pytest.mark.slow
def test_a_compass_is_ablated_and_in_the_graph(tmp_path: Path, log: Log) -> None:
    info = tmp_path / "compass_mappers-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: compass-mappers\nVersion: 1\n")
    (info / "entry_points.txt").write_text(COMPASS_POINTS)
    for name in ("compass", "compass_mappers"):
        shutil.copy(EXTENDING / f"{name}.py", tmp_path)
    (tmp_path / "study.toml").write_text(COMPASS_STUDY)
    write_round_track(tmp_path)
    run_command(tmp_path, "ablate study.toml --out study --jobs 1")
    rows = {row["estimator"]: row for row in csv_rows(tmp_path / "study" / "results.csv")}
    assert not any(row["failure"] for row in rows.values())
    for without, with_it in (("fixed-lag", "compass-fixed-lag"), ("spline", "compass-batch")):
        assert float(rows[with_it]["ate"]) < 0.8 * float(rows[without]["ate"])
    write_log(log, tmp_path / "log")
    sizes = []
    for name in ("spline", "compass-batch"):
        run_command(tmp_path, f"batch log --out {name} --estimator {name} --graph")
        sizes.append(read_graph(tmp_path / name / "graph.json")[0].size())
    assert sizes[1] - sizes[0] == len(log.cycles)
