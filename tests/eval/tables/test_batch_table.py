"""The batch's measuring script: one tiny run for real, and the table held against runs made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.eval.metrics.consistency import NormalizedError
from pathspace_graph.eval.tables.batch_table import HEADER, BatchTable, Outcome, evaluate, rows, worse
from pathspace_graph.eval.tables.cases import Case
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

SHORT = TrackGeneratorSettings(lap_length=(100.0, 160.0), corners=(3, 4), hairpins=(0, 0), cones=90)


def outcome(seed: int, rmse: float, costs: tuple[float, float] = (100.0, 100.05)) -> Outcome:
    return Outcome(
        Case(0, seed, 2),
        converged=(True, seed == 0),
        costs=costs,
        online=0.2,
        rmse=rmse,
        rmse_odometry=rmse,
        missed=0.0,
        share=0.4,
        l=0.3,
        f=0.4,
        seconds=(2.0, 8.0, 3.0),
        nees=NormalizedError(100.0, 100),
    )


def test_one_short_lap_for_real() -> None:
    track = generate_track(np.random.default_rng(4), SHORT)
    found = evaluate(Case(4, 0, 1), simulate(track, SimulationSettings(laps=1), 0))
    assert found.converged == (True, True)
    assert found.rmse < 0.5
    assert 0.2 < found.share <= 0.44
    assert found.limit >= max(found.l, found.f) > 0.0
    assert min(found.seconds) > 0.0
    assert found.nees is not None


def test_a_row_for_each_track_and_one_for_all() -> None:
    table = rows([outcome(0, 0.1), outcome(1, 0.3)])
    assert [len(row) for row in table] == [len(HEADER)] * 2
    cells = dict(zip(HEADER, table[-1], strict=True))
    assert cells["converged"] == "3 of 4"
    assert cells["rmse batch [m]"] == "0.200"
    assert cells["limit (l, f) [m]"] == "0.500 (0.300, 0.400)"
    assert cells["ratio"] == "0.40"
    assert cells["same cost"] == "2 of 2"
    assert cells["in 95 %"] == "2 of 2"


def test_another_optimum_is_told() -> None:
    assert outcome(0, 0.1, (100.0, 100.09)).same_cost
    assert not outcome(0, 0.1, (100.2, 100.0)).same_cost


def test_what_is_worse_than_online_is_named() -> None:
    assert worse([outcome(0, 0.203), outcome(1, 0.3)]) == [
        f"{Case(0, 1, 2).name}, seed 1: 0.300 m, online 0.200 m, limit 0.500 m"
    ]


def test_a_failure_counts_against_the_rate(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = [outcome(0, 0.1), Outcome(Case(0, 1, 2), failure="RuntimeError: lost")]
    monkeypatch.setattr("pathspace_graph.eval.tables.batch_table.measure", lambda *_: made)
    BatchTable(generated=1, seeds=2, markdown=True).run()
    printed = capsys.readouterr()
    assert "2 of 4" in printed.out
    assert "seed 1: RuntimeError: lost" in printed.err
