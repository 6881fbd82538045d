"""Studies as they are written: what they resolve to, and what is refused before anything runs."""

from __future__ import annotations

import pickle
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.estimators import known_estimators
from pathspace_graph.eval.experiment.run import make_plan
from pathspace_graph.eval.experiment.study import (
    SHIPPED,
    Baseline,
    Study,
    find_study,
    load_tracks,
    read_study_file,
    shipped_studies,
    simulated_drive,
    study_from,
    track_digest,
)
from pathspace_graph.eval.metrics.measures import lap_times
from pathspace_graph.settings.checked import leaves, override
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, preset, simulate
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.sim.vehicle import VehicleSettings

from ...scenes.paths import ROOT
from ...scenes.pretenders import write_round_track

WHOLE = """
question = "Why?"
tracks = [0, "oval.csv"]
seeds = [3, 4]
laps = 2
estimators = ["landmark-fixed-lag", "fixed-lag"]
metrics = ["rmse", "size"]
baseline = { variant = "soft", estimator = "fixed-lag" }

[noise.quiet]
odometry.white = [0.1, 0.1, 0.01]

[noise.loud]
sensor.bearing_sigma = 1

[variants.soft]
gate.huber = inf
"gauge.sigma_spacing" = 1

[[grid]]
lag = [1.0, 3]
spline.degree = [2, 3]

[[grid]]
steps = [2]
"""


def study(text: str) -> Study:
    return study_from(tomllib.loads(text), Path("folder"))


def test_a_whole_study_is_read() -> None:
    read = study(WHOLE)
    assert read.tracks == (0, Path("folder/oval.csv"))
    assert read.estimators == ("landmark-fixed-lag", "fixed-lag")
    assert read.baseline == Baseline("soft", "fixed-lag")
    assert read.simulation("quiet").odometry.white == (0.1, 0.1, 0.01)
    assert read.simulation("quiet").laps == 2
    assert read.simulation("loud").sensor.bearing_sigma == 1.0
    assert read.points["soft"].settings.gate.huber == float("inf")
    assert read.points["lag=1, spline.degree=2"].settings.lag == 1.0
    assert read.points["lag=1, spline.degree=2"].settings.spline.degree == 2
    assert read.varied == ("gate.huber", "gauge.sigma_spacing", "lag", "spline.degree", "steps")
    assert read.varied_noise == ("odometry.white", "sensor.bearing_sigma")


def test_variants_that_come_to_the_same_are_run_once() -> None:
    read = study(WHOLE)
    default = MapperSettings()
    assert (default.lag, default.spline.degree) == (3.0, 3)
    assert list(read.points) == [
        "default",
        "soft",
        "lag=1, spline.degree=2",
        "lag=1, spline.degree=3",
        "lag=3, spline.degree=2",
        "steps=2",
    ]
    same = study('tracks = [0]\nbaseline.variant = "lag=3"\ngrid.lag = [1.0, 3.0, 1.00000001]')
    assert same.baseline_variant == "default" and [*same.points] == ["default", "lag=1", "lag=1.00000001"]


def test_from_python_as_from_a_file() -> None:
    made = Study(tracks=[0, "folder/oval.csv"], seeds=[3, 4], estimators="fixed-lag", grids=[{"lag": [1.0]}])
    assert made == study(
        'tracks = [0, "oval.csv"]\nseeds = [3, 4]\nestimators = ["fixed-lag"]\ngrid.lag = [1.0]'
    )
    assert study('tracks = [0]\nestimators = "all"').estimators == tuple(known_estimators())


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("seeds = [0]", "tracks: expected at least one"),
        ("tracks = [0, 0]", "none twice"),
        ("tracks = [-1]", "tracks: expected whole numbers"),
        ("tracks = [0]\nseeds = 3", "seeds: expected a list"),
        ("tracks = [0]\nlaps = 0", "laps: expected a positive whole number"),
        ("tracks = [0]\nlaps = true", "laps: expected a whole number"),
        ("tracks = [0]\nlap = 1", "found 'lap', the nearest is 'laps'"),
        ("tracks = [0]\nname = 1", "name: expected text"),
        ('tracks = [0]\nestimators = ["fixed-leg"]', "found 'fixed-leg', the nearest is 'fixed-lag'"),
        ('tracks = [0]\nmetrics = ["rsme"]', "found 'rsme', the nearest is 'rmse'"),
        ("tracks = [0]\ngrid.spline.degre = [1]", "found 'spline.degre', the nearest is 'spline.degree'"),
        ("tracks = [0]\ngrid.lag = []", "grid.lag: expected a list"),
        ("tracks = [0]\ngrid.lag = [-1.0]", "grid.lag: expected a positive number, found -1.0"),
        ("tracks = [0]\nvariants.default.lag = 1.0", "variants.default: that name is kept"),
        ("tracks = [0]\nvariants.fast = 1", "variants.fast: expected a table"),
        ('tracks = [0]\ngrid.lag = [1.0]\nvariants."lag=1".steps = 2', "expected every name once"),
        ("tracks = [0]\nnoise.loud.odometry.white = [1.0]", "noise.loud.odometry.white: expected"),
        ("tracks = [0]\nnoise.loud.laps = 3", "noise.loud.laps: expected laps as a key"),
        ('tracks = [0]\nbaseline.variant = "defualt"', "found 'defualt', the nearest is 'default'"),
        ('tracks = [0]\nbaseline.estimator = "spline"', "baseline.estimator: expected one of the study's"),
        ('tracks = [0]\nbaseline.settings = "x"', "baseline: expected a known key"),
        ('tracks = [0]\npublished.note = "x"', "published: Object contains unknown field `note`"),
        ("tracks = [0]\npublished.laps.ckf.rmse = [1.0]", "published.laps: expected one of the study's"),
        ("tracks = [0]\npublished.laps.fixed-lag.rsme = [1]", "found 'rsme', the nearest is 'rmse'"),
    ],
)
def test_what_is_unknown_or_wrong_is_refused(text: str, says: str) -> None:
    with pytest.raises(SettingsError) as refused:
        study(text)
    assert says in str(refused.value)


def test_a_file_that_is_wrong_is_named(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    with pytest.raises(InputError, match=r"mine\.toml"):
        read_study_file(file)
    file.write_text("tracks = [")
    with pytest.raises(InputError, match=r"mine.toml: expected TOML"):
        read_study_file(file)
    file.write_text("tracks = [0]\nlap = 1")
    with pytest.raises(InputError, match=r"mine.toml: expected a known key"):
        read_study_file(file)
    file.write_text("tracks = [0]")
    assert read_study_file(file).name == "mine"


def test_a_study_is_found_by_name_or_refused_with_the_nearest() -> None:
    assert find_study(Path("degree")) == SHIPPED / "degree.toml"
    with pytest.raises(SettingsError, match="the nearest is 'degree'"):
        find_study(Path("degre"))


def test_a_noise_names_presets_and_overrides_them() -> None:
    noise = {"sensor": {"preset": "camera", "range_max": 30.0}, "odometry": {"preset": "ins"}}
    study = study_from({"tracks": [0], "noise": {"camera": noise}})
    simulation = study.simulation("camera")
    named = preset({"sensor": "camera", "odometry": "ins"})
    assert simulation.sensor == replace(named.sensor, range_max=30.0) != named.sensor
    assert (simulation.odometry, simulation.vehicle) == (named.odometry, named.vehicle)
    assert simulation.faults == named.faults
    assert (simulation.sensor.rate, simulation.vehicle.rate, simulation.faults.sensor.yaw) == (
        5.0,
        40.0,
        -0.0175,
    )
    assert study.varied_noise == ("sensor.range_max",)
    with pytest.raises(SettingsError, match=r"sensor: expected a known preset.*'camra'"):
        study_from({"tracks": [0], "noise": {"camera": {"sensor.preset": "camra"}}})


def test_the_studies_listed_are_the_files_on_disk_and_are_shipped() -> None:
    assert set(shipped_studies()) == {file.stem for file in (ROOT / "eval" / "studies").glob("*.toml")}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    shipped = project["tool"]["setuptools"]["package-data"]["pathspace_graph.eval"]
    assert {"*.toml", "studies/*.toml", "studies/tracks/*.csv"} <= set(shipped)


@pytest.mark.parametrize("file", sorted((SHIPPED / "tracks").iterdir()), ids=lambda file: file.stem)
def test_every_shipped_track_can_be_driven_whole_and_in_part(file: Path) -> None:
    track = read_track(file)
    whole, part = (
        simulate(track, SimulationSettings(laps=1, vehicle=VehicleSettings(overrun=overrun)), 0)
        for overrun in (10.0, -60.0)
    )
    assert (len(lap_times(whole)), len(lap_times(part))) == (1, 0)


@pytest.mark.parametrize("name", shipped_studies())
def test_every_shipped_study_is_sound_and_listed(name: str) -> None:
    read = read_study_file(find_study(Path(name)))
    assert len(read.tracks) * len(read.seeds) >= {
        "acceleration": 10,
        "accuracy": 6,
        "skidpad": 10,
        "hard": 16,
        "lines": 6,
        "faults": 4,
        "endurance": 4,
        "sizes": 4,
    }.get(name, 20)
    assert len(read.points) > 1 or len(read.estimators) > 1 or len(read.metrics) > 1
    assert f"`{name}`" in (ROOT / "docs" / "ablate.md").read_text()


def test_the_examples_of_the_pages_are_sound() -> None:
    text = (ROOT / "docs" / "ablate.md").read_text()
    example, logs, published = re.findall(r"```toml\n(.*?)```", text, flags=re.DOTALL)
    beside = study(f'tracks = [0]\nestimators = ["ckf"]\n{published}').published
    assert beside.laps == {"ckf": {"rmse": [0.58, 0.62]}} and set(beside.notes) == {"rmse"}
    assert set(tomllib.loads(logs.split("\n\n")[1])["drives"]) == {"logs"}
    assert len(study(example).points) == 1 + 1 + 3


# --- settings --------------------------------------------------------------------------------------------


def test_every_leaf_of_both_trees_can_be_set_to_what_it_is() -> None:
    for tree in (MapperSettings(), SimulationSettings()):
        values = {name: value for name, value in leaves(tree).items() if value is not None}
        assert override(tree, values, "here") == tree


# --- cells -----------------------------------------------------------------------------------------------


def test_cells_share_a_drive_and_have_an_identity_each() -> None:
    made = Study(
        tracks=(0,),
        seeds=(0, 1),
        laps=1,
        noise={"quiet": {}, "loud": {"sensor.bearing_sigma": 1.0}},
        estimators=("fixed-lag", "landmark-fixed-lag"),
        grids=({"lag": [1.0]},),
    )
    cells = make_plan(made).cells
    assert len(cells) == 2 * 2 * 2 * 2
    assert len({cell.id for cell in cells}) == len(cells)
    assert len({cell.drive.id for cell in cells}) == len({id(cell.drive) for cell in cells}) == 4
    again = make_plan(made).cells
    assert [cell.id for cell in again] == [cell.id for cell in cells]


def test_a_cell_is_known_by_what_it_runs_not_by_what_it_is_called() -> None:
    grid = make_plan(Study(tracks=(0,), grids=({"lag": [1.0]},))).cells[1]
    named = make_plan(Study(tracks=(0,), variants={"short": {"lag": 1.0}})).cells[1]
    assert grid.names["variant"] != named.names["variant"]
    assert grid.id == named.id
    longer = make_plan(Study(tracks=(0,), laps=6)).cells[0]
    assert longer.id != make_plan(Study(tracks=(0,))).cells[0].id


# --- drives ----------------------------------------------------------------------------------------------


def folder_of_two(folder: Path) -> Path:
    """A folder with two track files, and a file that is none."""
    folder.mkdir()
    track = write_round_track(folder)
    track.rename(folder / f"another{track.suffix}")
    write_round_track(folder)
    (folder / "README.md").write_text("no track")
    return folder


def test_a_folder_stands_for_its_track_files_in_order(tmp_path: Path) -> None:
    folder = folder_of_two(tmp_path / "tracks")
    names = sorted(file.stem for file in folder.iterdir() if file.suffix != ".md")
    assert [track.name for track in load_tracks([folder, 3])] == [*names, "generated 3"]


def test_files_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    files = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        files.append(write_round_track(tmp_path / name))
    assert [track.name for track in load_tracks(files)] == [f"{n}/{files[0].stem}" for n in ("a", "b")]


def test_a_folder_without_tracks_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected track files"):
        load_tracks([tmp_path])
    track = write_round_track(tmp_path)
    wrong = track.with_name(f"x{track.name}")
    with pytest.raises(InputError, match=f"the nearest is '{track.name}'"):
        load_tracks([wrong])


def test_a_drive_is_the_same_by_geometry_seed_and_simulation_whatever_its_names() -> None:
    (track,) = load_tracks([0])
    two, three = (SimulationSettings(laps=laps) for laps in (2, 3))
    drive, renamed = simulated_drive(track, 0, "nominal", two), replace(track, name="another name")
    assert simulated_drive(renamed, 0, "quiet", two).id == drive.id
    assert simulated_drive(track, 1, "nominal", two).id != drive.id
    assert simulated_drive(track, 0, "nominal", three).id != drive.id
    assert pickle.loads(pickle.dumps(drive)).id == drive.id, "it is an argument of cells"


def test_the_last_digits_of_a_track_do_not_matter_to_its_drives_and_a_centimetre_does() -> None:
    (track,) = load_tracks([0])
    simple = replace(track, other=np.array([[-0.0, 0.0005], [1.0, 2.5 / 3.0]]))
    for one in (track, simple):
        for shift in (-1e-12, 1e-12):
            moved = {name: getattr(one, name) + shift for name in ("left", "right", "other", "start")}
            assert track_digest(replace(one, **moved)) == track_digest(one)
        for name in ("left", "right", "start"):
            cone_moved = getattr(one, name).copy()
            cone_moved.flat[-1] += 0.01
            assert track_digest(replace(one, **{name: cone_moved})) != track_digest(one)
    assert track_digest(replace(simple, other=np.abs(simple.other))) == track_digest(simple)


def test_the_drives_of_a_generated_track_are_those_of_every_machine() -> None:
    """Another number makes other drives on all generated tracks, and all figures of the pages old."""
    assert simulated_drive(load_tracks([0])[0], 0, "nominal", SimulationSettings()).source == "3921578876"
