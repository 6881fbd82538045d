"""`simulate`: the log of a drive on a track; and the outcome of any command, and how it tells hints."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pathspace_graph.console import note, progress, say
from pathspace_graph.errors import SettingsError
from pathspace_graph.io.files import check_target, to_plain
from pathspace_graph.io.log import LOG_FILE, Log
from pathspace_graph.io.log_files import write_log
from pathspace_graph.options.data import Simulate
from pathspace_graph.sim.simulate import simulate
from pathspace_graph.sim.track import EVENTS, Track
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

if TYPE_CHECKING:
    from pathspace_graph.plausibility.judge import Hint


@dataclass(frozen=True)
class Outcome:
    """The end of a command."""

    written: Sequence[Path]
    summary: Mapping[str, Any] = field(default_factory=dict)
    wrong: Sequence[str] = ()  # a line each, and exit code 3; empty for a trustworthy result

    def show(self, *, as_json: bool) -> None:
        """Print the summary as JSON, or the paths of the files; objections go to standard error."""
        files = [path for path in self.written if path.is_file() or path.is_dir()]  # no pipe or terminal
        if as_json and (files or self.summary):
            content = to_plain({**self.summary, "written": files, "wrong": self.wrong})
            print(json.dumps(content, indent=2, allow_nan=False))
        elif files:
            say(f"written to {', '.join(map(str, files))}")
        note(*self.wrong)


def tell(hints: "Sequence[Hint]", of: str = "") -> None:
    """Print a line for each hint on standard error, with the name of its log, if given."""
    note(*(f"hint: {of}{'/' if of else ''}{hint.line}" for hint in hints))


def simulate_command(options: Simulate) -> Outcome:
    check_target(options.out, LOG_FILE, force=options.force)
    if [options.track, options.generate, options.event].count(None) != 2:
        raise SettingsError("simulate: expected one of --track FILE, --generate SEED or --event NAME")
    with progress("driving"):
        if options.track is not None:
            track = read_track(options.track)
        elif options.generate is not None:
            track = generated_track(options.generate, options.generator)
        else:
            track = EVENTS[str(options.event)]()
        log = simulate(track, options.settings, options.seed)
        write_log(log, options.out, force=options.force)
    say(describe(log))
    return Outcome([options.out])


def generated_track(seed: int, settings: TrackGeneratorSettings | None = None) -> Track:
    """Generated track of a seed."""
    if seed < 0:
        raise SettingsError(f"seed of a generated track: expected at least 0, found {seed}")
    return generate_track(np.random.default_rng(seed), settings)


def describe(log: Log) -> str:
    """Length of the log in words."""
    detections = sum(len(cycle.labels) for cycle in log.cycles)
    seconds = log.odometry.t[-1] - log.odometry.t[0]
    return f"{seconds:.1f} s, {len(log.cycles)} perception cycles, {detections} detections"
