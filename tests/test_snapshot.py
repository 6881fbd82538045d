"""Snapshots of estimators: the table of classes, the codecs of foreign types, and what is no estimator."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest
from joblib.externals.loky import Future
from scipy.spatial import KDTree

from pathspace_graph import FixedLagMapper, MapperSettings
from pathspace_graph.ckf.mapper import CkfMapper
from pathspace_graph.errors import InputError
from pathspace_graph.graph.keys import pose_keys
from pathspace_graph.graph.variables import Layout
from pathspace_graph.io.object_graph import Decoder, Encoder
from pathspace_graph.landmark.ckf import LandmarkCkf
from pathspace_graph.landmark.fixed_lag import LandmarkFixedLag
from pathspace_graph.run import split_odometry
from pathspace_graph.snapshot import CODECS, known_classes, restore, save

from .scenes.digest import digest
from .scenes.drives import ODOMETRY_SIGMA, ahead, corridor, exact_log

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
    structure, data = Encoder({}, CODECS).encode([graph, net, tree, Future(), conditional])
    found, found_net, found_tree, future, alone = Decoder({}, CODECS).decode(structure, data)
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
