"""Cells of an estimator with settings on a drive, and what is measured and kept of them."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pathspace_graph import estimators as registry
from pathspace_graph.eval.metrics.measures import measure, online_cycles, stage_times
from pathspace_graph.eval.metrics.summary import has_cones, lap_times, summarize
from pathspace_graph.eval.metrics.trajectory import ReachObserver
from pathspace_graph.io.files import to_plain
from pathspace_graph.io.log import Log
from pathspace_graph.io.overrides import leaves
from pathspace_graph.io.results import RunResult, write_result
from pathspace_graph.lengths import times
from pathspace_graph.plausibility.diagnosis import diagnose
from pathspace_graph.plausibility.hint import Hint
from pathspace_graph.run import run_online, with_own
from pathspace_graph.settings.mapper import MapperSettings

from .drives import AnyDrive, identity
from .runner import FILES, Cell, Record


@dataclass(frozen=True, eq=False)
class EstimatorCell(Cell):
    """An estimator with settings on the log of a drive."""

    drive: AnyDrive
    estimator: str
    settings: MapperSettings
    variant: str  # name of the settings
    parameters: Any = None  # the estimator's own, a frozen dataclass; None where it has none

    @property
    def module(self) -> str:
        return registry.module_of(self.estimator)

    @property
    def names(self) -> dict[str, Any]:
        return self.drive.names | {"estimator": self.estimator, "variant": self.variant}

    @cached_property
    def meaning(self) -> str:
        known = leaves(self.settings).items()
        settings = {name: value for name, value in known if registry.reads(self.estimator, name)}
        own = None if self.parameters is None else to_plain(asdict(self.parameters))
        parts = {"drive": self.drive.id, "estimator": self.estimator, "settings": settings, "own": own}
        return identity(**parts)

    def run(self) -> Record:
        log, hints = self.drive.load()
        begin, worked = time.perf_counter(), time.thread_time()
        result = run_estimator(self.estimator, self.settings, log, self.parameters)
        wall, processor = time.perf_counter() - begin - result.observing, time.thread_time() - worked
        cycles = online_cycles(result)
        took = wall, sum(record.processor for record in cycles) if cycles else processor
        rows = measure(result, log, took)
        said = [record.notice for record in result.cycles if record.notice]
        vehicle = result.at_scale_one().vehicle
        said += [] if vehicle is None else diagnose(vehicle, result.settings)
        return {
            "notices": "; ".join(dict.fromkeys(said)),
            "lap_count": result.laps,
            "rows": [{"lap": row.lap, **row.values} for row in rows],
            "stages": stage_times(cycles),
            **({FILES: files_of(result, log, hints)} if self.keep else {}),
        }


def run_estimator(name: str, settings: MapperSettings, log: Log, parameters: Any = None) -> RunResult:
    """Run an online estimator, with its reach and its map at the end of each true lap, or a batch one."""
    if name not in registry.ONLINE:
        return with_own(registry.make_batch(name, settings, log, parameters).solve(log), parameters)
    estimator, truth = registry.make_online(name, settings, log, parameters), log.at_scale_one().truth
    observers = [ReachObserver(truth)] if has_cones(truth) and len(truth.poses) else []
    result = run_online(log, estimator, name=name, snapshot_times=lap_times(log), observers=observers)
    result = replace(result, reach=times(observers[0].rows, (1, 2, 0), log.scale)) if observers else result
    return with_own(result, parameters)


def files_of(run: RunResult, log: Log, hints: Sequence[Hint]) -> dict[str, str]:
    """Return the files of a run as texts by name: a worker may have no disk in common with the study."""
    with TemporaryDirectory() as folder:
        write_result(Path(folder) / "run", run, summarize(run, log, hints))
        return {file.name: file.read_text(encoding="utf-8") for file in (Path(folder) / "run").iterdir()}
