"""Messages as they arrive: twists are buffered, and no message raises an error."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph.convert.recording import MessageStream
from pathspace_graph.convert.settings import Frames

from .bags import EPOCH, Messages

TWIST = (3.0, 0.1, 0.5)


@pytest.fixture(scope="module")
def messages() -> Messages:
    return Messages()


@pytest.fixture
def stream(messages: Messages) -> MessageStream:
    """A stream that has the twists of one second at 10 Hz."""
    stream = MessageStream()
    for t in np.arange(11) / 10.0:
        stream.take_odometry(messages.odometry(t, TWIST), 0.0)
    return stream


def cloud(messages: Messages, t: float | None, x: float = 5.0) -> Any:
    return messages.cloud(t, {"x": ("f4", [x]), "y": ("f4", [1.5]), "label": ("u1", [0])})


def stamps(cycle: Any) -> list[float]:
    return [round(t - EPOCH, 6) for t in cycle[0].t.tolist()]


def test_a_cycle_has_the_twists_since_the_last_one_that_was_used(
    messages: Messages, stream: MessageStream
) -> None:
    cycle = stream.take_detections(cloud(messages, 0.25), 0.0)
    assert cycle is not None
    assert stamps(cycle) == [0.0, 0.1, 0.2]
    assert cycle[1].t == pytest.approx(EPOCH + 0.25)
    again = stream.take_detections(cloud(messages, 0.35), 0.0)
    assert stamps(again) == [0.0, 0.1, 0.2, 0.3]  # the first one was refused
    stream.use(EPOCH + 0.35)
    assert stamps(stream.take_detections(cloud(messages, 0.55), 0.0)) == [0.3, 0.4, 0.5]
    stream.use(EPOCH + 0.55)
    assert stamps(stream.take_detections(cloud(messages, 0.45), 0.0)) == []  # it is late


def test_messages_without_a_stamp_have_the_time_of_receipt(messages: Messages) -> None:
    stream = MessageStream()
    stream.take_odometry(messages.odometry(None, TWIST), 7.0)
    cycle = stream.take_detections(cloud(messages, None), 7.5)
    assert cycle is not None
    assert cycle[0].t.tolist() == [7.0]
    assert cycle[1].t == 7.5


def test_the_frames_are_those_of_the_vehicle(messages: Messages) -> None:
    stream = MessageStream(Frames((1.0, 0.0, 0.0), y="right"))
    stream.take_odometry(messages.odometry(0.0, TWIST), 0.0)
    cycle = stream.take_detections(cloud(messages, 0.1), 0.0)
    assert cycle is not None
    np.testing.assert_allclose(cycle[0].twist, [[3.0, -0.1, -0.5]])
    np.testing.assert_allclose(cycle[1].points_vehicle, [[6.0, -1.5]])


@pytest.mark.parametrize("broken", [None, 3, SimpleNamespace(), SimpleNamespace(header=None, twist=None)])
def test_a_broken_message_is_counted_and_left_out(
    broken: Any, messages: Messages, stream: MessageStream
) -> None:
    stream.take_odometry(broken, 2.0)
    stream.take_odometry(messages.odometry(0.5, TWIST), 0.0)
    stream.take_odometry(messages.odometry(2.0, (np.nan, 0.0, 0.0)), 0.0)
    assert stream.take_detections(broken, 2.0) is None
    assert stream.take_detections(cloud(messages, -1.0), 0.0) is None
    assert sum(stream.refused.values()) == 5
    assert stamps(stream.take_detections(cloud(messages, 9.0), 0.0))[-1] == 1.0


def test_a_cycle_may_be_empty(messages: Messages, stream: MessageStream) -> None:
    cycle = stream.take_detections(cloud(messages, 0.3, x=np.nan), 0.0)
    assert cycle is not None
    assert len(cycle[1].labels) == 0
