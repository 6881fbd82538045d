"""Settings of what shows a run while it goes on: the recording for the live viewer, and the film."""

from __future__ import annotations

from dataclasses import dataclass

from .checked import Positive


@dataclass(frozen=True)
class RecordingSettings(Positive):
    """Describes the recording of a run for the live viewer."""

    band_every: int = 10
    """The band is computed in every cycle whose number this divides, and where the map is replaced, since it
    needs the joint covariance of the map; the curves are shown in every cycle."""
    widest_band: float = 5.0
    """A band is shown at most this wide (m) on either side of its curve: where nothing is known yet, it would
    reach far beyond the track."""
    samples_per_span: int = 6
    """Each span of a curve is shown as this number of lines."""


@dataclass(frozen=True)
class FilmSettings(Positive):
    """Describes the film of a run."""

    UNLIMITED = ("laps",)

    seconds_per_lap: float = 10.0
    """A lap takes this time (s) of the film."""
    frames_per_second: float = 12.5
    """The film has this number of frames in a second; a frame of a .gif begins at a multiple of 0.01 s."""
    width: int = 780
    """A frame is this wide (pixels)."""
    height: int = 520
    """A frame is this high (pixels)."""
    laps: float = float("inf")
    """The film ends after this number of laps, and the mapping goes on without it."""
    widest_band: float = 5.0
    """A band is drawn at most this wide (m) on either side of its curve."""
    hold: float = 2.0
    """The last frame is shown for this time (s) of the film."""
