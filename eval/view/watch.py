"""All that watches a run of the command line: the live viewer, its recording, and the film."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Protocol

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.log import Log
from pathspace_graph.run import Observer
from pathspace_graph.settings.output import FilmSettings, RecordingSettings

from .animation import Animation, lap_seconds
from .film import check_film_file, film
from .recording import check_recording, recording


class Watched(Protocol):
    """Describes the options of a command by which a run is watched."""

    @property
    def estimator(self) -> str:
        """Returns the name of the estimator."""

    @property
    def view(self) -> bool:
        """Returns whether a window of the live viewer is wanted."""

    @property
    def save_view(self) -> Path | None:
        """Returns the file of the recording."""

    @property
    def animate(self) -> Path | None:
        """Returns the file of the film."""

    @property
    def recording(self) -> RecordingSettings:
        """Returns the settings of the recording."""

    @property
    def film(self) -> FilmSettings:
        """Returns the settings of the film."""


def check_watchers(options: Watched) -> None:
    """Raises where a run could not be watched so, before anything is mapped."""
    check_recording(options.save_view, options.view)
    if options.animate is not None:
        check_film_file(options.animate)


@contextmanager
def watchers(options: Watched, log: Log) -> Iterator[list[Observer]]:
    """Yields the observers that were asked for; their files are written at the end, or on failure none."""
    observers: list[Observer] = []
    with ExitStack() as stack:
        if options.view or options.save_view is not None:
            opened = recording(
                options.save_view, window=options.view, settings=options.recording, truth=log.truth
            )
            observers.append(stack.enter_context(opened))
        animation = None
        if options.animate is not None:
            if not log.cycles:
                raise SettingsError("--animate: expected a log with perception cycles, found none")
            reel = stack.enter_context(film(options.animate, options.film.frames_per_second))
            track = log.source.get("track", "")
            title = f"Mapped online by {options.estimator}" + (f", track: {track}" if track else "")
            animation = Animation(reel, lap_seconds(log), options.film, log.truth, title)
            observers.append(animation)
        yield observers
        if animation is not None:
            animation.finish()
