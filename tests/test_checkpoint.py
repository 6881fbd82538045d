"""Copies in memory: what is shared, what is not, and that a copy goes on as the original does."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import Any

import gtsam
import numpy as np
import pytest

from pathspace_graph import FixedLagMapper
from pathspace_graph.checkpoint import Recovery, copied, is_shared
from pathspace_graph.graph.gaussian import jacobian_factor
from pathspace_graph.graph.variables import pose_key
from pathspace_graph.io.log import Odometry
from pathspace_graph.run import split_odometry

from .scenes.digest import digest
from .scenes.drives import bean_track, lap_log


@dataclass
class Holder:
    """It counts, and may hold itself."""

    value: Any
    count: int = 0

    def add(self) -> None:
        self.count += 1


def holder_append(holder: Holder, number: int) -> None:
    holder.value.append(number)


Holder.__module__ = "pathspace_graph.holder"  # copies are of the project's own classes


def test_views_of_an_array_are_views_of_its_copy() -> None:
    whole = np.arange(12.0).reshape(3, 4, order="F")
    holder = Holder((whole, whole[1:, ::2], whole.T))
    base, part, turned = copied(holder, {}).value
    np.testing.assert_array_equal(part, whole[1:, ::2])
    part[0, 0] = turned[3, 2] = -1.0
    assert base[1, 0] == base[2, 3] == -1.0 and whole.min() == 0.0
    assert base.strides == whole.strides and part.strides == whole[1:, ::2].strides


def test_what_nothing_changes_is_shared() -> None:
    fixed = np.zeros(3)
    fixed.flags.writeable = False
    for value in (
        fixed,
        Odometry(np.zeros(2), np.zeros((2, 3))),
        "text",
        1.5,
        None,
        (1, "a"),
        np.float64(2.0),
    ):
        assert copied(value, {}) is value
    with pytest.raises(ValueError, match="read-only"):
        fixed[0] = 1.0


def test_circles_and_methods_stay_within_the_copy() -> None:
    holder = Holder(None)
    holder.value = {
        "me": holder,
        "call": holder.add,
        "list": [holder, holder],
        "ring": deque([[1]], maxlen=2),
    }
    found = copied(holder, {})
    assert found is not holder and found.value["me"] is found
    assert found.value["list"][0] is found.value["list"][1] is found
    found.value["call"]()
    found.value["ring"].extend([2, 3])
    assert (found.count, holder.count) == (1, 0)
    assert [*found.value["ring"]] == [2, 3] and [*holder.value["ring"]] == [[1]]


def test_factors_that_are_added_to_a_copy_are_not_in_the_original() -> None:
    factor = jacobian_factor(np.array([pose_key(0)]), np.eye(3), np.zeros(3))
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(factor)
    found = copied([graph, graph], {})
    found[0].push_back(factor)
    assert graph.size() == 1 and found[1].size() == 2


@pytest.mark.failing
def test_an_estimator_goes_back_to_its_last_noted_call() -> None:
    holder, recovery = Holder([0]), Recovery()
    for k in range(50):
        recovery.before(holder)
        holder.value.append(k)
        recovery.called(partial(holder_append, holder, k))
        if k % 7 == 0:
            known = list(holder.value)
            holder.value.append("half done")
            recovery.take_back(holder)
            assert holder.value == known


@pytest.mark.failing
def test_a_call_that_fails_when_it_is_made_again_ends_the_way_back() -> None:
    holder, recovery, fine = Holder([]), Recovery(), [True]

    def second() -> None:
        if not fine[0]:
            raise ValueError("now it fails")
        holder.value.append(2)

    recovery.before(holder)
    for call in (lambda: holder.value.append(1), second, lambda: holder.value.append(3)):
        call()
        recovery.called(partial(call))
    fine[0] = False
    recovery.take_back(holder)
    assert holder.value == [1]
    with pytest.raises(RuntimeError, match="expected a copy"):
        Recovery().take_back(holder)


@pytest.mark.failing
def test_a_copy_is_due_every_tenth_call_and_where_something_came_from_outside() -> None:
    holder, recovery = Holder([0]), Recovery()
    repeated = list[int]()
    for k in range(7):
        recovery.before(holder, outside=k >= 5)
        recovery.called(partial(repeated.append, k))
    recovery.take_back(holder)
    assert repeated == [5, 6]
    for k in range(7, 17):
        recovery.before(holder, outside=True)
        recovery.called(partial(repeated.append, k))
    recovery.take_back(holder)
    assert repeated == [5, 6, 15, 16]


@pytest.mark.slow
def test_a_copy_of_a_mapper_goes_on_to_the_same_bits() -> None:
    """In lap 1, while the lap is solved, and on the closed map; nothing that copies share can change."""
    log = lap_log(bean_track(), overrun=30.0)
    mapper = FixedLagMapper(None, log.noise)
    for k, (odometry, detections) in enumerate(split_odometry(log)):
        mapper.wait()
        if k % 25 == 5:
            twin = copied(mapper, {id(mapper.recovery): mapper.recovery})
            assert digest(twin) == digest(mapper)
            twin.recovery = Recovery()
            twin.wait()
            twin.update(odometry, detections)
            mapper.update(odometry, detections)
            assert digest(twin) == digest(mapper)
            check_shared(mapper, set())
        else:
            mapper.update(odometry, detections)
    assert mapper.closed


def check_shared(value: Any, seen: set[int]) -> None:
    """Asserts of everything within reach that what copies share holds nothing that they would not."""
    if id(value) in seen or isinstance(value, np.ndarray):
        return
    seen.add(id(value))
    if isinstance(value, dict | list | tuple | set | deque):
        for one in value.values() if isinstance(value, dict) else value:
            check_shared(one, seen)
    elif type(value).__module__.startswith("pathspace_graph") and hasattr(value, "__dict__"):
        is_constant = getattr(type(value), "constant", False)
        for name, own in vars(value).items():
            if is_shared(value) and not is_constant and not isinstance(own, np.ndarray):
                assert is_shared(own), f"{type(value).__name__}.{name}"
            check_shared(own, seen)
