"""A small measurement of scaling from end to end, and requests that are refused; never how fast."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from pathspace_graph import cli
from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.benchmark import (
    CONES,
    DENSE_LINE,
    LAPS,
    LINE_POINTS,
    MARKER,
    READINGS,
    make_drives,
    measure_scaling,
    scaling_table,
    stops,
    write_scaling,
)
from pathspace_graph.settings.evaluation import ScalingSettings

from .timing import SMALL

pytestmark = pytest.mark.usefixtures("png_only")


@pytest.mark.slow
def test_a_small_measurement_end_to_end(tmp_path: Path) -> None:
    drives = make_drives(SMALL)
    cycles = sum(sweep.cycles for sweep in drives.values())
    told: list[tuple[int, int]] = []
    kept = tmp_path / "kept"
    scaling = measure_scaling(["fixed-lag"], drives, SMALL, None, kept, lambda *of: told.append(of))
    assert told == [(k, cycles) for k in range(1, cycles + 1)]
    again = measure_scaling(["fixed-lag"], drives, SMALL, None, kept, lambda *of: told.append(of))
    assert len(told) == cycles, "what was measured is kept"
    pd.testing.assert_frame_equal(again.points, scaling.points)
    pd.testing.assert_frame_equal(again.slopes, scaling.slopes)
    assert scaling.of(LAPS, "fixed-lag")["at"].tolist() == [1.0, 2.0]
    assert scaling.of(READINGS, "fixed-lag")["at"].tolist() == [2.0, 6.0, 12.0]
    assert len(scaling.of(CONES, "fixed-lag")) == 4
    (on_line,) = scaling.of(DENSE_LINE, "fixed-lag").to_dict("records")
    assert on_line["at"] == LINE_POINTS
    assert on_line["cycles"] == drives[DENSE_LINE].cycles
    assert not stops(scaling)
    write_scaling(tmp_path / "out", scaling)
    content = json.loads((tmp_path / "out" / MARKER).read_text())
    assert content["seconds_compared"] == {"fixed-lag": None}  # 200 cones weren't reached
    assert {s["sweep"] for s in content["slopes"]} == {CONES, READINGS, LAPS, DENSE_LINE}
    assert len(pd.read_csv(tmp_path / "out" / "points.csv")) == len(scaling.points)
    names = {"scaling.png", "table.md"}
    assert names <= {file.name for file in (tmp_path / "out").iterdir()}
    assert scaling_table(scaling).records()[0]["estimator"] == "fixed-lag"


def test_bad_requests_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "new")]
    assert cli.main(["scale", *out, "--estimators", "nobody"]) == cli.BAD_INPUT
    assert "nobody" in capsys.readouterr().err
    assert cli.main(["scale", *out, "--quick", "--scaling.laps", "3"]) == cli.BAD_INPUT
    assert not (tmp_path / "new").exists()
    with pytest.raises(SettingsError, match="cones_min"):
        ScalingSettings(cones_min=300.0, cones_max=200.0)
