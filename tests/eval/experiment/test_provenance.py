"""What a result depends on: the sources of an estimator and of what it imports, and the settings it reads."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from importlib import invalidate_caches
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pathspace_graph import estimators as registry
from pathspace_graph.cli import main
from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.experiment import run
from pathspace_graph.eval.experiment.run import code_from, origin_of, run_study
from pathspace_graph.eval.experiment.study import Study, read_study_file
from pathspace_graph.io.log_files import write_log
from pathspace_graph.io.map import PointBoundary, read_map
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.checked import leaves
from pathspace_graph.settings.mapper import MapperSettings

from ...scenes.drives import noisy_lap
from ...scenes.pretenders import write_round_track

PLUGIN = """
from dataclasses import dataclass
from typing import ClassVar
import numpy as np
from pathspace_graph.io.map import Map, PointBoundary
from pathspace_graph.run import CycleResult
from plugin_lib import far

class Plugin:
    @dataclass(frozen=True)
    class Parameters:
        radius: float = 2.0

    READS = ("lag",)

    def __init__(self, settings, noise, parameters):
        assert parameters.radius > 0.0, "a negative radius"
        self.settings, self.noise, self.parameters = settings, noise, parameters

    def update(self, odometry, detections):
        return CycleResult(detections.t, np.zeros(3), (2, 2), 1, False)

    def map(self):
        points = np.array([[far.AWAY * self.settings.lag, 0.0], [0.0, -self.parameters.radius]])
        return Map(False, {label: PointBoundary(points, np.eye(4)) for label in (0, 1)})
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with an estimator of another package, and a library that is in no distribution."""
    folder = tmp_path / "src"
    (folder / "plugin_lib").mkdir(parents=True)
    (folder / "plugin_main.py").write_text(PLUGIN)
    (folder / "plugin_lib" / "__init__.py").write_text("")
    (folder / "plugin_lib" / "far.py").write_text("AWAY = 3.0\n")
    monkeypatch.syspath_prepend(folder)
    point = EntryPoint("plugin", "plugin_main:Plugin", registry.ONLINE_GROUP)
    monkeypatch.setitem(registry.ONLINE, "plugin", registry.Elsewhere(point))  # type: ignore[misc]
    forget()
    yield folder
    forget()


def forget() -> None:
    """Let this process be as one that has just been started."""
    for name in [name for name in sys.modules if name.startswith("plugin_")]:
        del sys.modules[name]
    for cached in (code_from, run._spec, run._imports):
        cached.cache_clear()
    invalidate_caches()
    for made_by in registry.ONLINE.values():
        if isinstance(made_by, registry.Elsewhere):
            vars(made_by).pop("maker", None)


def study(tmp_path: Path, **of: Any) -> Study:
    track = tmp_path / "round.csv"
    return Study(tracks=(track if track.exists() else write_round_track(tmp_path),), laps=1, **of)


# --- sources ---------------------------------------------------------------------------------------------


def test_the_code_of_an_estimator_has_what_it_imports_and_no_other_estimator() -> None:
    code = code_from(registry.module_of("ckf"))
    ours = {name.removeprefix("pathspace_graph.") for name in code}
    assert {"baselines.filters", "baselines.ckf", "factors._kernels", "run", "sim.simulate"} <= ours
    assert {"eval.metrics.measures", "settings.mapper", "gtsam", "numpy", "scipy"} <= ours
    assert not {"online.fixed_lag", "pandas", "sim.track_files"} & ours
    assert "online.fixed_lag" in {
        name.removeprefix("pathspace_graph.") for name in code_from(registry.module_of("fixed-lag"))
    }


def test_a_change_of_the_kernels_is_a_change_of_the_code(tmp_path: Path) -> None:
    library = tmp_path / f"_kernels{EXTENSION_SUFFIXES[0]}"
    library.write_bytes(b"compiled")
    digests = [run._digest(library)]
    (tmp_path / "kernels").mkdir()
    source = tmp_path / "kernels" / "a.cpp"
    for text in ("1", "2"):
        source.write_text(text)
        digests.append(run._digest(library))
    assert len({*digests}) == 3


def test_a_plugin_is_known_by_its_sources_and_those_of_its_unversioned_imports(plugin: Path) -> None:
    code = code_from("plugin_main")
    assert {"plugin_main", "plugin_lib", "plugin_lib.far", "pathspace_graph.io.map"} <= set(code)
    (plugin / "plugin_lib" / "far.py").write_text("AWAY = 4.0\n")
    assert code_from("plugin_main") == code, "the process goes on with what it has read"
    forget()
    changed = code_from("plugin_main")
    assert {name for name in code if code[name] != changed[name]} == {"plugin_lib.far"}


def test_an_estimator_without_sources_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "_spec", lambda name: None)
    with pytest.raises(SettingsError, match="expected one of a module with sources, found __main__"):
        code_from("__main__")


def test_a_worker_of_other_code_stops_the_study(
    plugin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plugin changes after the study has begun, and before a worker reads it."""
    of = study(tmp_path, estimators=("plugin",))
    real, forgotten = run.check_code, []

    def changed(*arguments: Any) -> None:
        if not forgotten:
            forgotten.append(True)
            (plugin / "plugin_lib" / "far.py").write_text("AWAY = 4.0\n")
            forget()
        real(*arguments)

    monkeypatch.setattr("pathspace_graph.eval.experiment.run.check_code", changed)
    says = r"plugin_main: expected the code of \S+ .*plugin_lib.far \w{12}, found plugin_lib.far \w{12} on"
    with pytest.raises(SettingsError, match=says):
        run_study(of, tmp_path / "out")
    assert not [*(tmp_path / "out").glob("cells/*")]


def test_a_result_says_where_and_when_it_was_made(tmp_path: Path) -> None:
    said = origin_of("pathspace_graph.online.fixed_lag")
    assert {"gtsam", "numpy", "python", "commit", "host", "processor", "blas", "date"} <= set(said)
    assert said["blas"] and said["processor"] and said["date"].endswith("+00:00")
    frame = run_study(study(tmp_path, estimators=("landmark-ckf",)), tmp_path / "out")
    assert frame["command"].iloc[0] and frame["host"].iloc[0] == said["host"]


# --- settings --------------------------------------------------------------------------------------------


def spied(settings: Any, seen: set[str], prefix: str = "") -> Any:
    """Settings that note the dotted name of every one that is read."""
    names = {entry.name for entry in fields(settings)}

    def read(self: object, name: str) -> Any:
        if name in names:
            seen.add(f"{prefix}{name}")
        return object.__getattribute__(self, name)

    spy = object.__new__(type("Spy", (type(settings),), {"__getattribute__": read}))
    for name in names:
        value = getattr(settings, name)
        inner = spied(value, seen, f"{prefix}{name}.") if is_dataclass(value) else value
        object.__setattr__(spy, name, inner)
    return spy


@pytest.mark.parametrize("name", ["landmark-fixed-lag", "ckf", "landmark-ckf"])
def test_an_estimator_reads_the_settings_that_it_says(name: str) -> None:
    seen: set[str] = set()
    log = noisy_lap()
    settings = spied(MapperSettings(kind="cones"), seen)
    estimator = registry.ONLINE[name](settings, log.noise)
    seen.clear()
    for odometry, detections in [*split_odometry(log)][:80]:
        estimator.update(odometry, detections)
    assert {field for field in seen & {*leaves(MapperSettings())} if not registry.reads(name, field)} == set()
    assert seen & {"growth.merge_radius", "growth.sightings", "ckf.sightings"}
    assert not registry.reads(name, "stations") and not registry.reads(name, "far.range")
    assert registry.reads("fixed-lag", "stations"), "it says nothing, and so reads all"


def test_cells_that_differ_in_settings_that_are_not_read_are_run_once(tmp_path: Path) -> None:
    of = study(tmp_path, estimators=("landmark-ckf",), grids=({"lag": [1.0, 2.0]}, {"ckf.sightings": [2]}))
    done: list[tuple[int, int]] = []
    frame = run_study(of, on_cell=lambda *told: done.append(told))
    assert done[-1] == (2, 2)
    same = frame[frame["variant"] != "ckf.sightings=2"]
    assert len(same) == 3 and same["cell"].nunique() == 1 and same["rmse"].nunique() == 1


# --- parameters and broken plugins -----------------------------------------------------------------------


def test_own_parameters_are_varied_by_a_study(plugin: Path, tmp_path: Path) -> None:
    of = study(tmp_path, estimators=("plugin", "landmark-ckf"), grids=({"plugin.radius": [2.0, 5.0]},))
    frame = run_study(of)
    own = frame[frame["estimator"] == "plugin"].set_index("variant")
    assert [*own["plugin.radius"]] == [2.0, 5.0]
    assert own["rmse"].nunique() == 2
    other = frame[frame["estimator"] == "landmark-ckf"]
    assert other["cell"].nunique() == 1 and other["plugin.radius"].isna().all()
    with pytest.raises(SettingsError, match=r"grid.plugin: .*the nearest is 'radius'"):
        study(tmp_path, estimators=("plugin",), grids=({"plugin.radus": [2.0]},))


def test_own_parameters_are_a_section_of_a_study_s_settings(plugin: Path, tmp_path: Path) -> None:
    text = 'tracks = [0]\nestimators = ["plugin", "ckf"]\nsettings = {lag = 2.0, plugin.radius = 4.0}\n'
    (tmp_path / "own.toml").write_text(f"{text}variants.wide.plugin.radius = 9.0\n")
    points = read_study_file(tmp_path / "own.toml").points
    radii = {name: dict(one.parameters)["plugin"].radius for name, one in points.items()}
    assert radii == {"default": 4.0, "wide": 9.0}
    assert points["default"].settings.lag == 2.0


def test_own_parameters_are_a_section_of_a_settings_file(plugin: Path, tmp_path: Path) -> None:
    """The summary has them, and is itself such a file."""
    log, settings = tmp_path / "log", tmp_path / "own.toml"
    write_log(noisy_lap(), log)
    settings.write_text("lag = 1.0\n[plugin]\nradius = 7.0\n")
    command = ["online", str(log), "--estimator", "plugin", "--lag", "2.0"]
    for out in ("first", "again"):
        assert main([*command, "--settings", str(settings), "--out", str(tmp_path / out)]) == 0
        right = read_map(tmp_path / out).right
        assert isinstance(right, PointBoundary)
        assert right.points.tolist() == [[6.0, 0.0], [0.0, -7.0]]
        settings = tmp_path / out / "summary.json"
    assert json.loads(settings.read_text())["settings"]["plugin"] == {"radius": 7.0}


@pytest.mark.parametrize(
    ("estimator", "section", "told"),
    [
        ("plugin", "radus = 7.0", "plugin: expected a known setting, found 'radus', the nearest is 'radius'"),
        ("plugin", "radius = 'wide'", "plugin.radius: expected a number, found 'wide'"),
        ("ckf", "radius = 7.0", "expected a setting, found 'plugin.radius'"),
    ],
)
def test_wrong_parameters_are_one_line(
    plugin: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], estimator: str, section: str, told: str
) -> None:
    (tmp_path / "own.toml").write_text(f"[plugin]\n{section}\n")
    options = ["--settings", str(tmp_path / "own.toml"), "--out", str(tmp_path / "out")]
    assert main(["online", str(tmp_path), "--estimator", estimator, *options]) == 2
    assert capsys.readouterr().err == f"pathspace-graph: {tmp_path / 'own.toml'}: {told}\n"


def test_a_broken_plugin_is_found_before_the_first_cell(plugin: Path, tmp_path: Path) -> None:
    negative = study(tmp_path, estimators=("plugin",), variants={"low": {"plugin.radius": -1.0}})
    with pytest.raises(SettingsError, match=r"plugin: .* found AssertionError: a negative radius") as refused:
        run_study(negative, tmp_path / "out")
    assert isinstance(refused.value.__cause__, AssertionError), "-v shows where it comes from"
    assert not (tmp_path / "out").exists()
    (plugin / "plugin_main.py").write_text("import nothing_of_this_name")
    forget()
    with pytest.raises(SettingsError, match=r"plugin_main:Plugin, found ModuleNotFoundError"):
        study(tmp_path, estimators=("plugin",))


def test_a_plugin_gets_what_ours_get(plugin: Path) -> None:
    log = replace(noisy_lap(), odometry_stated=False)
    estimator: Any = registry.make_online("plugin", MapperSettings(), log)
    np.testing.assert_array_equal(estimator.noise.odometry, log.odometry_sigma)
    assert not estimator.noise.odometry_stated
    assert estimator.parameters.radius == 2.0
