"""No test passes because a mapper has gone on after a failure that the test did not make itself."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from pathspace_graph.checkpoint import Recovery


@pytest.fixture(autouse=True)
def failures_are_seen(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Fails a test in which an update failed, unless it is marked `failing`."""
    failures = list[str]()
    take_back = Recovery.take_back

    def seen(self: Recovery, *arguments: object) -> None:
        failures.append("an update failed")
        take_back(self, *arguments)

    monkeypatch.setattr(Recovery, "take_back", seen)
    yield
    if request.node.get_closest_marker("failing") is None:
        assert not failures
