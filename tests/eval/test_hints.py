"""The measurement of hints: its rows, its table, and what counts as a bad map."""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd
import pytest

from pathspace_graph.eval.hints import CAUSES, GOOD, causes_of, judged, main, outcome, summary
from pathspace_graph.io.overrides import leaves, override
from pathspace_graph.sim.mistakes import MISTAKES
from pathspace_graph.sim.simulate import SimulationSettings

from ..scenes.drives import short_drive


def test_every_mistake_has_its_causes_by_the_longest_beginning() -> None:
    assert all(causes_of(mistake) for mistake in MISTAKES)
    assert causes_of("speeds in km/h") == ("speeds",)
    assert causes_of("speeds in the map frame") == CAUSES["speeds in the map frame"] == ("odometry",)


def test_every_good_log_has_known_settings() -> None:
    for name, good in GOOD.items():
        changed = leaves(override(SimulationSettings(), good.overrides, name))
        assert {key: changed[key] for key in good.overrides} == good.overrides, name


def test_a_wrong_cause_does_not_count() -> None:
    log = MISTAKES["y to the right"](short_drive())
    assert judged(log, ("y to the right",))["named"]
    wrong = judged(log, ("stamps",))
    assert (wrong["accused"], wrong["named"]) == (True, False)


@pytest.mark.parametrize(
    ("found", "map_is"),
    [
        ({"refusal": "no"}, "refused"),
        ({"boundaries": 0}, "empty"),
        ({"boundaries": 1, "rmse": 0.2, "missed": 0.0}, "bad"),
        ({"boundaries": 2, "rmse": 0.5, "missed": 0.0}, "bad"),
        ({"boundaries": 2, "rmse": float("nan"), "missed": 1.0}, "bad"),
        ({"boundaries": 2, "rmse": 0.3, "missed": 0.04}, "good"),
    ],
)
def test_a_map_is_held_against_that_of_the_good_log(found: dict[str, float], map_is: str) -> None:
    assert outcome(found, {"boundaries": 2, "rmse": 0.2, "missed": 0.0})["map"] == map_is


def test_the_table_has_exact_intervals() -> None:
    rows = [
        {"kind": kind, "name": "x", "named": found, "accused": found, "seconds": 0.1}
        for kind, found in (("spoiled", True), ("spoiled", True), ("good", False), ("good", False))
    ]
    table = summary(pd.DataFrame(rows))
    assert table.rows[0][:5] == ("named: x", "2", "2", "100.0", "15.8 to 100.0")  # 0.025^(1/2)
    assert table.rows[2][:5] == ("accused: x", "0", "2", "0.0", "0.0 to 84.2")


def test_the_script_leaves_rows_and_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(f"{main.__module__}.GOOD", {"as simulated": GOOD["as simulated"]})
    out = tmp_path / "out"
    arguments = ["hints", "--out", str(out), "--tracks", "0", "--seeds", "0", "--mistakes", "y to the right"]
    monkeypatch.setattr(sys, "argv", arguments)
    main()
    frame = pd.read_csv(out / "hints.csv")
    assert frame["kind"].tolist() == ["good", "spoiled"]
    assert frame["of"].tolist() == ["as simulated"] * 2
    assert frame["named"].tolist() == [False, True]
    assert "| named: y to the right" in (out / "hints.md").read_text()
    assert "named: y to the right" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", [*arguments[:-1], "y to the left"])
    with pytest.raises(SystemExit):
        main()
    assert "--mistakes: expected a known mistake, found 'y to the left'" in capsys.readouterr().err
