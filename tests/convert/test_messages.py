"""Messages by their fields: clouds of any layout, markers of any kind, cones in lists."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph.convert.messages import (
    BROKEN,
    MessageError,
    cone_points,
    frame_id_of,
    points_of,
    stamp_of,
    twist_of,
)
from pathspace_graph.convert.settings import LabelRule, label_of_colour
from pathspace_graph.labels import BIG_ORANGE, LEFT, ORANGE, RIGHT, UNKNOWN

from .bags import EPOCH, Messages

RULE = LabelRule()


@pytest.fixture(scope="module")
def messages() -> Messages:
    return Messages()


COLUMNS: dict[str, tuple[str, Any]] = {
    "x": ("f4", [1.0, 2.0]),
    "z": ("f4", [9.0, 9.0]),
    "y": ("f8", [-3.0, 4.0]),
    "class": ("i2", [1, 0]),
}


@pytest.mark.parametrize(("order", "pad"), [("<", 0), ("<", 5), (">", 0), (">", 3)])
def test_a_cloud_is_read_in_any_layout(messages: Messages, order: str, pad: int) -> None:
    found = points_of(messages.cloud(1.0, COLUMNS, order=order, pad=pad), RULE)
    np.testing.assert_array_equal(found.points, [[1.0, -3.0], [2.0, 4.0]])
    assert found.labels.tolist() == [RIGHT, LEFT]
    assert np.isnan(found.covariances).all()


def test_a_cloud_of_padded_rows_is_read(messages: Messages) -> None:
    cloud = messages.cloud(1.0, COLUMNS)
    step = cloud.point_step
    rows = np.frombuffer(bytes(cloud.data), np.uint8).reshape(2, step)
    padded = np.hstack([rows, np.full((2, 7), 255, np.uint8)]).ravel()
    tall = SimpleNamespace(
        **{name: getattr(cloud, name) for name in ("header", "fields", "is_bigendian", "point_step")},
        height=2,
        width=1,
        row_step=step + 7,
        data=padded.tobytes(),
    )
    np.testing.assert_array_equal(points_of(tall, RULE).points, [[1.0, -3.0], [2.0, 4.0]])
    tall.data = tall.data[:-1]
    with pytest.raises(BROKEN):
        points_of(tall, RULE)
    cloud.fields[0].offset = 1000
    with pytest.raises(BROKEN):
        points_of(cloud, RULE)


def test_a_cloud_without_places_is_refused(messages: Messages) -> None:
    with pytest.raises(MessageError, match="fields x and y, found intensity"):
        points_of(messages.cloud(1.0, {"intensity": ("f4", [1.0])}), RULE)


def test_markers_are_points_lists_or_neither(messages: Messages) -> None:
    blue, yellow = (0.0, 0.0, 1.0), (1.0, 1.0, 0.0)
    turned = messages.make("geometry_msgs/msg/Quaternion", z=np.sqrt(0.5), w=np.sqrt(0.5))
    spheres = messages.marker(1.0, (10.0, 0.0), blue, kind=7)
    spheres.pose.orientation = turned
    spheres.points = [messages.vector("Point", 1.0, 0.0), messages.vector("Point", 0.0, 1.0)]
    spheres.colors = [messages.colour(yellow), messages.colour((1.0, 0.5, 0.0))]
    array = messages.markers(
        [
            messages.marker(None, (0.0, 0.0), blue, action=3),
            messages.marker(None, (0.0, 0.0), blue, kind=9),
            messages.marker(2.0, (5.0, 1.5), blue),
            spheres,
        ]
    )
    found = points_of(array, RULE)
    np.testing.assert_allclose(found.points, [[5.0, 1.5], [10.0, 1.0], [9.0, 0.0]], atol=1e-12)
    assert found.labels.tolist() == [LEFT, RIGHT, ORANGE]
    assert stamp_of(array) == EPOCH + 2.0
    assert frame_id_of(array) == "base_link"
    assert stamp_of(messages.markers([])) is None
    assert len(points_of(messages.markers([]), RULE).labels) == 0


@pytest.mark.parametrize(
    ("colour", "label"),
    [
        ((0, 0, 255), LEFT),
        ((0.1, 0.3, 1.0), LEFT),
        ((0.0, 0.5, 1.0), LEFT),
        ((1.0, 1.0, 0.0), RIGHT),
        ((255, 215, 0), RIGHT),
        ((1.0, 0.5, 0.0), ORANGE),
        ((255, 165, 0), ORANGE),
        ((1.0, 0.0, 0.0), UNKNOWN),
        ((0.0, 1.0, 0.0), UNKNOWN),
        ((0.5, 0.5, 0.5), UNKNOWN),
        ((0.0, 0.0, 0.0), UNKNOWN),
        ((1.0, 0.0, 1.0), UNKNOWN),
        ((np.nan, 0.0, 1.0), UNKNOWN),
    ],
)
def test_the_hue_decides(colour: tuple[float, float, float], label: int) -> None:
    assert label_of_colour(*colour) == label


def point(x: float, y: float) -> SimpleNamespace:
    return SimpleNamespace(x=x, y=y, z=0.0)


def test_cones_have_places_covariances_and_labels_in_many_ways() -> None:
    placed = SimpleNamespace(position=point(3.0, 0.0))
    six = np.zeros((6, 6))
    six[:2, :2] = [[4.0, 1.0], [1.0, 2.0]]
    message = SimpleNamespace(
        stamp=1.0,
        numbers=np.zeros(3),
        names=["a"],
        left=[SimpleNamespace(point=point(1.0, 0.0), covariance=np.array([2.0, 0.5, 0.5, 1.0]))],
        yellow_cones=[point(2.0, 0.0)],
        track=[
            SimpleNamespace(pose=SimpleNamespace(pose=placed, covariance=six.ravel()), color=0),
            SimpleNamespace(location=point(4.0, 0.0), color="yellow"),
            SimpleNamespace(location=point(5.0, 0.0), color=4),
            SimpleNamespace(location=point(6.0, 0.0), color=SimpleNamespace(r=0.0, g=0.0, b=1.0)),
            SimpleNamespace(location=point(7.0, 0.0), covariance=np.zeros(3)),
        ],
    )
    found = cone_points(message, RULE)
    np.testing.assert_array_equal(found.points[:, 0], np.arange(1.0, 8.0))
    assert found.labels.tolist() == [LEFT, RIGHT, LEFT, RIGHT, UNKNOWN, LEFT, UNKNOWN]
    np.testing.assert_array_equal(found.covariances[0], [[2.0, 0.5], [0.5, 1.0]])
    np.testing.assert_array_equal(found.covariances[2], [[4.0, 1.0], [1.0, 2.0]])
    assert np.isnan(found.covariances[[1, 3, 4, 5, 6]]).all()


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (SimpleNamespace(data=np.zeros(3)), "with a list of cones, found the fields"),
        (SimpleNamespace(cones=[SimpleNamespace(size=1.0)]), "found .*size"),
    ],
)
def test_what_has_no_cones_is_refused(message: Any, said: str) -> None:
    with pytest.raises(MessageError, match=said):
        points_of(message, RULE)


def test_a_message_without_a_twist_is_refused(messages: Messages) -> None:
    with pytest.raises(MessageError, match="with a twist"):
        twist_of(messages.vector())
    with pytest.raises(MessageError, match=r"found \['data'\]"):
        twist_of(SimpleNamespace(data=[3.0, 0.1, 0.5]))


def test_speeds_and_a_yaw_rate_of_their_own_are_a_twist() -> None:
    np.testing.assert_array_equal(twist_of(SimpleNamespace(vx=3, vy=0.1, yaw_rate=0.5)), [3.0, 0.1, 0.5])
    np.testing.assert_array_equal(twist_of(SimpleNamespace(speed=3.0, wz=0.5)), [3.0, 0.0, 0.5])
    np.testing.assert_array_equal(twist_of(SimpleNamespace(vx=3.0)), [3.0, 0.0, np.nan])


def test_arrays_of_numbers_are_points() -> None:
    message = SimpleNamespace(x=np.array([4.0, 5.0]), y=np.array([1.0, -1.0]), colour=["blue", "yellow"])
    found = points_of(message, RULE)
    np.testing.assert_array_equal(found.points, [[4.0, 1.0], [5.0, -1.0]])
    np.testing.assert_array_equal(found.labels, [LEFT, RIGHT])
    assert np.isnan(found.covariances).all()
    assert points_of(SimpleNamespace(x=[4.0], y=[1.0]), RULE).labels == [UNKNOWN]
    with pytest.raises(MessageError, match=r"arrays x, y, colour of one length, found \[2, 1, 2\]"):
        points_of(SimpleNamespace(x=[4.0, 5.0], y=[1.0], colour=["blue", "yellow"]), RULE)


def test_detections_of_objects_have_their_label_in_a_hypothesis() -> None:
    """`vision_msgs/Detection3DArray`, by its fields."""

    def detection(x: float, name: str) -> SimpleNamespace:
        center = SimpleNamespace(position=point(x, 1.0), orientation=None)
        hypothesis = SimpleNamespace(class_id=name, score=0.9)
        return SimpleNamespace(
            bbox=SimpleNamespace(center=center), results=[SimpleNamespace(hypothesis=hypothesis)]
        )

    message = SimpleNamespace(detections=[detection(1.0, "blue_cone"), detection(2.0, "yellow_cone")])
    found = points_of(message, RULE)
    np.testing.assert_array_equal(found.points, [[1.0, 1.0], [2.0, 1.0]])
    assert found.labels.tolist() == [LEFT, RIGHT]


def test_the_values_of_labels_are_counted_with_what_they_were_taken_for() -> None:
    rule = LabelRule(["left=3"])
    assert rule.of_all(np.array([3, 3, 4])).tolist() == [LEFT, LEFT, UNKNOWN]
    assert rule.of(SimpleNamespace(data="Yellow-cone")) == RIGHT
    assert rule.summary() == "labels: 3 is left (2), 4 is unknown (1), Yellow-cone is right (1)"


@pytest.mark.parametrize(
    ("text", "label"),
    [
        ("blue_cone", LEFT),
        ("yellow-cone", RIGHT),
        ("b", LEFT),
        ("Y", RIGHT),
        ("orange_cone", ORANGE),
        ("large_orange_cone", BIG_ORANGE),
        ("unknown_cone", UNKNOWN),
        ("blue or yellow", UNKNOWN),
        ("bluebird", UNKNOWN),
        (0, LEFT),
        (1.0, RIGHT),
        ("1", RIGHT),
        (7, UNKNOWN),
    ],
)
def test_numbers_and_words_inside_a_text_are_labels(text: object, label: int) -> None:
    assert RULE.of(text) == label
