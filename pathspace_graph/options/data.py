"""`simulate` and `convert`: sources of logs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from pathspace_graph.convert.settings import Frames, NoiseSettings, Topics, Window
from pathspace_graph.sim.simulate import PRESETS, SimulationSettings, preset
from pathspace_graph.sim.track_generator import TrackGeneratorSettings

from .runs import INLINE, FolderCommand


@dataclass(frozen=True, kw_only=True)
class Simulate(FolderCommand):
    """Drive a track and write the log of it, with truth; a seed gives the same log to the byte."""

    out: Path
    """Folder for the log."""
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
    settings: Annotated[SimulationSettings, INLINE] = field(default_factory=SimulationSettings)
    """Settings of the drive."""
    generator: TrackGeneratorSettings = field(default_factory=TrackGeneratorSettings)
    """Rules of a generated track."""

    @classmethod
    def base(cls, given: Mapping[str, Sequence[str]]) -> SimulationSettings | None:
        """Settings of the presets, if any, which other options override."""
        named = {group: given[group][0] for group in PRESETS if group in given}
        return preset(named) if named else None


@dataclass(frozen=True, kw_only=True)
class Convert(FolderCommand):
    """Write a ROS bag, CSV files or JSON lines as a log, and report what was dropped.

    A log is in order of time and in the vehicle frame. A folder of several records becomes a folder of logs.
    """

    source: Path = field(kw_only=False)
    """Bag (a file, or a folder with metadata.yaml), folder of CSV files, file of JSON lines, or a folder of
    several of these."""
    out: Path
    """Folder for the log."""
    kind: Annotated[Literal["bag", "csv", "jsonl"], Parameter(name="--from")] = "bag"
    """Kind of the record."""
    topics: Annotated[Topics, INLINE] = field(default_factory=Topics)
    """Messages of a bag."""
    label_field: str | None = None
    """Field of the label of a detection in a bag; `none` means that there are no labels."""
    labels: tuple[str, ...] = ()
    """Values of the labels: left=0 right=1 is the default. Words are read as well, blue_cone as left and
    yellow as right; anything else is unknown."""
    columns: tuple[str, ...] = ()
    """Columns of the CSV files: t=stamp vx=speed vy=v wz=yaw_rate of the odometry, t, x, y (or range and
    bearing), label, xx, xy and yy of the detections. A minus changes the sign (wz=-yaw_rate). Where both
    files name t in another way, detections.t=time is of one of them."""
    units: tuple[str, ...] = ()
    """Units of the CSV files: length=mm angle=deg time=ns, also speed=km/h and yaw_rate=deg/s, which
    otherwise follow length and angle. Without them it is m, rad and s."""
    scale: float = 1.0
    """Size of the scene by that of a Formula Student track, such as 0.1 for a model car of 1:10 and 3 for a
    road, which the log states; its lengths are in m."""
    frames: Annotated[Frames, INLINE] = field(default_factory=Frames)
    """Frames of the record."""
    window: Annotated[Window, INLINE] = field(default_factory=Window)
    """Part of the record to convert."""
    noise: Annotated[NoiseSettings, INLINE] = field(default_factory=NoiseSettings)
    """Noise that the record does not state."""
