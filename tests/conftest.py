"""BLAS has one thread, no window opens, and no test passes because a mapper went on after a failure.

Threads only stall systems as small as these. Workers and other processes inherit both variables, which have
to be set before numpy is imported.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import settings

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

from pathspace_graph import FixedLagMapper
from pathspace_graph.loop import lap_solver
from pathspace_graph.run import CycleResult

from .shared import laps
from .shared.session import FOLDER

settings.register_profile("tests", deadline=None, max_examples=60)  # on top of hypothesis' own one in CI
settings.load_profile("tests")


def pytest_configure(config: pytest.Config) -> None:
    """Make the folder of the session, which workers find in their environment."""
    if not hasattr(config, "workerinput"):
        folder = TemporaryDirectory(prefix="pathspace-tests-")
        os.environ[FOLDER] = folder.name
        config.add_cleanup(folder.cleanup)


@pytest.fixture(scope="session", autouse=True)
def _laps_are_solved_once() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lap_solver, "submit", laps.submit)
        yield


@pytest.fixture
def png_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands that write several figures write PNG only: most of a PDF's time goes into its fonts."""
    monkeypatch.setattr("pathspace_graph.eval.figures.drawing.SUFFIXES", (".png",))


@pytest.fixture(autouse=True)
def failures_are_seen(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Fails a test in which an update failed, unless it is marked `failing`."""
    failures = list[str]()
    without = FixedLagMapper._without

    def seen(self: FixedLagMapper, *arguments: Any) -> CycleResult:
        failures.append(repr(arguments[-1]))
        return without(self, *arguments)

    monkeypatch.setattr(FixedLagMapper, "_without", seen)
    yield
    if request.node.get_closest_marker("failing") is None:
        assert not failures, failures
