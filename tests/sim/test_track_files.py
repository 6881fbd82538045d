"""Track files of four kinds: small ones, written here for every trap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import InputError
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.labels import BIG_ORANGE
from pathspace_graph.sim.track import Track, to_map_frame
from pathspace_graph.sim.track_files import driving_order, read_track
from pathspace_graph.sim.track_generator import generate_track


def assert_plausible(track: Track) -> None:
    """Rows in driving order on their own sides of a centre line that stays between them."""
    line = track.centre_line
    s = np.arange(0.0, line.length, 0.5)
    points, tangents = line.points(s), line.tangents(s)
    for row, side in ((track.left, 1.0), (track.right, -1.0)):
        nearest = np.argmin(np.linalg.norm(row[:, None] - points, axis=-1), axis=1)
        across = row - points[nearest]
        tangent = tangents[nearest]
        assert (side * (tangent[:, 0] * across[:, 1] - tangent[:, 1] * across[:, 0]) > 0.5).all()
        steps = (np.diff(s[nearest], append=s[nearest[0]]) + line.length / 2) % line.length - line.length / 2
        assert (steps if track.closed else steps[:-1]).min() > -1.5
    assert line.clearance.min() > 1.0


def eufs_text(track: Track, rng: np.random.Generator) -> str:
    x, y, theta = track.start
    rows = [f"car_start,{x},{y},{theta},,,"]
    rows += [f"blue,{x},{y},0,0.01,0.01,0" for x, y in track.left]
    rows += [f"yellow,{x},{y},0,,,0" for x, y in track.right]
    rng.shuffle(rows)
    return "tag,x,y,direction,x_variance,y_variance,xy_covariance\n" + "\n".join(rows) + "\n"


def same_ring(row: np.ndarray, expected: np.ndarray) -> bool:
    first = int(np.argmin(np.linalg.norm(row - expected[0], axis=1)))
    return row.shape == expected.shape and np.allclose(np.roll(row, -first, axis=0), expected)


@pytest.mark.parametrize("seed", range(12))
def test_shuffled_cones_are_put_in_driving_order(tmp_path: Path, seed: int) -> None:
    track = generate_track(np.random.default_rng(seed))
    (tmp_path / "t.csv").write_text(eufs_text(track, np.random.default_rng(seed)))
    read = read_track(tmp_path / "t.csv")
    assert read.closed
    assert len(read.other) == 0
    assert same_ring(read.left, track.left)
    assert same_ring(read.right, track.right)


def neck_track() -> Track:
    """A dumb-bell whose two left rows stand back to back, 0.7 m apart and with 2 m gaps, in the neck."""
    neck = np.arange(-6.0, 6.1, 2.0)
    angles = np.linspace(-0.75 * np.pi, 0.75 * np.pi, 10)[1:-1]
    lobe = np.column_stack([10.5 + 5.5 * np.cos(angles), 5.5 * np.sin(angles)])
    outer = np.linspace(-0.62 * np.pi, 0.62 * np.pi, 14)
    outer_lobe = np.column_stack([10.5 + 9.0 * np.cos(outer), 9.0 * np.sin(outer)])
    left = np.vstack([np.column_stack([neck, neck * 0 - 0.35]), lobe])
    left = np.vstack([left, -left])
    right = np.vstack([np.column_stack([neck[1:-1], neck[1:-1] * 0 - 3.9]), outer_lobe])
    right = np.vstack([right, -right])
    return Track(left, right, np.zeros((0, 2)), True, np.array([0.0, -2.1, 0.0]), "neck")


def test_rows_of_one_colour_back_to_back_are_kept_apart(tmp_path: Path) -> None:
    track = neck_track()
    (tmp_path / "t.csv").write_text(eufs_text(track, np.random.default_rng(1)))
    read = read_track(tmp_path / "t.csv")
    assert read.closed
    assert same_ring(read.left, track.left)
    assert same_ring(read.right, track.right)
    assert_plausible(read)


def straight_eufs(extra: str = "") -> str:
    rows = "".join(f"blue,{x},2,0,,,\nyellow,{x},-2,0,,,\n" for x in range(-5, 30, 5))
    return "tag,x,y,direction,x_variance,y_variance,xy_covariance\ncar_start,-6,0,0,,,\n" + rows + extra


def test_open_lane_with_duplicates_gate_and_marks(tmp_path: Path) -> None:
    extra = "blue,0.1,2.1,0,,,\nbig_orange,-5.5,2,0,,,\nmidpoint,0,0,0,,,\norange,40,0,0,,,\n"
    (tmp_path / "t.csv").write_text(straight_eufs(extra))
    track = read_track(tmp_path / "t.csv")
    assert not track.closed
    np.testing.assert_allclose(track.left[:, 0], np.arange(-5.0, 30.0, 5.0))
    np.testing.assert_allclose(track.right[:, 0], np.arange(-5.0, 30.0, 5.0))
    assert len(track.other) == 2
    assert track.centre_line.length == pytest.approx(30.0, abs=0.1)


def test_without_a_start_it_is_between_the_first_blue_cone_and_its_opposite(tmp_path: Path) -> None:
    """The lane leads along 0.3 rad."""
    lane, turn = np.arange(0.0, 40.0, 5.0), rotation(0.3)
    sides = {
        tag: np.column_stack([lane, 0.0 * lane + y]) @ turn.T for tag, y in (("blue", 2), ("yellow", -2))
    }
    rows = [f"{tag},{x},{y},0" for tag, side in sides.items() for x, y in side.tolist()]
    (tmp_path / "t.csv").write_text("\n".join(["tag,x,y,direction", *rows]))
    np.testing.assert_allclose(read_track(tmp_path / "t.csv").start, [0.0, 0.0, 0.3], atol=1e-9)


def square_yaml(**replaced: str) -> str:
    """A PacSim square of 20 m with 4 m lanes, driven counter-clockwise from the middle of its bottom."""

    def row(half: float) -> str:
        side = np.linspace(-half, half, 5)[:-1]
        corners = [(x, -half) for x in side] + [(half, y) for y in side]
        corners += [(-x, half) for x in side] + [(-half, -y) for y in side]
        return "".join(f"\n    - {{position: [{x}, {y}, 0.0], class: cone}}" for x, y in corners)

    parts = {
        "closed": "lanesFirstWithLastConnected: true",
        "start": "start: {position: [0.0, -10.0, 0.0], orientation: [0.0, 0.0, 0.0]}",
        "left": "left:" + row(8.0),
        "right": "right:" + row(12.0),
        "unknown": "unknown: []",
        **replaced,
    }
    return "track:\n" + "".join(f"  {part}\n" for part in parts.values())


def test_pacsim_square(tmp_path: Path) -> None:
    (tmp_path / "square.yml").write_text(square_yaml(unknown="unknown: [{position: [1e-1, 2, 0], class: x}]"))
    track = read_track(tmp_path / "square.yml")
    assert len(track.left) == len(track.right) == 16
    np.testing.assert_allclose(track.other, [[0.1, 2.0]])
    assert 70.0 < track.centre_line.length < 80.0
    moved = to_map_frame(track)
    np.testing.assert_allclose(moved.left, track.left + np.array([0.0, 10.0]), atol=1e-12)


def test_the_classes_of_pacsim(tmp_path: Path) -> None:
    """Two cones of the left row are orange."""
    text = square_yaml()
    plain = tmp_path / "plain.yml"
    plain.write_text(text)
    track = read_track(plain)
    first, second = (f"[{x}, {y}, 0.0]" for x, y in track.left[:2].tolist())
    for at, kind in ((first, "big-orange"), (second, "small-orange")):
        assert f"{at}, class: cone" in text
        text = text.replace(f"{at}, class: cone", f"{at}, class: {kind}")
    (tmp_path / "classes.yml").write_text(text)
    found = read_track(tmp_path / "classes.yml")
    np.testing.assert_array_equal(found.left, track.left[2:])
    np.testing.assert_array_equal(found.other, track.left[:2])
    np.testing.assert_array_equal(found.right, track.right)


def test_rows_without_a_road_between_them_are_refused(tmp_path: Path) -> None:
    """Some cones of the right row stand beyond the left one."""
    (tmp_path / "square.yml").write_text(square_yaml())
    track = read_track(tmp_path / "square.yml")
    text = square_yaml()
    for x, y in track.right[1:4].tolist():
        text = text.replace(f"[{x}, {y}, 0.0]", f"[{x}, {y + 7.0}, 0.0]")
    (tmp_path / "crossed.yml").write_text(text)
    with pytest.raises(InputError, match="a road between them"):
        read_track(tmp_path / "crossed.yml")


def test_fssim_rows_may_repeat_their_first_cone_at_the_end(tmp_path: Path) -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 21)  # the last one is the first again
    rows = {
        side: r * np.column_stack([np.cos(angles), np.sin(angles)])
        for side, r in (("left", 8), ("right", 12))
    }
    lists = "".join(f"cones_{side}: {row.round(6).tolist()}\n" for side, row in rows.items())
    pose = "starting_pose_front_wing: [0.0, -10.0, 0.0]\n"
    (tmp_path / "t.yaml").write_text(f"{lists}{pose}cones_orange_big: [[1.0, -8.0], [1.0, -12.0]]\n")
    track = read_track(tmp_path / "t.yaml")
    assert track.closed and track.cone_labels[-2:].tolist() == [BIG_ORANGE] * 2
    for row, name in ((track.left, "left"), (track.right, "right")):
        np.testing.assert_allclose(row, rows[name][:-1], atol=1e-6)
    np.testing.assert_array_equal(track.start, [0.0, -10.0, 0.0])


BAD_YAML = [
    ({"left": "left: []"}, "at least 3 cones of the left boundary"),
    ({"start": "start: {position: [0, 80, 0], orientation: [0, 0, 0]}"}, "start on the track"),
    ({"start": "start: {position: [0, -10, 0], orientation: [0, 0, 3]}"}, "driving order"),
    ({"right": "right: [{position: [1, .nan, 0]}]"}, "track.right[0].position[1]: expected float"),
]


@pytest.mark.parametrize(("replaced", "message"), BAD_YAML)
def test_bad_pacsim(tmp_path: Path, replaced: dict[str, str], message: str) -> None:
    (tmp_path / "t.yaml").write_text(square_yaml(**replaced))
    with pytest.raises(InputError) as caught:
        read_track(tmp_path / "t.yaml")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


BAD_CSV = [
    ("blue,1,2,0\nblue,1,x,0\n", 2, "expected a number in column 'y', found 'x'"),  # without a header
    ("tag,x,y\nblue,0,0\nblue,1,0\nyellow,1,3\n", None, "at least 3 blue cones"),
    (straight_eufs().replace("car_start,-6,0,0", "car_start,-6,0,north"), 2, "heading of car_start"),
    ("# x_m,y_m,w_tr_right_m,w_tr_left_m\n0,0,1,1\n9,0,-1,1\n9,9,1,1\n", 3, "widths above 0"),
    ("# x_m,y_m,w_tr_right_m,w_tr_left_m\n0,0,1,1\n9,0,1,1\n9,0,1,1\n", 4, "other than the one before"),
    ("# x_m,y_m,w_tr_right_m,w_tr_left_m\n0,0,1,1\n9,0,1,1\n", None, "at least 3 points"),
]


@pytest.mark.parametrize(("text", "row", "message"), BAD_CSV)
def test_bad_csv(tmp_path: Path, text: str, row: int | None, message: str) -> None:
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        read_track(tmp_path / "t.csv")
    assert message in str(caught.value)
    if row is not None:
        assert caught.value.row == row


@pytest.mark.parametrize(
    ("name", "text"),
    [("t.csv", "a,b\n1,2\n"), ("t.yaml", "a: 1\n"), ("t.yaml", ""), ("t.txt", "x"), ("t", "x")],
)
def test_unknown_kind_names_the_known_ones(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=r"PacSim.*fssim.*EUFS.*TUM"):
        read_track(tmp_path / name)


@pytest.mark.parametrize("columns", [3, 4, 7])
@pytest.mark.parametrize("ends", ["\n", "\r\n"])
@pytest.mark.parametrize("seed", range(5))
def test_cones_without_a_header_are_those_with_one(
    tmp_path: Path, seed: int, ends: str, columns: int
) -> None:
    """As FSDS writes its tracks, whatever cone is in the first row."""
    rng = np.random.default_rng(seed)
    lines = eufs_text(generate_track(rng), rng).splitlines()
    rows = [",".join(f"{line},0.01,0.01,0".split(",")[:columns]) for line in lines[1:]]
    names = ",".join(["tag", "x", "y", "direction", "x_variance", "y_variance", "xy_covariance"][:columns])
    with_header, without = tmp_path / "with.csv", tmp_path / "without.csv"
    with_header.write_bytes(ends.join([names, *rows, ""]).encode())
    without.write_bytes(ends.join([*rows, ""]).encode())
    expected, found = read_track(with_header), read_track(without)
    for name in ("left", "right", "other", "start"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


@pytest.mark.parametrize("row", ["1.0,2.0,3.0,4.0", "cone,1.0,2.0", "blue,1.0", "blue,x,y", "blue;1.0;2.0"])
def test_rows_that_are_no_cones_are_shown_with_the_headers_that_are_known(tmp_path: Path, row: str) -> None:
    file = tmp_path / "track.csv"
    file.write_text(f"{row}\n{row}\n")
    with pytest.raises(InputError) as error:
        read_track(file)
    assert error.value.row == 1
    assert "(tag,x,y,direction)" in str(error.value) and f"found '{row}'" in str(error.value)


def test_tum_circle(tmp_path: Path) -> None:
    angles = np.arange(60) * 2 * np.pi / 60
    rows = "".join(f"{50 * np.cos(a)},{50 * np.sin(a)},4,6\n" for a in angles)
    (tmp_path / "t.csv").write_text("# x_m,y_m,w_tr_right_m,w_tr_left_m\n" + rows)
    track = read_track(tmp_path / "t.csv")
    np.testing.assert_allclose(np.linalg.norm(track.left, axis=1), 44.0, atol=0.1)
    np.testing.assert_allclose(np.linalg.norm(track.right, axis=1), 54.0, atol=0.1)
    for row in (track.left, track.right):
        assert np.linalg.norm(row - np.roll(row, 1, axis=0), axis=1).max() <= 5.0
    np.testing.assert_allclose(track.start, [50.0, 0.0, np.pi / 2], atol=1e-3)
    assert track.centre_line.length == pytest.approx(2 * np.pi * 49.0, rel=0.01)


# --- driving order of cones ------------------------------------------------------------------------------


ANGLES = np.arange(0.0, 2.0 * np.pi, np.pi / 10.0)
START = np.array([12.0, 0.0, 0.5 * np.pi])
NO_GATE = np.zeros((0, 2))


def ring(radius: float) -> np.ndarray:
    return radius * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])


def is_ring(row: np.ndarray) -> bool:
    """Whether all cones of a ring are in their order, from any one on."""
    return sorted(row.tolist()) == list(range(20)) and set(np.diff(row).tolist()) <= {1, -19}


def test_gate_cones_that_lead_off_the_lane_are_left_out() -> None:
    """The one behind the outer row is to the left of the start, and ends the walk round."""
    for gate in (NO_GATE, np.array([[9.0, 11.0]])):
        order = driving_order(ring(10.0), ring(14.0), gate, START)
        assert order is not None and order.closed
        assert is_ring(order.left) and is_ring(order.right)


def test_a_cone_far_from_its_row_is_not_one_of_it_and_a_missed_one_is() -> None:
    """The inner one is 0.5 m beside its row, out of the lane; the other one is in the middle of the ring."""
    inner = 9.5 * np.array([[np.cos(0.05 * np.pi), np.sin(0.05 * np.pi)]])
    order = driving_order(np.concatenate([ring(10.0), inner, np.zeros((1, 2))]), ring(14.0), NO_GATE, START)
    assert order is not None and order.closed
    assert 21 not in order.left
    before = order.left.tolist().index(20)
    assert {order.left[before - 1], order.left[(before + 1) % 21]} == {0, 1}


def test_the_lane_ends_where_its_rows_part() -> None:
    """Another road, 28 m to the right, is none of it."""
    x = np.arange(-5.0, 31.0, 5.0)
    left, near = np.column_stack([x, 0.0 * x + 2.0]), np.column_stack([x[:5], 0.0 * x[:5] - 2.0])
    far = np.column_stack([x[5:], 0.0 * x[5:] - 30.0])
    order = driving_order(left, np.concatenate([near, far]), NO_GATE, np.zeros(3))
    assert order is not None and not order.closed
    assert order.right.tolist() == [0, 1, 2, 3, 4]
    assert order.left[:5].tolist() == [0, 1, 2, 3, 4]


def test_a_start_is_on_the_leg_that_leads_its_way() -> None:
    """A hairpin of two legs 4 m apart; the start is nearer to the one that leads back."""
    x = np.arange(0.0, 41.0)
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)[1:-1]
    bend = np.column_stack([40.0 + 2.0 * np.cos(turn), 2.0 + 2.0 * np.sin(turn)])
    there, back = np.column_stack([x, 0.0 * x]), np.column_stack([x[::-1], 0.0 * x + 4.0])
    path, start = np.concatenate([there, bend, back]), np.zeros(3)
    line = Track(there, back, np.zeros((0, 2)), False, start, "hairpin", path=path).centre_line
    assert line.nearest(np.array([20.0, 2.6, 0.0])) == pytest.approx(20.0, abs=0.3)
    assert line.nearest(np.array([20.0, 1.4, np.pi])) == pytest.approx(line.length - 20.0, abs=0.3)
