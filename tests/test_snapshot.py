"""Snapshots of estimators: what comes back, and every file that is refused."""

from __future__ import annotations

import os
import pickle
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from joblib.externals.loky import Future
from scipy.spatial import KDTree

from pathspace_graph import FixedLagMapper, MapperSettings
from pathspace_graph.baselines.filters import CkfMapper, LandmarkCkf
from pathspace_graph.baselines.landmark_fixed_lag import LandmarkFixedLag
from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.graph.variables import pose_keys
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.run import split_odometry
from pathspace_graph.snapshot import SNAPSHOT, array_of, new, restore, save

from .scenes.digest import digest
from .scenes.drives import ODOMETRY_SIGMA, ahead, corridor, exact_log
from .scenes.kills import kills

Estimator = LandmarkFixedLag | CkfMapper | LandmarkCkf


def holder(**held: Any) -> DrivenPath:
    """Return one of our objects, which holds these things."""
    found = DrivenPath()
    vars(found).clear()
    vars(found).update(held)
    return found


def back(one: DrivenPath, folder: Path) -> Any:
    """Return an object that was saved and restored."""
    save(one, folder / "one.snap")
    return restore(folder / "one.snap", DrivenPath, id)


def test_foreign_types_come_back(tmp_path: Path) -> None:
    keys, widths = pose_keys(np.arange(2)), [3, 3]
    blocks = np.asfortranarray(np.random.default_rng(0).normal(size=(7, 7)))
    conditional = gtsam.GaussianConditional(
        keys.tolist(), 1, gtsam.VerticalBlockMatrix([*widths, 1], blocks, False)
    )
    graph, net = gtsam.GaussianFactorGraph(), gtsam.GaussianBayesNet()
    for factor in (conditional, gtsam.JacobianFactor(conditional), conditional.negate()):
        graph.push_back(factor)
    graph.push_back(gtsam.HessianFactor(graph))
    net.push_back(conditional)
    tree = KDTree(np.random.default_rng(1).normal(size=(50, 2)))
    ring = deque([1, 2], maxlen=2)
    held = holder(graph=graph, net=net, tree=tree, future=Future(), alone=conditional, ring=ring)
    found = back(held, tmp_path)
    assert [type(found.graph.at(k)) for k in range(4)] == [type(graph.at(k)) for k in range(4)]
    for k in range(4):
        one, other = found.graph.at(k).augmentedInformation(), graph.at(k).augmentedInformation()
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(found.net.at(0).R(), conditional.R())
    np.testing.assert_array_equal(found.alone.augmentedJacobian(), blocks)
    np.testing.assert_array_equal(found.tree.query(np.ones((3, 2)))[1], tree.query(np.ones((3, 2)))[1])
    assert found.future is None
    assert found.ring == ring and found.ring.maxlen == 2


def test_arrays_come_back_with_their_layout_and_whether_they_may_be_written(tmp_path: Path) -> None:
    fixed = np.arange(6.0).reshape(2, 3)
    fixed.flags.writeable = False
    held = [np.zeros((2, 3), order="F"), fixed, np.array([True]), np.zeros((0, 2)), np.array([-0.0, np.nan])]
    for one, other in zip(back(holder(held=held), tmp_path).held, held, strict=True):
        assert one.tobytes() == other.tobytes() and (one.shape, one.dtype) == (other.shape, other.dtype)
        assert one.flags.f_contiguous == other.flags.f_contiguous
        assert one.flags.writeable == other.flags.writeable


def test_what_is_held_twice_is_held_twice_and_may_hold_itself(tmp_path: Path) -> None:
    array, one = np.zeros(2), holder()
    vars(one).update(array=array, same=array, me=one, number=np.float64(0.1))
    found = back(one, tmp_path)
    assert found.array is found.same and found.me is found
    assert type(found.number) is np.float64 and found.number == 0.1


def test_another_estimator_is_not_restored_as_a_mapper(tmp_path: Path) -> None:
    file = tmp_path / "filter.snap"
    save(CkfMapper(None, ODOMETRY_SIGMA), file)
    with pytest.raises(InputError, match=r"filter\.snap: expected a FixedLagMapper: .* a CkfMapper"):
        FixedLagMapper.restore(file)


def test_what_a_check_raises_is_an_error_of_the_file(tmp_path: Path) -> None:
    def check(_: object) -> None:
        raise IndexError("index 3 is\nout of bounds")

    save(CkfMapper(None, ODOMETRY_SIGMA), tmp_path / "filter.snap")
    with pytest.raises(InputError, match="expected a CkfMapper: IndexError: index 3 is out of bounds"):
        restore(tmp_path / "filter.snap", CkfMapper, check)


@pytest.mark.parametrize("kind", [LandmarkFixedLag, CkfMapper, LandmarkCkf])
def test_the_other_online_estimators_go_on_to_the_same_state(kind: type[Estimator], tmp_path: Path) -> None:
    cones, labels = corridor(80.0)
    cycles = [*split_odometry(exact_log(ahead(8.0, 8.0), cones, labels))]
    estimator = kind(None, ODOMETRY_SIGMA)
    for cycle in cycles[:40]:
        estimator.update(*cycle)
    save(estimator, tmp_path / "half.snap")
    restored = restore(tmp_path / "half.snap", kind, lambda one: one.map())
    assert digest(restored) == digest(estimator)
    for cycle in cycles[40:]:
        np.testing.assert_array_equal(restored.update(*cycle).pose, estimator.update(*cycle).pose)
    assert digest(restored) == digest(estimator)


# --- what cannot be saved --------------------------------------------------------------------------------


@dataclass
class Foreign:
    number: int = 0


@pytest.mark.parametrize(
    ("held", "found"),
    [
        (Foreign(), "found a Foreign"),
        (print, "found a builtin_function_or_method"),
        (MapperSettings, "found a type"),
        (np.array([{}]), "found one of object"),
        (np.array(["text"]), "found one of <U4"),
    ],
)
def test_what_cannot_be_saved_is_refused_and_leaves_no_file(held: Any, found: str, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=found):
        save(holder(held=held), tmp_path / "one.snap")
    assert not [*tmp_path.iterdir()]


# --- what is refused -------------------------------------------------------------------------------------


class Calls:
    """Something whose pickle calls a function when it is read."""

    def __init__(self, call: Callable[..., Any], *arguments: Any) -> None:
        self.call, self.arguments = call, arguments

    def __reduce__(self) -> Any:
        return self.call, self.arguments


def write(file: Path, content: bytes, head: str = SNAPSHOT) -> None:
    """Write a snapshot with the digest that belongs to its content."""
    file.write_bytes(b"\n".join([head.encode(), sha256(content).hexdigest().encode(), content]))


OWN = "pathspace_graph.mapping.path"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (Calls(os.system, "touch called"), f"found {os.name}.system"),
        (Calls(eval, "print()"), "found builtins.eval"),
        (Calls(getattr, "text", "upper"), "found builtins.getattr"),
        (Calls(DrivenPath), f"found {OWN}.DrivenPath"),
        (Calls(MapperSettings), "found pathspace_graph.settings.mapper.MapperSettings"),
        (Calls(new, "os", "system"), "found 'os.system'"),
        (Calls(new, "pathlib", "Path"), "found 'pathlib.Path'"),
        (Calls(new, "pathspace_graph.io.files", "Path"), "found 'pathspace_graph.io.files.Path'"),
        (Calls(new, OWN, "np"), f"found '{OWN}.np'"),
        (Calls(new, OWN, "Text"), f"found '{OWN}.Text'"),
        (Calls(new, OWN, "DrivenPath.copy"), f"found '{OWN}.DrivenPath.copy'"),
        (Calls(array_of, b"\0" * 8, "|O", (1,), "C", True), "expected one of the types"),
        (Calls(array_of, b"\0" * 8, "<f8", (2,), "C", True), "cannot reshape"),
        (Calls(array_of, b"\0" * 7, "<f8", (1,), "C", True), "buffer size"),
        (Calls(array_of, b"", "<f8", (-1, 0, 10**18), "C", True), "ValueError"),
        (np.array([{}]), "found numpy"),
        ({"root": 1}, "found a dict"),
        (None, "found a NoneType"),
    ],
)
def test_a_file_calls_nothing_but_the_makers(
    content: Any, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "a.snap", pickle.dumps(content))
    with pytest.raises(InputError, match=r"a\.snap: expected a DrivenPath") as caught:
        restore(tmp_path / "a.snap", DrivenPath, id)
    assert told in str(caught.value) and "\n" not in str(caught.value)
    assert [file.name for file in tmp_path.iterdir()] == ["a.snap"]


@pytest.mark.parametrize("content", [b"", b".", b"\x80\x05.", b"garos\nsystem\n.", b"\x80\xff."])
def test_what_is_no_pickle_is_refused_in_one_line(content: bytes, tmp_path: Path) -> None:
    write(tmp_path / "a.snap", content)
    with pytest.raises(InputError, match=r"a\.snap: expected a DrivenPath") as caught:
        restore(tmp_path / "a.snap", DrivenPath, id)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "found"),
    [(b"Nr\xff\xff\xff\x07.", "LONG_BINPUT"), (b"S'\\_'\n.", "STRING"), (b"c\n\n.", "GLOBAL")],
)
def test_an_operation_that_is_never_written_is_refused(content: bytes, found: str, tmp_path: Path) -> None:
    """One of these would reserve a gigabyte of memory, and one would warn."""
    write(tmp_path / "a.snap", content)
    with pytest.raises(InputError, match=f"expected no {found}, found one at byte"):
        restore(tmp_path / "a.snap", DrivenPath, id)


def test_no_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.snap", tmp_path):
        with pytest.raises(InputError, match="expected a snapshot, found"):
            restore(path, DrivenPath, id)


@pytest.mark.parametrize("head", ["pathspace-snapshot/2", f"{SNAPSHOT}.1", "", SNAPSHOT[:-1]])
def test_another_format_or_version_is_refused_in_one_line(head: str, tmp_path: Path) -> None:
    write(tmp_path / "a.snap", pickle.dumps(None), head)
    with pytest.raises(InputError) as caught:
        restore(tmp_path / "a.snap", DrivenPath, id)
    assert str(caught.value).endswith(f"a.snap: expected {SNAPSHOT}, found {head!r}")


def test_every_flipped_bit_and_every_cut_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.snap"
    save(holder(array=np.zeros(1)), file)
    good = file.read_bytes()
    for at in range(len(good)):
        for damaged in (good[:at], good[:at] + bytes([good[at] ^ 1 << at % 8]) + good[at + 1 :]):
            file.write_bytes(damaged)
            with pytest.raises(InputError, match=r"a\.snap: expected") as caught:
                restore(file, DrivenPath, id)
            assert "\n" not in str(caught.value)
    file.write_bytes(good + b"\0")
    with pytest.raises(InputError, match="another content"):
        restore(file, DrivenPath, id)


def test_a_kill_at_any_step_leaves_the_old_file_or_the_new_one(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    file = folder / "a.snap"
    save(holder(name="old"), file)
    steps = 0
    for killed in kills(lambda: save(holder(name="new"), file), folder):
        steps += killed
        assert restore(file, DrivenPath, id).name in ("old", "new")  # type: ignore[attr-defined]
    assert steps > 1
    assert [path.name for path in folder.iterdir()] == ["a.snap"]
