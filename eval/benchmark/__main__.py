"""`python -m pathspace_graph.eval.benchmark` times the online mapper beside ISAM2 and the landmark graph.

With `--laps 5 --seed 0 --json FILE` everything is measured in one run, on the same cycles. With `--compare`
it says what is worse than the committed baseline (the exit code is 1 then), and `--write-baseline` writes
that baseline.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

from pathspace_graph.console import note, output, say
from pathspace_graph.errors import PathspaceError
from pathspace_graph.io.files import atomic_file, check_file_target, write_json
from pathspace_graph.options.help import read_options

from . import measurement

WORSE, BAD_INPUT = 1, 2  # exit codes: a figure is worse than the baseline, a bad file


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """Time the online mapper on a generated track of 200 cones, beside GTSAM's ISAM2 on landmarks."""

    laps: int = 5
    """Laps that are driven."""
    seed: int = 0
    """Seed of the track, the drive and its noise."""
    json: Path | None = None
    """File for the figures."""
    compare: bool = False
    """Mark what is worse than the baseline by more than its tolerance; the exit code is 1 then."""
    write_baseline: bool = False
    """Make the ratios of this run the baseline."""
    baseline: Path = measurement.BASELINE
    """File of the baseline; by default the one that comes with the package."""


def main() -> None:
    """Run the script; the exit code is 1 where a figure is worse than the baseline, 2 on bad files."""
    try:
        if _is_worse(read_options(Benchmark, "pathspace_graph.eval.benchmark")):
            raise SystemExit(WORSE)
    except PathspaceError as error:
        note(f"benchmark: {error}")
        raise SystemExit(BAD_INPUT) from error


def _is_worse(benchmark: Benchmark) -> bool:
    """Measure, write and report; return whether anything is worse than the baseline."""
    for file in (benchmark.json, benchmark.baseline if benchmark.write_baseline else None):
        if file is not None:
            check_file_target(file)
    baseline = measurement.read_baseline(benchmark.baseline) if benchmark.compare else {}
    figures = measurement.metrics(measurement.measure_drive(benchmark.seed, benchmark.laps))
    if benchmark.json is not None:
        with atomic_file(benchmark.json) as temporary:
            write_json(temporary, [asdict(metric) for metric in figures])
    console = output()
    console.print(measurement.metrics_table(figures).rich())
    found = measurement.compare(figures, baseline) if benchmark.compare else []
    if benchmark.compare:
        table = measurement.baseline_table(found)
        console.print(table.title)
        console.print(table.rich())
    if benchmark.write_baseline:
        measurement.write_baseline(benchmark.baseline, figures)
        say(f"baseline written to {benchmark.baseline}")
    return any(metric.worse_than(before) for metric, before in found)


if __name__ == "__main__":
    main()
