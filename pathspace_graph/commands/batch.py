"""`batch`: a whole log is optimized at once, as the ground reference."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

from tyro.conf import Positional, arg

from pathspace_graph.batch.mapper import BatchMapper, BatchResult
from pathspace_graph.console import note, progress, say
from pathspace_graph.errors import SettingsError
from pathspace_graph.estimators import DEFAULT_BATCH, MapKind, check_batch, for_map, make_batch
from pathspace_graph.eval.metrics.reference import gap
from pathspace_graph.eval.metrics.summary import summarize
from pathspace_graph.io.files import check_target
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import MAP_FILE
from pathspace_graph.io.results import BatchRun, write_result
from pathspace_graph.plausibility.hint import Hint
from pathspace_graph.plausibility.judge import read_plausible_log
from pathspace_graph.settings.batch import Start
from pathspace_graph.settings.mapper import MapperSettings

from .online import report, tell

NOT_CONVERGED: Final = 3
"""Exit code of a run whose result is written, but is not the optimum."""


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Optimize a whole log at once, and write the map, the trajectory, the cycles and a summary."""

    log: Positional[Path]
    """Folder of the log."""
    out: Path
    """Folder for the map; an earlier map there is kept as a numbered backup."""
    estimator: str = DEFAULT_BATCH
    """Name of the batch estimator."""
    map: MapKind = "boundaries"
    """Kind of map: two boundaries, or one centre line with a width."""
    start: Start | None = None
    """Where the optimization begins: an online map, or odometry alone; by default as `batch.start` says."""
    settings: Annotated[MapperSettings, arg(name="")] = field(default_factory=MapperSettings)
    """Settings of the estimator."""

    def run(self) -> None:
        check_batch(self.estimator)
        name = for_map(self.estimator, self.map)
        if self.start == "odometry" and name != DEFAULT_BATCH:
            raise SettingsError(f"--start: expected online for {name}, found {self.start}")
        check_target(self.out, MAP_FILE)
        log, hints = read_plausible_log(self.log, self.settings.limits)
        tell(hints)
        with progress("optimizing") as advance:
            estimator = make_batch(name, self.settings, log)
            if isinstance(estimator, BatchMapper):
                result: BatchRun = estimator.solve(log, self.start, advance)
            else:
                result = estimator.solve(log)
        start = self.start or self.settings.batch.start
        write_result(self.out, result, summarize_batch(result, log, start, hints))
        report(result, log)
        say(f"written to {self.out}")
        if not result.converged:
            reason = (
                result.convergence.reason if isinstance(result, BatchResult) else "associations still change"
            )
            note(f"not converged: {reason}")
            raise SystemExit(NOT_CONVERGED)
        if isinstance(result, BatchResult) and result.objection:
            note(f"not a map of the drive: {result.objection}")
            raise SystemExit(NOT_CONVERGED)


def summarize_batch(result: BatchRun, log: Log, start: Start, hints: Sequence[Hint] = ()) -> dict[str, Any]:
    """Return the summary of a run, how its optimization ended, and its gap from its online start."""
    summary = summarize(result, log, hints) | {"start": start, "converged": result.converged}
    if not isinstance(result, BatchResult):
        return summary
    summary["convergence"] = asdict(result.convergence)
    summary["objection"] = result.objection
    summary["stages"] = result.seconds
    summary["gap"] = None if result.online is None else asdict(gap(result.online, result))
    return summary
