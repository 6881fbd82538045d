"""The batch measured: real and generated tracks x seeds, from both starts, against the limit of each run.

`python -m pathspace_graph.eval.batch_table --tracks DIR --seeds 5 --laps 5 --jobs 2 --markdown`
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import tyro

from pathspace_graph.batch.mapper import BatchMapper
from pathspace_graph.eval.metrics.consistency import NormalizedError, joint_cone_error
from pathspace_graph.eval.metrics.limit import limit
from pathspace_graph.eval.metrics.table1 import lap_metrics
from pathspace_graph.eval.metrics.text_table import TextTable
from pathspace_graph.io.log import Log
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import MapperSettings

from .cases import Case, CaseOptions, by_track, measure, show

SAME_COST: Final = 1e-3
"""Costs that differ by no more than this share are one optimum's."""
NOT_WORSE: Final = 1.02
"""A batch rmse up to this many times the online one's isn't worse."""


@dataclass(frozen=True)
class Outcome:
    """What came of one run."""

    case: Case
    """The run."""
    failure: str = ""
    """What it failed of; empty where it finished."""
    converged: tuple[bool, bool] = (False, False)
    """From the online map, and from odometry alone."""
    costs: tuple[float, float] = (np.nan, np.nan)
    """Theirs."""
    online: float = np.nan
    """rmse of the online map, m."""
    rmse: float = np.nan
    """rmse of the batch's from there, m."""
    rmse_odometry: float = np.nan
    """rmse of the batch's from odometry alone, m."""
    missed: float = np.nan
    """Missed share of the true cones."""
    share: float = np.nan
    """Control points by true cones."""
    l: float = np.nan  # noqa: E741 - the issue's and the paper's tables call it so
    """The limit's first part: rmse of the told landmark batch, m."""
    f: float = np.nan
    """Its second: what a spline of that size leaves, m."""
    seconds: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    """Processor time (one thread) of the batch without the online run, of that, and of all from odometry."""
    nees: NormalizedError | None = None
    """The squared errors at the true cones by their joint covariance."""

    @property
    def limit(self) -> float:
        """sqrt(l^2 + f^2), m."""
        return float(np.hypot(self.l, self.f))

    @property
    def same_cost(self) -> bool:
        """Whether both starts came to one optimum."""
        return bool(abs(self.costs[0] - self.costs[1]) <= SAME_COST * min(self.costs))


def run_case(case: Case) -> Outcome:
    """Simulate, optimize from both starts, evaluate; a failure is an outcome as well."""
    try:
        return evaluate(case, case.simulated())
    except Exception as error:  # whatever ends a run belongs into the table
        return Outcome(case, failure=f"{type(error).__name__}: {error}")


def evaluate(case: Case, log: Log) -> Outcome:
    """Both starts on a simulated log, held against its truth."""
    truth, settings = log.truth, MapperSettings()
    assert truth is not None
    mapper = BatchMapper(settings, log.odometry_sigma, FixedLagMapper)
    begin = time.process_time()
    result = mapper.solve(log)
    between = time.process_time()
    other = mapper.solve(log, "odometry")
    end = time.process_time()
    online = (between - begin) * result.seconds["start"] / sum(result.seconds.values())
    assert result.online is not None
    final = lap_metrics(result.map, truth, case.laps)
    least = limit(log, result.map)
    return Outcome(
        case,
        converged=(result.convergence.converged, other.convergence.converged),
        costs=(result.convergence.cost, other.convergence.cost),
        online=lap_metrics(result.online.map, truth, case.laps).rmse,
        rmse=final.rmse,
        rmse_odometry=lap_metrics(other.map, truth, case.laps).rmse,
        missed=final.missed,
        share=final.size / int(np.isin(truth.cone_labels, BOUNDARIES).sum()),
        l=least.l,
        f=least.f,
        seconds=(between - begin - online, online, end - between),
        nees=joint_cone_error(result, truth),
    )


# --- tables ----------------------------------------------------------------------------------------------

HEADER: Final = (
    "track",
    "converged",
    "rmse online [m]",
    "rmse batch [m]",
    "from odometry [m]",
    "limit (l, f) [m]",
    "ratio",
    "size [% of cones]",
    "same cost",
    "batch after online, all from odometry [s]",
    "squared cone error by joint covariance",
    "in 95 %",
)


def rows(outcomes: Sequence[Outcome]) -> list[tuple[str, ...]]:
    """A row for each track, and one for all."""
    return [*(_row(name, of) for name, of in by_track(outcomes).items()), _row("all", outcomes)]


def _row(name: str, outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    done = [o for o in outcomes if not o.failure]

    def mean(value: Callable[[Outcome], float]) -> float:
        return float(np.mean([value(o) for o in done])) if done else float("nan")

    checked = [o.nees for o in done if o.nees is not None]
    return (
        name,
        f"{sum(sum(o.converged) for o in done)} of {2 * len(outcomes)}",
        f"{mean(lambda o: o.online):.3f}",
        f"{mean(lambda o: o.rmse):.3f}",
        f"{mean(lambda o: o.rmse_odometry):.3f}",
        f"{mean(lambda o: o.limit):.3f} ({mean(lambda o: o.l):.3f}, {mean(lambda o: o.f):.3f})",
        f"{mean(lambda o: o.rmse) / mean(lambda o: o.limit):.2f}",
        f"{100 * mean(lambda o: o.share):.1f}",
        f"{sum(o.same_cost for o in done)} of {len(outcomes)}",
        f"{mean(lambda o: o.seconds[0]):.1f}, {mean(lambda o: o.seconds[2]):.1f}",
        f"{np.mean([n.ratio for n in checked]) if checked else float('nan'):.2f}",
        f"{sum(n.honest for n in checked)} of {len(outcomes)}",
    )


def worse(outcomes: Sequence[Outcome]) -> list[str]:
    """Runs whose batch is worse than the online map that it began at."""
    return [
        f"{o.case.name}, seed {o.case.seed}: {o.rmse:.3f} m, online {o.online:.3f} m, limit {o.limit:.3f} m"
        for o in outcomes
        if o.rmse > NOT_WORSE * o.online
    ]


@dataclass(frozen=True, kw_only=True)
class BatchTable(CaseOptions):
    """Measure the batch over tracks and seeds."""

    def run(self) -> None:
        """Run all of it; print the table, and what is worse than online."""
        outcomes = measure(run_case, self.cases(), self.jobs)
        show([TextTable("", HEADER, tuple(rows(outcomes)))], outcomes, self.markdown)
        sys.stdout.writelines(f"worse than online: {line}\n" for line in worse(outcomes))


def main() -> None:
    """The script."""
    tyro.cli(BatchTable).run()


if __name__ == "__main__":
    main()
