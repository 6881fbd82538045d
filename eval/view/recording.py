"""A recording for the live viewer rerun, as a file or in a window, and all that watches a run."""

import os
import socket
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, Protocol

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.files import atomic_file, check_file_target
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.run import Observer
from pathspace_graph.settings.output import FilmSettings, RecordingSettings

from .animation import Animation, check_film_file, film, lap_seconds
from .recorder import Recorder, blueprint

APPLICATION: Final = "pathspace_graph"
"""Name by which the viewer keeps what a user arranges."""
SUFFIX: Final = ".rrd"
DISPLAYS: Final = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
"""Variables of the environment of which one is set where there is a display, on Linux."""
PORT: Final = 9876
"""The viewer's port, rerun's own; a viewer that is there already is used."""
_TIMEOUT: Final = 2.0
"""Time within which a viewer that was started answers (s)."""


def import_rerun(option: str) -> Any:
    """Return the package `rerun`; a SettingsError says how to install it where it is missing."""
    try:
        # the package is optional
        import rerun  # noqa: PLC0415
        import rerun.blueprint  # noqa: PLC0415
    except ImportError as error:
        install = "pip install 'pathspace-graph[view]'"
        raise SettingsError(f"{option}: expected the package rerun-sdk, found none; {install}") from error
    return rerun


def check_recording(file: Path | None, window: bool) -> None:
    """Raise a SettingsError where a recording could not be opened, before anything is mapped."""
    if file is not None:
        if file.suffix.lower() != SUFFIX:
            raise SettingsError(f"{file}: expected a recording's name that ends in {SUFFIX}")
        check_file_target(file)
    if file is not None or window:
        import_rerun("--view" if window else "--save-view")
    if window and not has_display(sys.platform, os.environ):
        names = " or ".join(DISPLAYS[:2])
        hint = f"--save-view FILE{SUFFIX} writes the recording without a window"
        raise SettingsError(f"--view: expected a display ({names}), found none; {hint}")


def has_display(platform: str, environment: Mapping[str, str]) -> bool:
    """Return whether a window can be opened, as far as the environment tells."""
    return not platform.startswith("linux") or any(environment.get(name) for name in DISPLAYS)


@contextmanager
def recording(
    file: Path | str | None = None,
    *,
    window: bool = False,
    settings: RecordingSettings | None = None,
    truth: Truth | None = None,
) -> Iterator[Recorder]:
    """Yield an observer that records each cycle that it is shown, to a file, to a window, or to both.

    The file appears as a whole at the end, and an earlier one is kept as a numbered backup. The window stays
    open afterwards. The true cones are shown where there is a truth.
    """
    target = None if file is None else Path(file)
    check_recording(target, window)
    rerun = import_rerun("recording")
    with ExitStack() as stack:
        path = None if target is None else stack.enter_context(atomic_file(target))
        stream = rerun.RecordingStream(APPLICATION)
        stack.callback(stream.disconnect)  # before the file gets its name
        _connect(rerun, stream, path, window)
        yield Recorder(rerun, stream, settings or RecordingSettings(), truth)


def _connect(rerun: Any, stream: Any, path: Path | None, window: bool) -> None:
    if window:
        _open_window(rerun, stream)
    sinks = [] if path is None else [rerun.FileSink(str(path))]
    sinks += [rerun.GrpcSink(f"rerun+http://127.0.0.1:{PORT}/proxy")] if window else []
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    stream.set_sinks(*sinks, default_blueprint=blueprint(rerun))


def _open_window(rerun: Any, stream: Any) -> None:
    """Start the viewer, unless one is there already; a SettingsError where it does not start."""
    beside = Path(sys.executable).with_name("rerun")  # need not be on the path
    viewer = {"executable_path": str(beside) if beside.exists() else None, "hide_welcome_screen": True}
    try:
        rerun.spawn(port=PORT, connect=False, recording=stream, **viewer)
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise SettingsError(f"--view: the viewer could not be started: {reason}") from error
    try:
        socket.create_connection(("127.0.0.1", PORT), _TIMEOUT).close()
    except OSError as error:
        raise SettingsError(f"--view: expected the viewer on port {PORT}, found none: {error}") from error


# --- all that watches a run ------------------------------------------------------------------------------


class Watched(Protocol):
    """Options of a command by which a run is watched."""

    @property
    def estimator(self) -> str: ...
    @property
    def view(self) -> bool: ...
    @property
    def save_view(self) -> Path | None: ...
    @property
    def animate(self) -> Path | None: ...
    @property
    def recording(self) -> RecordingSettings: ...
    @property
    def film(self) -> FilmSettings: ...


def check_watchers(options: Watched) -> None:
    """Raise where a run could not be watched so, before anything is mapped."""
    check_recording(options.save_view, options.view)
    if options.animate is not None:
        check_film_file(options.animate)


@contextmanager
def watchers(options: Watched, log: Log) -> Iterator[list[Observer]]:
    """Yield the observers that were asked for; their files are written at the end, or on failure none."""
    observers: list[Observer] = []
    with ExitStack() as stack:
        if options.view or options.save_view is not None:
            how: dict[str, Any] = {"settings": options.recording, "truth": log.truth}
            observers.append(stack.enter_context(recording(options.save_view, window=options.view, **how)))
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
