"""`simulate`: the log of a drive on a track from a file, or on a generated one."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import Console
from tyro.conf import arg

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.files import check_target
from pathspace_graph.io.log import LOG_FILE, Log, write_log
from pathspace_graph.progress import progress
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Drive a track and write the log of it, with truth; a seed gives the same log to the byte."""

    out: Path
    """Log folder to write; an earlier log there is kept as a numbered backup."""
    track: Path | None = None
    """Track file: PacSim or fssim YAML, EUFS or TUM CSV."""
    generate: int | None = None
    """Seed of a generated Formula Student track, where no track file is given."""
    seed: int = 0
    """Seed of the drive's wander and of all noise."""
    settings: Annotated[SimulationSettings, arg(name="")] = field(default_factory=SimulationSettings)
    """The drive."""
    generator: TrackGeneratorSettings = field(default_factory=TrackGeneratorSettings)
    """Rules of a generated track."""

    def run(self) -> None:
        """Simulate and write."""
        check_target(self.out, LOG_FILE)
        with progress("driving"):
            log = simulate(self._track(), self.settings, self.seed)
            write_log(log, self.out)
        Console().print(f"{self.out}: {describe(log)}", highlight=False, soft_wrap=True, markup=False)

    def _track(self) -> Track:
        if self.track is not None:
            return read_track(self.track)
        if self.generate is None:
            raise SettingsError("simulate: expected a track, either --track FILE or --generate SEED")
        return generated_track(self.generate, self.generator)


def generated_track(seed: int, settings: TrackGeneratorSettings | None = None) -> Track:
    """The generated track of a seed."""
    if seed < 0:
        raise SettingsError(f"seed of a generated track: expected at least 0, found {seed}")
    return generate_track(np.random.default_rng(seed), settings)


def describe(log: Log) -> str:
    """How long the log is, in words."""
    readings = sum(len(cycle.labels) for cycle in log.cycles)
    seconds = log.odometry.t[-1] - log.odometry.t[0]
    return f"{seconds:.1f} s, {len(log.cycles)} perception cycles, {readings} readings"
