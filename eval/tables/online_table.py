"""The online mapper measured: real and generated tracks x seeds, against the limit of each run.

`python -m pathspace_graph.eval.online_table --tracks DIR --seeds 5 --laps 5 --jobs 2`
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
import tyro

from pathspace_graph.eval.metrics.consistency import normal_errors
from pathspace_graph.eval.metrics.limit import limit
from pathspace_graph.eval.metrics.table1 import LapMetrics, lap_end_times, laps_metrics
from pathspace_graph.eval.metrics.text_table import TextTable
from pathspace_graph.io.files import atomic_file, check_file_target
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.results import CycleRecord, RunResult
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings

from .cases import Case, CaseOptions, by_track, measure, show


@dataclass(frozen=True)
class Outcome:
    """What came of one run."""

    case: Case
    """The run."""
    failure: str = ""
    """What it failed of; empty where it finished."""
    closed: bool = False
    """Whether the loop was closed at the end of the last lap."""
    laps: tuple[LapMetrics, ...] = ()
    """The map at the end of each true lap."""
    cones: int = 0
    """True cones of both boundaries."""
    inside: int = 0
    """How many of them the curve passes within its 2-sigma band."""
    landmark_rmse: float = float("nan")
    """l of the limit, m."""
    fit_rmse: float = float("nan")
    """f of the limit, m."""
    milliseconds: tuple[float, ...] = ()
    """Mean update of each lap driven; loop closing is left out."""
    milliseconds_p99: float = float("nan")
    """99th percentile of all updates."""

    @property
    def limit(self) -> float:
        """sqrt(l^2 + f^2), m."""
        return float(np.hypot(self.landmark_rmse, self.fit_rmse))

    @property
    def rmse(self) -> float:
        """At the end of the last lap, m."""
        return self.laps[-1].rmse if self.laps else float("nan")

    @property
    def missed_first(self) -> float:
        """Missed share at the end of lap 1."""
        return self.laps[0].missed if self.laps else 1.0

    @property
    def missed_later(self) -> float:
        """Mean missed share at the ends of the laps after lap 1."""
        return float(np.mean([row.missed for row in self.laps[1:] or self.laps])) if self.laps else 1.0

    @property
    def size_share(self) -> float:
        """Control points at the end of the last lap by true cones."""
        return self.laps[-1].size / self.cones if self.laps and self.cones else float("nan")


# --- runs ------------------------------------------------------------------------------------------------


def run_case(case: Case) -> Outcome:
    """Simulate, map online, evaluate; a failure is an outcome as well."""
    try:
        return evaluate(case, case.simulated())
    except Exception as error:  # whatever ends a run belongs into the table
        return Outcome(case, failure=f"{type(error).__name__}: {error}")


def evaluate(case: Case, log: Log) -> Outcome:
    """Map a simulated log online and measure every lap's map, the limit and the band's honesty."""
    truth = _truth(log)
    mapper = FixedLagMapper(MapperSettings(), log.odometry_sigma)
    result = run_online(log, mapper, snapshot_times=lap_end_times(truth))
    track = result.snapshots[-1] if result.snapshots else result.map
    errors = normal_errors(track, truth)
    least = limit(log, track)
    return Outcome(
        case,
        closed=track.closed,
        laps=tuple(laps_metrics(tuple(enumerate(result.snapshots, start=1)), truth)),
        cones=int(np.isin(truth.cone_labels, BOUNDARIES).sum()),
        inside=int(np.sum(np.abs(errors.errors) <= 2.0 * errors.sigmas)),
        landmark_rmse=least.l,
        fit_rmse=least.f,
        milliseconds=_lap_milliseconds(result),
        milliseconds_p99=1e3 * float(np.quantile([record.seconds for record in result.cycles], 0.99)),
    )


def _truth(log: Log) -> Truth:
    if log.truth is None:
        raise ValueError("expected a simulated log, found one without truth")
    return log.truth


def _lap_milliseconds(result: RunResult) -> tuple[float, ...]:
    """Mean update of each complete lap, without the one cycle that closes the loop (the slowest by far)."""
    slowest = max(result.cycles, key=lambda record: record.seconds)

    def counts(record: CycleRecord, lap: int) -> bool:
        return record.lap == lap and record is not slowest

    laps = range(1, result.laps + 1)
    return tuple(
        1e3 * float(np.mean([record.seconds for record in result.cycles if counts(record, lap)]))
        for lap in laps
    )


# --- tables ----------------------------------------------------------------------------------------------

Rows = list[tuple[str, ...]]

TRACK_HEADER: Final = (
    "track",
    "cones",
    "closed",
    "rmse lap 1 [m]",
    "rmse last lap [m]",
    "limit [m]",
    "missed lap 1 [%]",
    "missed later [%]",
    "size [% of cones]",
    "within 2σ [%]",
    "update [ms]",
)
SUMMARY_HEADER: Final = ("over all runs", "value")


def track_rows(outcomes: Sequence[Outcome]) -> Rows:
    """A row for each track: means over its seeds."""
    return [_track_row(name, of) for name, of in by_track(outcomes).items()]


def _track_row(name: str, outcomes: Sequence[Outcome]) -> tuple[str, ...]:
    done = [outcome for outcome in outcomes if outcome.laps]

    def average(value: Callable[[Outcome], float], form: str, factor: float = 1.0) -> str:
        return format(factor * _mean([value(outcome) for outcome in done]), form)

    return (
        name,
        average(lambda o: o.cones, ".0f"),
        f"{sum(o.closed for o in outcomes)} of {len(outcomes)}",
        average(lambda o: o.laps[0].rmse, ".3f"),
        average(lambda o: o.rmse, ".3f"),
        average(lambda o: o.limit, ".3f"),
        average(lambda o: o.missed_first, ".1f", 100.0),
        average(lambda o: o.missed_later, ".1f", 100.0),
        average(lambda o: o.size_share, ".1f", 100.0),
        f"{100.0 * _share_inside(done):.1f}",
        average(lambda o: _mean(o.milliseconds), ".2f"),
    )


def summary_rows(outcomes: Sequence[Outcome]) -> Rows:
    """Every quantity that the online mapper is held to, over all runs."""
    done = [outcome for outcome in outcomes if outcome.laps]
    closed = [outcome for outcome in done if outcome.closed]
    rmse, least = _mean([o.rmse for o in done]), _mean([o.limit for o in done])
    first, later = [o.missed_first for o in done], [o.missed_later for o in done]
    return [
        ("runs finished", f"{sum(not o.failure for o in outcomes)} of {len(outcomes)}"),
        ("loop closed", f"{100 * len(closed) / len(outcomes):.1f} %"),
        ("missed at the end of lap 1, median run", f"{100 * _median(first):.2f} %"),
        ("missed at the end of lap 1, mean", f"{100 * _mean(first):.2f} %"),
        ("missed in later laps, median run", f"{100 * _median(later):.2f} %"),
        ("missed in later laps, mean", f"{100 * _mean(later):.2f} %"),
        ("rmse at the last lap, mean", f"{rmse:.3f} m"),
        ("rmse at the last lap, largest of a closed loop", f"{_max([o.rmse for o in closed]):.3f} m"),
        ("limit, mean", f"{least:.3f} m"),
        ("rmse by limit, ratio of the means", f"{rmse / least:.2f}"),
        (
            "size by true cones, largest of a closed loop",
            f"{100 * _max([o.size_share for o in closed]):.1f} %",
        ),
        ("true cones within the 2σ band", f"{100 * _share_inside(done):.1f} %"),
        ("mean update", f"{_mean([_mean(o.milliseconds) for o in done]):.2f} ms"),
        ("99th percentile of an update, mean", f"{_mean([o.milliseconds_p99 for o in done]):.1f} ms"),
        ("mean update, last lap by lap 2, median run", f"{_median(_slowdowns(done)):.2f}"),
    ]


def _slowdowns(outcomes: Sequence[Outcome]) -> list[float]:
    return [o.milliseconds[-1] / o.milliseconds[1] for o in outcomes if len(o.milliseconds) > 1]


def _share_inside(outcomes: Sequence[Outcome]) -> float:
    """Pooled over cones; a cone whose boundary isn't mapped is outside."""
    cones = sum(o.cones for o in outcomes)
    return sum(o.inside for o in outcomes) / cones if cones else float("nan")


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _max(values: Sequence[float]) -> float:
    return float(np.max(values)) if len(values) else float("nan")


def tables(outcomes: Sequence[Outcome]) -> list[TextTable]:
    """Both."""
    return [
        TextTable("", TRACK_HEADER, tuple(track_rows(outcomes))),
        TextTable("", SUMMARY_HEADER, tuple(summary_rows(outcomes))),
    ]


def csv_rows(outcomes: Sequence[Outcome]) -> list[dict[str, object]]:
    """One tidy row per run and lap; a run that failed has one without figures."""
    rows = []
    for outcome in outcomes:
        shared: dict[str, object] = {
            "track": outcome.case.name,
            "seed": outcome.case.seed,
            "failure": outcome.failure,
            "closed": outcome.closed,
            "cones": outcome.cones,
            "inside": outcome.inside,
            "l": outcome.landmark_rmse,
            "f": outcome.fit_rmse,
            "limit": outcome.limit,
        }
        rows += [shared | asdict(lap) for lap in outcome.laps] or [shared]
    return rows


def write_csv(file: Path, outcomes: Sequence[Outcome]) -> None:
    """The tidy rows as a file, whole or not at all."""
    rows = csv_rows(outcomes)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with atomic_file(file) as temporary, temporary.open("w", encoding="utf-8", newline="") as out:
        writer = csv.DictWriter(out, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


# --- command ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class OnlineTable(CaseOptions):
    """Measure the online mapper over tracks and seeds."""

    out: Path | None = None
    """CSV file to write: one row per run and lap."""

    def run(self) -> None:
        """Run all of it and print both tables."""
        if self.out is not None:
            check_file_target(self.out)
        outcomes = measure(run_case, self.cases(), self.jobs)
        if self.out is not None:
            write_csv(self.out, outcomes)
        show(tables(outcomes), outcomes, self.markdown)


def main() -> None:
    """The script."""
    tyro.cli(OnlineTable).run()


if __name__ == "__main__":
    main()
