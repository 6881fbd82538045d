"""Variables by key: insertion and removal keep the other values, and keys are GTSAM's symbols."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pathspace_graph.factors._kernels import spread
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    CONTROL_LETTERS,
    POSE,
    UNKNOWN,
    Layout,
    Variables,
    are_poses,
    control_keys,
    indices,
    landmark_keys,
    letter_keys,
    name,
    pose_key,
    pose_keys,
    rotation_blocks,
    sizes,
)

from ..scenes.graph import KEYS, LEFT_KEYS, MAP_KEYS, POSE_KEYS, RIGHT_KEYS, columns_of, random_variables

# --- keys ------------------------------------------------------------------------------------------------


def test_keys_are_gtsam_s_symbols() -> None:
    numbers = np.array([0, 1, 12, 2620])
    for letter, keys in (
        ("l", control_keys(0, numbers)),
        ("r", control_keys(1, numbers)),
        ("m", landmark_keys(numbers)),
        ("x", pose_keys(numbers)),
    ):
        assert keys.tolist() == [gtsam.symbol(letter, int(k)) for k in numbers]
        assert [name(key) for key in keys.tolist()] == [f"{letter}{k}" for k in numbers]
        assert indices(keys).tolist() == numbers.tolist()
        first, last = letter_keys(letter)
        assert (first <= keys).all() and (keys < last).all()
        assert (sizes(keys) == (3 if letter == "x" else 2)).all()
        assert (are_poses(keys) == (letter == "x")).all()
    assert gtsam.symbol("b", 0) == CALIBRATION_KEY
    assert pose_key(7) == gtsam.symbol("x", 7)


def test_the_order_of_the_keys_is_calibration_points_poses() -> None:
    """`State.map_points` and the damping of a step depend on it."""
    ordered = [CALIBRATION_KEY, *(gtsam.symbol(letter, 5) for letter in ("l", "m", "r", "x"))]
    assert ordered == sorted(ordered)


# --- layout ----------------------------------------------------------------------------------------------


def test_a_layout_says_where_each_key_lies() -> None:
    layout = Layout(KEYS)
    assert layout.size == 2 + 2 * 7 + 3 * 4
    for keys in (KEYS, KEYS[::-1], POSE_KEYS[[2, 0]], LEFT_KEYS[[1, 1]]):
        np.testing.assert_array_equal(layout.entries(keys), columns_of(keys, KEYS))
    square = np.array([[KEYS[0], LEFT_KEYS[-1] + 1], [POSE_KEYS[-1] + 1, 0]])
    np.testing.assert_array_equal(layout.positions(square), [[0, UNKNOWN], [UNKNOWN, UNKNOWN]])
    np.testing.assert_array_equal(layout.columns(square), [[0, UNKNOWN], [UNKNOWN, UNKNOWN]])
    assert [layout.ordering.at(i) for i in range(len(KEYS))] == KEYS.tolist()


def test_an_empty_layout_holds_nothing() -> None:
    layout = Layout(np.zeros(0, np.intp))
    assert layout.size == 0
    assert layout.positions(KEYS).tolist() == [UNKNOWN] * len(KEYS)
    assert layout.columns(KEYS).tolist() == [UNKNOWN] * len(KEYS)
    assert layout.entries(np.zeros(0, np.intp)).tolist() == []
    assert layout.block("x") == slice(0, 0)


@pytest.mark.parametrize(
    ("letter", "own"),
    [("b", KEYS[:1]), ("l", LEFT_KEYS), ("m", LEFT_KEYS[:0]), ("r", RIGHT_KEYS), ("x", POSE_KEYS)],
)
def test_a_block_is_all_columns_of_a_letter(letter: str, own: IntArray) -> None:
    layout = Layout(KEYS)
    block = layout.block(letter)
    expected = columns_of(own, KEYS).tolist() if len(own) else []
    assert list(range(block.start, block.stop)) == expected


def test_spread_is_every_column_of_a_block() -> None:
    assert spread(np.array([5, 0, 9]), np.array([2, 3, 1])).tolist() == [5, 6, 0, 1, 2, 9]
    assert spread(np.zeros(0, np.intp), np.zeros(0, np.intp)).tolist() == []


def test_rotation_blocks_turn_some_pairs_of_columns_and_leave_the_others() -> None:
    found = rotation_blocks(5, np.array([0, 3]), np.array([np.pi / 2.0, np.pi])) @ [1.0, 2.0, 7.0, 3.0, 4.0]
    np.testing.assert_allclose(found, [-2.0, 1.0, 7.0, -3.0, -4.0], atol=1e-12)


# --- values ----------------------------------------------------------------------------------------------


def expected_value(key: int) -> Array:
    """Of a key: unlike that of any other."""
    return (key % 1009) + 0.25 * np.arange(3 if chr(key >> 56) == "x" else 2)


def values_of(keys: IntArray) -> Array:
    return np.concatenate([np.zeros(0), *(expected_value(key) for key in keys.tolist())])


def assert_values_stay_with_their_keys(variables: Variables, keys: set[int]) -> None:
    assert variables.keys.tolist() == sorted(keys)
    assert variables.layout.size == len(variables.values)
    for key in keys:
        value = expected_value(key)
        entries = variables.layout.entries(np.array([key]))
        np.testing.assert_array_equal(variables.values[entries], value)
        np.testing.assert_array_equal(variables.reference[entries], value - 100.0)
        np.testing.assert_array_equal(variables.linearized[entries], value)


@pytest.mark.parametrize(
    "new",
    [
        control_keys(0, np.array([1, 2])),
        control_keys(0, np.array([9, 10])),
        control_keys(0, np.array([1, 5])),
        control_keys(0, np.array([1, 2, 5, 7])),
        np.array([CALIBRATION_KEY]),
        pose_keys(np.array([3])),
        np.array(
            [
                CALIBRATION_KEY,
                *control_keys(0, np.array([1, 9])),
                *control_keys(1, np.array([0])),
                pose_key(9),
            ]
        ),
    ],
    ids=["middle", "end of a letter", "apart", "around", "first", "last", "everywhere"],
)
def test_new_variables_come_between_known_ones(new: IntArray) -> None:
    known = np.concatenate([control_keys(0, np.array([0, 3, 4, 6])), pose_keys(np.array([0, 2]))])
    variables = Variables()
    variables.insert(known, values_of(known), values_of(known) - 100.0)
    variables.insert(new, values_of(new), values_of(new) - 100.0)
    assert_values_stay_with_their_keys(variables, {*known.tolist(), *new.tolist()})


POOL = np.sort(
    np.concatenate(
        [
            [CALIBRATION_KEY],
            *(control_keys(b, np.arange(8)) for b in (0, 1)),
            landmark_keys(np.arange(3)),
            pose_keys(np.arange(8)),
        ]
    )
)


@settings(max_examples=150)
@given(
    st.lists(
        st.tuples(st.booleans(), st.sets(st.integers(0, len(POOL) - 1), min_size=1, max_size=9)), max_size=8
    )
)
def test_values_stay_with_their_keys_whatever_comes_and_goes(changes: list[tuple[bool, set[int]]]) -> None:
    variables, held = Variables(), set()
    for inserting, numbers in changes:
        keys = POOL[sorted(numbers)]
        known = np.isin(keys, list(held))
        keys = keys[~known] if inserting else keys[known]
        if inserting:
            variables.insert(keys, values_of(keys), values_of(keys) - 100.0)
            held |= set(keys.tolist())
        else:
            variables.remove(keys)
            held -= set(keys.tolist())
        assert_values_stay_with_their_keys(variables, held)


def test_a_known_key_is_not_inserted_again() -> None:
    variables = random_variables(np.random.default_rng(0))
    before = variables.copy()
    with pytest.raises(ValueError, match="expected new keys"):
        variables.insert(np.append(LEFT_KEYS[-1:], LEFT_KEYS[-1:] + 1), np.zeros(4))
    np.testing.assert_array_equal(variables.keys, before.keys)
    np.testing.assert_array_equal(variables.values, before.values)


def test_a_reference_is_the_first_value_unless_it_is_given() -> None:
    variables = Variables()
    variables.insert(LEFT_KEYS[:2], np.arange(4.0))
    variables.values += 10.0
    variables.insert(LEFT_KEYS[2:3], np.array([7.0, 8.0]), np.array([1.0, 1.0]))
    np.testing.assert_array_equal(variables.reference, [0.0, 1.0, 2.0, 3.0, 1.0, 1.0])
    np.testing.assert_array_equal(variables.change(np.arange(6)), [10.0, 10.0, 10.0, 10.0, 6.0, 7.0])
    np.testing.assert_array_equal(variables.of(LEFT_KEYS[[2, 0]]), [7.0, 8.0, 10.0, 11.0])


def test_blocks_are_views_and_values_of_keys_are_copies() -> None:
    variables = random_variables(np.random.default_rng(1))
    variables.first_cycle = 7
    variables.block(CONTROL_LETTERS[1])[:] = 5.0
    variables.poses[0] = 9.0
    variables.calibration[:] = 3.0
    np.testing.assert_array_equal(variables.of(RIGHT_KEYS), 5.0)
    np.testing.assert_array_equal(variables.of(pose_keys(np.array([7]))), 9.0)
    np.testing.assert_array_equal(variables.of(KEYS[:1]), 3.0)
    variables.of(RIGHT_KEYS)[:] = 0.0
    assert (variables.of(RIGHT_KEYS) == 5.0).all()


@pytest.mark.parametrize("first_cycle", [5, 7, 8])
def test_poses_older_than_the_window_are_keyframes(first_cycle: int) -> None:
    variables = random_variables(np.random.default_rng(2))
    variables.first_cycle = first_cycle
    older = POSE_KEYS[: first_cycle - 5]
    np.testing.assert_array_equal(variables.keyframes, older)
    expected = variables.of(POSE_KEYS[first_cycle - 5 :]).reshape(-1, POSE)
    np.testing.assert_array_equal(variables.poses, expected)
    cycles = np.array([8, first_cycle, 8])
    np.testing.assert_array_equal(variables.poses_at(cycles), expected[cycles - first_cycle])


def test_a_keyframe_of_long_ago_stands_before_the_window() -> None:
    variables = Variables()
    variables.insert(pose_keys(np.array([2, 40, 41])), np.arange(9.0))
    variables.first_cycle = 40
    np.testing.assert_array_equal(variables.keyframes, pose_keys(np.array([2])))
    np.testing.assert_array_equal(variables.poses, [[3.0, 4.0, 5.0], [6.0, 7.0, 8.0]])


def test_values_as_gtsam_has_them() -> None:
    """A pose is a `Pose2`, its heading wrapped; all others are points."""
    variables = random_variables(np.random.default_rng(3))
    variables.block("x")[2::POSE] += 7.0
    values = variables.gtsam_values(KEYS[[0, 2, -1]])
    assert values.size() == 3
    np.testing.assert_array_equal(values.atPoint2(int(KEYS[0])), variables.calibration)
    np.testing.assert_array_equal(values.atPoint2(int(KEYS[2])), variables.of(KEYS[2:3]))
    pose, expected = values.atPose2(int(KEYS[-1])), variables.of(KEYS[-1:])
    np.testing.assert_allclose([pose.x(), pose.y()], expected[:2])
    np.testing.assert_allclose(
        [np.cos(pose.theta()), np.sin(pose.theta())], [np.cos(expected[2]), np.sin(expected[2])]
    )
    assert (variables.of(POSE_KEYS)[2::POSE] > np.pi).any()


def test_a_copy_has_values_of_its_own() -> None:
    variables = random_variables(np.random.default_rng(4))
    other = variables.copy()
    other.values[:], other.linearized[:] = 0.0, 0.0
    other.remove(MAP_KEYS)
    assert (variables.values != 0.0).all() and (variables.linearized != 0.0).all()
    assert len(variables.keys) == len(KEYS)


def test_looking_restores_every_value_also_after_an_error() -> None:
    variables = Variables()
    variables.insert(np.array([CALIBRATION_KEY]), np.array([0.1, 0.2]))
    with pytest.raises(ZeroDivisionError), variables.looked_at():
        variables.values[:] = 7.0
        raise ZeroDivisionError
    assert variables.values.tolist() == [0.1, 0.2]
