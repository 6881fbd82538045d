"""The film of a run: as many frames as its time asks for, of one size, with what happened in words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from pathspace_graph.cli import main
from pathspace_graph.estimators import make_online
from pathspace_graph.eval.view.animation import Animation, lap_seconds
from pathspace_graph.io.log import Log, Odometry, write_log
from pathspace_graph.run import ObservedCycle, run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.output import FilmSettings

from ...scenes.drives import ahead, bean_track, corridor, detections, exact_log, lap_log
from .conftest import FILM, OrangeMapper


class Reel:
    """A film that keeps the words of its frames."""

    def __init__(self) -> None:
        self.words: list[set[str]] = []
        self.seconds: list[float] = []

    def __call__(self, figure: Figure, seconds: float) -> None:
        self.words.append({text.get_text() for axes in figure.axes for text in axes.texts})
        self.seconds.append(seconds)


@pytest.fixture(scope="module")
def short_log() -> Log:
    return exact_log(ahead(8.0, 2.0), *corridor(40.0))


def test_a_lap_is_known_by_the_truth_or_by_the_turn_of_the_odometry() -> None:
    log = lap_log(bean_track())
    by_truth, by_turn = lap_seconds(log), lap_seconds(replace(log, truth=None))
    assert by_turn == pytest.approx(by_truth, rel=0.1)


def test_a_road_is_one_lap_and_a_log_of_one_cycle_has_a_length(short_log: Log) -> None:
    road = replace(short_log, truth=None)
    assert lap_seconds(road) == pytest.approx(road.cycles[-1].t - road.cycles[0].t)
    assert lap_seconds(replace(road, cycles=road.cycles[:1])) > 0.0
    assert lap_seconds(replace(road, cycles=())) > 0.0


def test_the_turn_of_the_odometry_is_counted_between_the_cycles_only() -> None:
    t = np.linspace(0.0, 9.9, 100)
    twist = np.tile([1.0, 0.0, 2.0 * np.pi / 5.0], (100, 1))  # a turn takes 5 s
    none = detections(0.0, np.zeros((0, 2)), np.zeros(0, np.intp))
    log = Log(Odometry(t, twist), tuple(replace(none, t=at) for at in (2.0, 7.0)), np.ones(3))
    assert lap_seconds(log) == pytest.approx(5.0, rel=0.03)


def test_the_film_ends_after_its_laps_and_the_mapping_goes_on(short_log: Log) -> None:
    reel, settings = Reel(), FilmSettings(seconds_per_lap=2.0, frames_per_second=5.0, laps=0.5)
    animation = Animation(reel, lap_seconds(short_log), settings)
    result = run_online(short_log, make_online("ckf", MapperSettings(), short_log), observers=[animation])
    animation.finish()
    assert len(result.cycles) == len(short_log.cycles)
    assert reel.seconds == pytest.approx([0.2] * 5 + [settings.hold])


def test_a_film_without_a_frame_has_nothing_to_hold() -> None:
    reel = Reel()
    Animation(reel, 1.0, FILM).finish()
    assert reel.seconds == []


@pytest.mark.parametrize("name", ["landmark-fixed-lag", "ckf", "landmark-ckf"])
def test_every_online_estimator_has_a_film(name: str, short_log: Log) -> None:
    reel, settings = Reel(), FilmSettings(seconds_per_lap=0.5, width=200, height=150)
    animation = Animation(reel, lap_seconds(short_log), settings, short_log.truth)
    run_online(short_log, make_online(name, MapperSettings(), short_log), observers=[animation])
    assert {"time", "lap", "open", "rmse"} <= reel.words[-1]
    assert ("landmarks" in reel.words[-1]) == name.startswith("landmark")


def test_orange_cones_are_drawn(short_log: Log) -> None:
    figures: list[Figure] = []

    class Kept(Reel):
        def __call__(self, figure: Figure, seconds: float) -> None:
            figures.append(figure)

    animation = Animation(Kept(), lap_seconds(short_log), FILM)
    run_online(short_log, OrangeMapper(odometry_sigma=short_log.odometry_sigma), observers=[animation])
    places = [line.get_xydata() for line in figures[-1].axes[0].lines if line.get_marker() == "^"]
    assert len(places) == 1
    np.testing.assert_array_equal(places[0], OrangeMapper.cones)


def test_what_happens_is_told_for_a_while(short_log: Log) -> None:
    reel = Reel()
    settings = FilmSettings(seconds_per_lap=10.0, frames_per_second=2.0, width=200, height=150)
    animation = Animation(reel, lap_seconds(short_log), settings)

    def look(cycle: ObservedCycle) -> None:
        happened = {5: {"jump": np.array([3.0, 4.0, 0.0])}, 12: {"closed": True}}
        animation(replace(cycle, result=replace(cycle.result, **happened.get(cycle.number, {}))))

    run_online(short_log, make_online("ckf", MapperSettings(), short_log), observers=[look])
    told = [any("moves by 5.00 m" in word for word in words) for words in reel.words]
    assert 1 < sum(told) <= 4
    assert any(word.startswith("loop closed: ") for words in reel.words for word in words)


def test_the_command_writes_map_film_and_recording(short_log: Log, tmp_path: Path) -> None:
    write_log(short_log, tmp_path / "log")
    out = [f"{tmp_path}/{name}" for name in ("map", "a.gif", "a.rrd")]
    small = ["--film.width", "200", "--film.height", "150", "--film.seconds-per-lap", "0.5"]
    options = ["--out", out[0], "--animate", out[1], "--save-view", out[2], "--recording.band-every", "5"]
    assert main(["online", f"{tmp_path}/log", *options, *small]) == 0
    assert main(["online", f"{tmp_path}/log", "--out", f"{tmp_path}/alone"]) == 0
    assert all(Path(path).exists() for path in out)
    assert Path(out[1]).read_bytes().startswith(b"GIF89a")
    assert (tmp_path / "map" / "map.json").read_bytes() == (tmp_path / "alone" / "map.json").read_bytes()


def test_a_log_without_cycles_has_no_film(
    short_log: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(replace(short_log, cycles=()), tmp_path / "log")
    options = ["--out", f"{tmp_path}/map", "--animate", f"{tmp_path}/a.gif"]
    assert main(["online", f"{tmp_path}/log", *options]) == 2
    assert "--animate: expected a log with perception cycles, found none" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"log"}
