"""The study of hints: what counts as named, and its rows."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.hints import CAUSES, GOOD, HintStudy, causes_of, judged
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


def test_each_good_log_is_judged_and_spoiled_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(f"{HintStudy.__module__}.GOOD", {"as simulated": GOOD["as simulated"]})
    study = HintStudy(tracks=(0,), seeds=(0,), mistakes=("y to the right",))
    frame, told = study.measure(folder=tmp_path), list[tuple[int, int]]()
    assert frame["kind"].tolist() == ["good", "spoiled"]
    assert frame["of"].tolist() == ["as simulated"] * 2
    assert frame["named"].tolist() == [False, True]
    again = study.measure(folder=tmp_path, on_cell=lambda *steps: told.append(steps))
    assert told == [(0, 0)], "what was judged is kept"
    pd.testing.assert_frame_equal(again, frame)
    with pytest.raises(SettingsError, match="mistakes: expected a known one, found 'y to the left'"):
        HintStudy(mistakes=("y to the left",)).measure()
