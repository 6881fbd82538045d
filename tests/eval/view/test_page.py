"""The page of a result: its figures have the data of the result, and it needs nothing but a browser."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pathspace_graph.cli import main
from pathspace_graph.eval.figures.drawing import curve_parameters, uncertainty_band
from pathspace_graph.eval.metrics.alignment import maps_apart
from pathspace_graph.eval.metrics.measures import summarize
from pathspace_graph.frames import run_frame
from pathspace_graph.health import DEGRADED, LOST
from pathspace_graph.io.map import Map, SplineBoundary, map_to_json
from pathspace_graph.io.results import SMOOTHED_FILE, write_result
from pathspace_graph.io.tables import read_trajectory
from pathspace_graph.labels import BOUNDARIES, NAMES

from ...scenes.maps import open_map, point_map
from .conftest import Watched

bokeh = pytest.importorskip("bokeh", reason="the extra `page` is not installed")
from bokeh.document import Document  # noqa: E402

from pathspace_graph.eval.view.page import page  # noqa: E402

MOST_BYTES = 5e6
LAPS = 5
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.fixture(scope="module")
def folder(run: Watched, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("result") / "<lap>"
    write_result(folder, run.alone, summarize(run.alone, run.log))
    return folder


@pytest.fixture(scope="module")
def html(folder: Path) -> Path:
    file = folder.parent / "page.html"
    assert main(["view", str(folder), "--html", str(file)]) == 0
    return file


def document_of(text: str) -> Document:
    (found,) = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', text, flags=re.DOTALL)
    (document,) = json.loads(found).values()
    return Document.from_json(document)


def drawn(document: Document, name: str, *columns: str) -> Any:
    """The data of what is drawn by this name."""
    data = document.get_model_by_name(name).data_source.data
    return np.column_stack([data[column] for column in columns or ("x", "y")])


def test_the_figures_have_the_data_of_the_result(run: Watched, html: Path) -> None:
    document, result = document_of(html.read_text()), run.alone
    cycles, frame = document.get_model_by_name("cycles").data, result.to_frame()
    path = result.trajectory if result.smoothed is None else result.smoothed
    np.testing.assert_allclose(np.column_stack([cycles["x"], cycles["y"]]), path[:, :2])
    np.testing.assert_allclose(np.exp(1j * cycles["theta"]), np.exp(1j * path[:, 2]))
    for name in ("t", "lap", "readings", "offered", "size_left", "health", "reason"):
        assert [*cycles[name]] == [*frame[name]], name
    for label in BOUNDARIES:
        boundary = result.map.boundaries[label]
        assert isinstance(boundary, SplineBoundary)
        u = curve_parameters(boundary.spline)
        np.testing.assert_allclose(drawn(document, NAMES[label]), boundary.spline.evaluate(u))
        left, right = uncertainty_band(boundary, u)
        np.testing.assert_allclose(drawn(document, f"{NAMES[label]} band"), [*left, *right[::-1]])
        cones = boundary.spline.evaluate(boundary.cones[:, 0])
        np.testing.assert_allclose(drawn(document, f"{NAMES[label]} cones"), cones)
    assert result.smoothed is not None
    np.testing.assert_allclose(drawn(document, "passed"), result.trajectory[:, :2])
    told = document.get_model_by_name("notices").data_source.data
    events = [one for one in result.cycles if one.jump is not None or one.notice]
    assert [*told["since"]] == [one.t - result.cycles[0].t for one in events] != []
    assert all(one.notice in text for one, text in zip(events, told["text"], strict=True))


def test_the_page_names_the_metrics_and_the_calibration_of_the_summary(folder: Path, html: Path) -> None:
    summary, text = json.loads((folder / "summary.json").read_text()), html.read_text()
    scale, sigma = (summary["calibration"][name] for name in ("scale", "scale_sigma"))
    assert f"<tr><td>rmse [m]</td><td>{summary['final']['rmse']:.3f}</td></tr>" in text
    assert f"<td>scale [-]</td><td>{scale:.3g}</td><td>{sigma:.2g}</td>" in text
    assert "<h1>&lt;lap&gt;</h1>" in text


def test_five_laps_are_small_and_nothing_is_loaded(run: Watched) -> None:
    frame = pd.concat([run_frame(run.alone)] * LAPS)
    text = page("laps", run.alone.map, frame, summarize(run.alone, run.log))
    assert len(text.encode()) < MOST_BYTES
    tags = re.findall(
        r"<(?:script|link|img|iframe)\b[^>]*>",
        re.sub(r"(<script[^>]*>).*?</script>", r"\1", text, flags=re.DOTALL),
    )
    assert tags and all(re.fullmatch(r'<script( type="[\w/]+"| id="[\w-]+")*>', tag) for tag in tags), tags


def test_health_is_a_bar_with_reasons(run: Watched) -> None:
    frame = run_frame(run.alone)
    frame.loc[10:19, "health"], frame.loc[20:24, "health"] = DEGRADED, LOST
    frame.loc[10:24, "reason"] = "</script> 50 % of the detections"
    text = page("lap", run.alone.map, frame, {})
    assert text.count("</script>") == text.count("<script"), "a reason is no end of a script"
    document = document_of(text)
    bars = document.get_model_by_name("health").data_source.data
    since = (frame["t"] - frame["t"].iloc[0]).to_numpy()
    assert [*bars["health"]][-2:] == [DEGRADED, LOST] and "50 %" in bars["reason"][-1]
    assert [*bars["begin"]][-2:] == [since[10], since[20]] and [*bars["end"]][-2:] == [since[19], since[24]]
    lost = drawn(document, LOST)
    assert np.isfinite(lost).all(axis=1).nonzero()[0].tolist() == [20, 21, 22, 23, 24]


def test_another_map_is_laid_on_this_one(run: Watched, folder: Path, tmp_path: Path) -> None:
    motion = np.array([3.0, -2.0, 0.4])
    moved = run.alone.map.moved(motion)
    (tmp_path / "map.json").write_text(json.dumps(map_to_json(moved)))
    out = tmp_path / "page.html"
    assert main(["view", str(folder), "--html", str(out), "--other", str(tmp_path)]) == 0
    document = document_of(out.read_text())
    apart = maps_apart(moved, run.alone.map)
    for label, name in ((label, NAMES[label]) for label in BOUNDARIES):
        own = drawn(document, f"distance {name}")[:, 1]
        np.testing.assert_array_equal(own, apart.distances[label][-len(own) :])
        curve = run.alone.map.boundaries[label].spline  # type: ignore[union-attr]
        assert np.abs(curve.foot_points(drawn(document, f"other {name}")).distance).max() < 0.01


@pytest.mark.parametrize("track", [open_map(), point_map()])
def test_any_map_is_drawn_without_what_older_results_lack(track: Map, run: Watched) -> None:
    frame = run_frame(run.alone).drop(columns=["offered", "health", "reason"])
    document = document_of(page("map", track, frame, {}, other=("same", track, maps_apart(track, track))))
    assert [*document.get_model_by_name("health").data_source.data["health"]] == ["not monitored"]
    assert document.get_model_by_name("other left") is not None


def test_a_result_without_records_of_its_cycles_has_its_path(folder: Path, tmp_path: Path) -> None:
    """A batch of landmarks keeps none."""
    copy = Path(shutil.copytree(folder, tmp_path / "map"))
    cycles = copy / "cycles.csv"
    cycles.write_text(cycles.read_text().splitlines()[0] + "\n")
    (copy / SMOOTHED_FILE).unlink()
    out = tmp_path / "page.html"
    assert main(["view", str(copy), "--html", str(out)]) == 0
    path = drawn(document_of(out.read_text()), "path")
    np.testing.assert_allclose(path, read_trajectory(copy / "trajectory.tum")[1][:, :2])


def test_a_folder_that_is_no_result_is_named(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken, out = shutil.copytree(folder, tmp_path / "broken"), tmp_path / "page.html"
    rows = (broken / "cycles.csv").read_text().splitlines()
    (broken / "cycles.csv").write_text("\n".join(rows[:2]) + "\n")
    assert main(["view", str(broken), "--html", str(out)]) == 2
    error = capsys.readouterr().err
    assert f"{broken / 'cycles.csv'}: expected at least two cycles and a pose for each, found 1 and" in error
    (broken / "cycles.csv").unlink()
    assert main(["view", str(broken), "--html", str(out)]) == 2
    assert str(broken / "cycles.csv") in capsys.readouterr().err and not out.exists()


def test_without_bokeh_the_extra_is_named(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "pathspace_graph.eval.view.page", raising=False)
    for name in [name for name in sys.modules if name.partition(".")[0] == "bokeh"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "bokeh", None)
    assert main(["view", str(folder), "--html", str(tmp_path / "page.html")]) == 2
    assert "bokeh (pip install 'pathspace-graph[page]')" in capsys.readouterr().err


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_a_browser_moves_the_vehicle_with_the_slider(run: Watched, html: Path, tmp_path: Path) -> None:
    """A script in a copy of the page moves the slider, and writes what it finds into the page's text."""
    watch = """<pre id="found"></pre><script>
    const wait = setInterval(async () => {
        const shown = window.Bokeh?.documents[0]
        if (!shown?.is_idle) { return }
        clearInterval(wait)
        const names = ["slider", "vehicle", "readout"]
        const [slider, vehicle, readout] = names.map(one => shown.get_model_by_name(one))
        const first = readout.text
        slider.value = 30
        await new Promise(done => setTimeout(done, 1000))
        const places = [...document.querySelectorAll("[data-root-id]")]
            .map(one => one.firstElementChild.getBoundingClientRect())
        const inside = places.filter(one => one.width > 0 && one.height > 0 && one.right <= innerWidth).length
        const loaded = performance.getEntriesByType("resource").map(one => one.name)
        const found = {first, now: readout.text, bow: [vehicle.data.x[0], vehicle.data.y[0]], inside, loaded}
        document.getElementById("found").textContent = JSON.stringify(found)
    }, 50)
    </script></body>"""
    copy, result = tmp_path / "copy.html", run.alone
    copy.write_text(watch.join(html.read_text().rsplit("</body>", 1)))
    (x, y, theta), cycle = (
        (result.trajectory if result.smoothed is None else result.smoothed)[30],
        result.cycles[30],
    )
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=20000", "--dump-dom"]
    for width in (1280, 400):
        place = [f"--window-size={width},900", f"--user-data-dir={tmp_path / str(width)}", copy.as_uri()]
        done = subprocess.run([str(BROWSER), *options, *place], capture_output=True, text=True, check=True)
        (text,) = re.findall(r'<pre id="found">(.+?)</pre>', done.stdout)
        found = json.loads(unescape(text))
        assert found["inside"] == len(document_of(html.read_text()).roots) and found["loaded"] == []
        assert f"cycle {len(result.cycles) - 1}:" in found["first"] and "cycle 30:" in found["now"]
        assert f"{cycle.readings} of {cycle.offered} detections used" in found["now"]
        np.testing.assert_allclose(found["bow"], [x + 1.8 * np.cos(theta), y + 1.8 * np.sin(theta)])
