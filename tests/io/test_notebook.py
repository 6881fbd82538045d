"""What a notebook shows: short texts, pictures and frames; and the paper's isolated tests of the gallery."""

from __future__ import annotations

import runpy
from functools import cache, partial
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest

from pathspace_graph import (
    LEFT,
    RIGHT,
    FixedLagMapper,
    Log,
    Map,
    RunResult,
    SettingsError,
    hints,
    make_online,
    run_online,
    split_odometry,
    write_log,
)
from pathspace_graph.brief import brief

from ..scenes.drives import short_drive

GALLERY = Path(__file__).parents[2] / "docs" / "gallery"
LONGEST = 400
"""Most characters of a record's text."""


@cache
def drive() -> tuple[Log, RunResult]:
    log = short_drive()
    return log, run_online(log, FixedLagMapper(None, log.odometry_sigma))


def test_records_have_short_texts_that_say_what_they_hold() -> None:
    log, result = drive()
    line, mapper = result.map.centre_line(), FixedLagMapper(None, log.odometry_sigma)
    cycle = mapper.update(*next(iter(split_odometry(log))))
    records = [log, log.truth, log.odometry, log.cycles[0], result, result.map, result.vehicle]
    records += [result.map.left, result.map.left.spline, line, mapper, mapper.ahead(5.0), cycle]
    for record in records:
        assert len(repr(record)) < LONGEST
    assert f"{len(log.cycles)} cycles" in repr(log)
    assert f"left: {result.map.left.size} control points" in repr(result.map)
    assert repr(result.map) in repr(result)
    assert brief(np.zeros((4, 2))) == "array (4, 2)" and brief(np.zeros(2)) == "array([0., 0.])"


def test_a_boundary_is_found_by_side_label_and_name() -> None:
    _, result = drive()
    track = result.map
    assert track.left is track.boundaries[LEFT] is track.boundaries["left"]
    assert track.right is track.boundaries[RIGHT] is track.boundaries["right"]
    assert list(track.boundaries) == [LEFT, RIGHT] and "left" in track.boundaries
    with pytest.raises(KeyError):
        track.boundaries["middle"]
    with pytest.raises(SettingsError, match=r"map\.right: expected a mapped boundary, found none"):
        Map(False, {LEFT: track.left}).right  # noqa: B018 - the access is the test


def test_a_run_is_a_frame_with_a_row_for_each_cycle() -> None:
    _, result = drive()
    frame = result.to_frame()
    assert len(frame) == len(result.cycles)
    np.testing.assert_array_equal(frame[["x", "y", "theta"]].to_numpy(), result.trajectory)
    np.testing.assert_array_equal(frame["readings"], [record.readings for record in result.cycles])


def test_a_centre_line_is_a_frame_with_a_row_for_each_point() -> None:
    _, result = drive()
    line = result.map.centre_line(2.0)
    frame = line.to_frame()
    np.testing.assert_array_equal(frame[["x", "y"]].to_numpy(), line.points)
    np.testing.assert_array_equal(frame["width_left_sigma"], line.width_left_sigma)
    assert "length" not in frame


def test_a_length_of_a_wrong_type_is_named() -> None:
    log, result = drive()
    with pytest.raises(SettingsError, match=r"step: expected a number of at least .*, found 'far'"):
        result.map.centre_line("far")  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match=r"distance: expected a positive number \(m\), found None"):
        FixedLagMapper(None, log.odometry_sigma).ahead(None)  # type: ignore[arg-type]


def test_what_is_no_log_is_named(tmp_path: Path) -> None:
    for ask in (hints, partial(make_online, "ckf", None), lambda log: write_log(log, tmp_path / "log")):
        with pytest.raises(SettingsError, match=r"log: expected a Log, found str"):
            ask("drive")  # type: ignore[operator]
    assert not list(tmp_path.iterdir())
    with pytest.raises(SettingsError, match=r"estimator: expected an OnlineEstimator, found str"):
        run_online(drive()[0], "ckf")  # type: ignore[arg-type]


def test_records_are_drawn() -> None:
    log, result = drive()
    for picture in (log.plot(), result.map.plot(), result.plot()):
        assert len(picture.axes[0].lines) > 2
        assert picture._repr_png_()[:8] == b"\x89PNG\r\n\x1a\n"  # type: ignore[attr-defined]
    assert plt.get_fignums() == []


# --- the paper's isolated tests --------------------------------------------------------------------------


def test_the_papers_isolated_tests_of_the_gallery_show_what_they_say() -> None:
    """The pieces have tests of their own; here is what the page's pictures claim."""
    if not GALLERY.exists():
        pytest.skip("there are no pages beside an installed package")
    with mpl.rc_context({"backend": "agg"}):
        found = runpy.run_path(str(GALLERY / "isolated.py"))
    plt.close("all")
    np.testing.assert_allclose(found["joint"], found["sampled"], rtol=0.05)
    assert np.abs(found["marginals"] / found["sampled"] - 1.0).max() > 0.15
    for points, worse, better in (("others", "extended", "updated"), ("readings", "curve", "fitted")):
        far, near = (found[name].foot_points(found[points]).distance for name in (worse, better))
        assert np.linalg.norm(near) < 0.5 * np.linalg.norm(far)
    by_curvature, even = (np.sqrt(np.mean(error**2)) for error in found["errors"])
    assert found["weighted"].size == found["uniform"].size == 32 and by_curvature < min(0.12, even)
