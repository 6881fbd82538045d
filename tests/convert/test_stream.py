"""Messages as they arrive: twists are buffered, and no message raises an error."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph import FixedLagMapper, ReadingError
from pathspace_graph.convert.settings import Frames
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.ros.node import MessageStream

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


def taken(stream: MessageStream, message: Any, received: float = 0.0) -> tuple[Odometry, Detections]:
    """The one cycle that a message gives."""
    (cycle,) = stream.take_detections(message, received)
    return cycle


def test_a_cycle_has_the_twists_since_the_last_one_that_was_used(
    messages: Messages, stream: MessageStream
) -> None:
    cycle = taken(stream, cloud(messages, 0.25))
    assert stamps(cycle) == [0.0, 0.1, 0.2]
    assert cycle[1].t == pytest.approx(EPOCH + 0.25)
    again = taken(stream, cloud(messages, 0.35))
    assert stamps(again) == [0.0, 0.1, 0.2, 0.3]  # the first one was refused
    stream.use(EPOCH + 0.35)
    assert stamps(taken(stream, cloud(messages, 0.55))) == [0.3, 0.4, 0.5]


def test_cycles_wait_for_older_ones_and_come_in_order(messages: Messages) -> None:
    stream, given = MessageStream(wait=0.15), list[tuple[float, list[float]]]()
    for t in np.arange(11) / 10.0:
        stream.take_odometry(messages.odometry(t, TWIST), 0.0)
    for t in (0.25, 0.45, 0.35, 0.65, 0.15):
        for cycle in stream.take_detections(cloud(messages, t), 0.0):
            given.append((round(cycle[1].t - EPOCH, 6), stamps(cycle)))
            stream.use(cycle[1].t)
    # 0.25 goes on when 0.45 is here; 0.35, which came after it, and 0.45 when 0.65 is; 0.15 is too late
    assert given == [
        (0.25, [0.0, 0.1, 0.2]),
        (0.35, [0.2, 0.3]),
        (0.45, [0.3, 0.4]),
        (0.15, []),
    ]


def test_a_mapper_refuses_what_comes_too_late(messages: Messages, stream: MessageStream) -> None:
    mapper = FixedLagMapper()
    mapper.update(*taken(stream, cloud(messages, 0.55)))
    with pytest.raises(ReadingError, match="expected a stamp later than the newest cycle"):
        mapper.update(*taken(stream, cloud(messages, 0.45)))
    assert mapper.update(*taken(stream, cloud(messages, 0.65))).refused == 1


def test_messages_without_a_stamp_have_the_time_of_receipt(messages: Messages) -> None:
    stream = MessageStream()
    stream.take_odometry(messages.odometry(None, TWIST), 7.0)
    cycle = taken(stream, cloud(messages, None), 7.5)
    assert cycle[0].t.tolist() == [7.0]
    assert cycle[1].t == 7.5


def test_the_frames_are_those_of_the_vehicle(messages: Messages) -> None:
    stream = MessageStream(Frames((1.0, 0.0, 0.0), y="right"))
    stream.take_odometry(messages.odometry(0.0, TWIST), 0.0)
    cycle = taken(stream, cloud(messages, 0.1))
    np.testing.assert_allclose(cycle[0].twist, [[3.0, -0.1, -0.5]])
    np.testing.assert_allclose(cycle[1].points_vehicle, [[6.0, -1.5]])


@pytest.mark.parametrize("broken", [None, 3, SimpleNamespace(), SimpleNamespace(header=None, twist=None)])
def test_a_broken_message_is_counted_and_left_out(
    broken: Any, messages: Messages, stream: MessageStream
) -> None:
    stream.take_odometry(broken, 2.0)
    stream.take_odometry(messages.odometry(0.5, TWIST), 0.0)
    stream.take_odometry(messages.odometry(2.0, (np.nan, 0.0, 0.0)), 0.0)
    assert not [*stream.take_detections(broken, 2.0)]
    assert not [*stream.take_detections(cloud(messages, -1.0), 0.0)]
    assert sum(stream.refused.values()) == 5
    assert stamps(taken(stream, cloud(messages, 9.0)))[-1] == 1.0


def test_a_cycle_may_be_empty(messages: Messages, stream: MessageStream) -> None:
    assert len(taken(stream, cloud(messages, 0.3, x=np.nan))[1].labels) == 0
