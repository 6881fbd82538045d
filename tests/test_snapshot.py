"""Snapshots of estimators: the table of classes, foreign types, the file, and what is no estimator."""

from __future__ import annotations

import json
from pathlib import Path

import gtsam
import numpy as np
import pytest
from joblib.externals.loky import Future
from scipy.spatial import KDTree

from pathspace_graph import FixedLagMapper, MapperSettings
from pathspace_graph.baselines.filters import CkfMapper, LandmarkCkf
from pathspace_graph.baselines.landmark_fixed_lag import LandmarkFixedLag
from pathspace_graph.errors import InputError
from pathspace_graph.graph.variables import Layout, pose_keys
from pathspace_graph.run import split_odometry
from pathspace_graph.snapshot import Decoder, Encoder, archive, known_classes, read, restore, save, write

from .scenes.digest import digest
from .scenes.drives import ODOMETRY_SIGMA, ahead, corridor, exact_log
from .scenes.kills import kills, leftovers

Estimator = LandmarkFixedLag | CkfMapper | LandmarkCkf


def test_the_table_has_the_classes_of_estimators_and_no_others() -> None:
    known = known_classes()
    assert known["online.fixed_lag.FixedLagMapper"] is FixedLagMapper
    assert known["settings.mapper.MapperSettings"] is MapperSettings
    assert known["graph.variables.Layout"] is Layout
    rooms = {name.split(".")[0] for name in known}
    assert not rooms & {"commands", "eval", "sim", "errors", "run"}
    assert all(name.startswith("io.log.") for name in known if name.startswith("io."))


def test_foreign_types_come_back() -> None:
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
    structure, numbers = Encoder({}).encode([graph, net, tree, Future(), conditional])
    found, found_net, found_tree, future, alone = Decoder({}).decode(structure, numbers)
    assert [type(found.at(k)) for k in range(4)] == [type(graph.at(k)) for k in range(4)]
    for k in range(4):
        one, other = found.at(k).augmentedInformation(), graph.at(k).augmentedInformation()
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(found_net.at(0).R(), conditional.R())
    np.testing.assert_array_equal(alone.augmentedJacobian(), blocks)
    np.testing.assert_array_equal(found_tree.query(np.ones((3, 2)))[1], tree.query(np.ones((3, 2)))[1])
    assert future is None


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


# --- the file --------------------------------------------------------------------------------------------

STRUCTURE = {"root": [0], "text": "ä\n", "numbers": [1, -0.0, 5e-324, 1.7976931348623157e308]}


@pytest.mark.parametrize("data", [b"", b"\n", b"\0\xff\n" * 5])
def test_what_was_written_is_read(data: bytes, tmp_path: Path) -> None:
    write(tmp_path / "a.snap", STRUCTURE, np.frombuffer(data, np.uint8))
    structure, numbers = read(tmp_path / "a.snap")
    assert structure == {"format": "pathspace-snapshot/2", **STRUCTURE}
    assert numbers.tobytes() == data


def test_it_is_an_archive_that_numpy_reads(tmp_path: Path) -> None:
    save(CkfMapper(None, ODOMETRY_SIGMA), tmp_path / "a.snap")
    with np.load(tmp_path / "a.snap", allow_pickle=False) as archive:
        structure = json.loads(archive["structure"].tobytes())
    assert structure["format"] == "pathspace-snapshot/2"


def test_no_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.snap", tmp_path):
        with pytest.raises(InputError, match="expected a snapshot, found"):
            read(path)


def test_the_format_before_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.snap").write_bytes(b"pathspace-snapshot/1\n" + b"0" * 64 + b"\n2\n{}\n\x80\x04\x95")
    expected = r"a\.snap: expected pathspace-snapshot/2, found 'pathspace-snapshot/1'"
    with pytest.raises(InputError, match=f"{expected}$"):
        restore(tmp_path / "a.snap", CkfMapper, id)


def test_a_pickle_is_never_read(tmp_path: Path) -> None:
    file = tmp_path / "a.snap"
    file.write_bytes(archive(b"", np.array([STRUCTURE], dtype=object)))
    with pytest.raises(InputError, match="found another content"):
        read(file)
    with np.load(file, allow_pickle=True) as members:
        assert members["numbers"][0] == STRUCTURE


def test_every_flipped_bit_and_every_cut_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.snap"
    write(file, STRUCTURE, np.arange(3, dtype=np.uint8))
    good = file.read_bytes()
    for at in range(len(good)):
        for damaged in (good[:at], good[:at] + bytes([good[at] ^ 1 << at % 8]) + good[at + 1 :]):
            file.write_bytes(damaged)
            with pytest.raises(InputError, match=r"a\.snap: expected") as caught:
                read(file)
            assert "\n" not in str(caught.value)
    file.write_bytes(good + b"\0")
    with pytest.raises(InputError, match="another content"):
        read(file)


def test_a_number_that_json_does_not_have_is_no_structure(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Out of range float"):
        write(tmp_path / "a.snap", {"root": float("nan")}, np.zeros(0, np.uint8))
    assert not [*tmp_path.iterdir()]


def test_a_kill_at_any_step_leaves_the_old_file_or_the_new_one(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    file = folder / "a.snap"
    write(file, {"root": "old"}, np.zeros(1, np.uint8))
    steps = 0
    for killed in kills(lambda: write(file, {"root": "new"}, np.zeros(1, np.uint8)), folder):
        steps += killed
        assert read(file)[0]["root"] in ("old", "new")
        assert all(read(backup) for backup in folder.glob("a.snap.~*"))
        write(file, {"root": "new"}, np.zeros(1, np.uint8))
        assert leftovers(folder) == []
    assert steps > 3
    assert {path.name for path in folder.iterdir()} == {"a.snap", "a.snap.~1~", "a.snap.~2~"}
