"""Intervals of means, by a bootstrap-t that is written out, and how far the maps of logs are apart."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.eval.experiment.run import add_agreement, make_plan, run_folder
from pathspace_graph.eval.experiment.statistics import LEVEL, RESAMPLES, estimate
from pathspace_graph.eval.experiment.study import Study
from pathspace_graph.eval.metrics.alignment import aligned_distance
from pathspace_graph.io.files import write_json
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.io.map import MAP_FILE, Map, map_to_json
from pathspace_graph.labels import LEFT, RIGHT

from ...scenes.pretenders import register
from ...scenes.rings import shifted_ring, write_logs


def test_the_interval_of_eight_values_is_that_of_the_bootstrap_t() -> None:
    """Standard deviations of samples are `sum (x - m)^2 / (n - 1)`, of the values and of each resample."""
    values = np.array([0.3, 0.1, 0.45, 0.2, 0.9, 0.25, 0.35, 0.15])
    n, mean = len(values), sum(values) / len(values)

    def sem(sample: np.ndarray) -> float:
        own = sum(sample) / n
        return float((sum((x - own) ** 2 for x in sample) / (n - 1) / n) ** 0.5)

    indices = np.random.default_rng(0).integers(0, n, (RESAMPLES, n))
    ratios = [abs(sum(values[i]) / n - mean) / sem(values[i]) for i in indices if sem(values[i]) > 0.0]
    found = estimate(values)
    assert found.mean == pytest.approx(mean)
    assert found.half == pytest.approx(np.quantile(ratios, LEVEL) * sem(values))


def test_the_agreement_of_a_map_is_its_mean_distance_from_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three logs, whose tracks are 4.0, 4.2 and 5.0 m wide."""
    register(monkeypatch)
    folder = write_logs(tmp_path / "rings")
    write_log(replace(read_log(folder / "b"), truth=None), folder / "c")
    logs = tuple(folder / name for name in "abc")
    cells = make_plan(Study(logs={"ring": logs}, estimators=("pretender",)), keep=True).cells
    maps = [Map(True, {LEFT: shifted_ring(8.0), RIGHT: shifted_ring(out)}) for out in (12.0, 12.2, 13.0)]
    records = {cell.id: {"rows": [{}]} for cell in cells}
    for cell, track in zip(cells, maps, strict=True):
        run_folder(tmp_path, cell).mkdir(parents=True)
        write_json(run_folder(tmp_path, cell) / MAP_FILE, map_to_json(track))
    add_agreement(tmp_path, cells, records)
    apart = {(i, j): aligned_distance(maps[i], maps[j]) for i, j in combinations(range(3), 2)}
    for k, cell in enumerate(cells):
        expected = np.mean([distance for pair, distance in apart.items() if k in pair])
        assert records[cell.id]["rows"][-1]["agreement"] == pytest.approx(expected, rel=1e-3)
