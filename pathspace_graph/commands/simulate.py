"""`simulate`: the log of a drive on a track from a file, or on a generated one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro import MISSING
from tyro.conf import arg

from pathspace_graph.console import progress, say
from pathspace_graph.errors import SettingsError
from pathspace_graph.io.files import check_target
from pathspace_graph.io.log import LOG_FILE, Log, write_log
from pathspace_graph.sim.simulate import PRESETS, SimulationSettings, preset, simulate
from pathspace_graph.sim.track import EVENTS, Track
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Drive a track and write the log of it, with truth; a seed gives the same log to the byte."""

    out: Path
    """Folder for the log; an earlier log there is kept as a numbered backup."""
    track: Path | None = None
    """Track file: PacSim or fssim YAML, EUFS or TUM CSV."""
    generate: int | None = None
    """Seed of a generated Formula Student track, in place of a track file."""
    event: Literal["skidpad", "acceleration"] | None = None
    """Event that is driven instead of either, on the track that the rules describe."""
    seed: int = 0
    """Seed of the drive's wander and of all noise."""
    sensor: Literal["plain", "camera", "line"] = "plain"
    """Preset of `--sensor.*`, `--line.*` and `--faults.sensor.*`, each of which can still be set: cones with
    white noise, a camera's cones, or points of a line."""
    odometry: Literal["plain", "ins"] = "plain"
    """Preset of `--odometry.*` and `--vehicle.rate`, each of which can still be set."""
    settings: Annotated[SimulationSettings, arg(name="")] = field(default_factory=SimulationSettings)
    """Settings of the drive."""
    generator: TrackGeneratorSettings = field(default_factory=TrackGeneratorSettings)
    """Rules of a generated track."""

    @classmethod
    def start(cls, arguments: Sequence[str]) -> Simulate:
        """Return the command with the presets among its arguments, before any other option is set."""
        words = [word for argument in arguments for word in argument.split("=", 1)]
        pairs = ((word.removeprefix("--"), value) for word, value in pairwise(words))
        # a wrong name is refused with the other options
        names = {group: value for group, value in pairs if value in PRESETS.get(group, {})}
        return cls(out=MISSING, settings=preset(names))

    def run(self) -> None:
        check_target(self.out, LOG_FILE)
        with progress("driving"):
            log = simulate(self._track(), self.settings, self.seed)
            write_log(log, self.out)
        say(f"{self.out}: {describe(log)}")

    def _track(self) -> Track:
        if [self.track, self.generate, self.event].count(None) != 2:
            raise SettingsError("simulate: expected one of --track FILE, --generate SEED or --event NAME")
        if self.track is not None:
            return read_track(self.track)
        if self.generate is not None:
            return generated_track(self.generate, self.generator)
        return EVENTS[str(self.event)]()


def generated_track(seed: int, settings: TrackGeneratorSettings | None = None) -> Track:
    """Return the generated track of a seed."""
    if seed < 0:
        raise SettingsError(f"seed of a generated track: expected at least 0, found {seed}")
    return generate_track(np.random.default_rng(seed), settings)


def describe(log: Log) -> str:
    """Return the length of the log in words."""
    detections = sum(len(cycle.labels) for cycle in log.cycles)
    seconds = log.odometry.t[-1] - log.odometry.t[0]
    return f"{seconds:.1f} s, {len(log.cycles)} perception cycles, {detections} detections"
