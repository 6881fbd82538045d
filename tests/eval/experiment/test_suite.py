"""The suite is a study of single faults with names that say kind and strength."""

from __future__ import annotations

import re

import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.experiment.faults import CLEAN, Fault, at_strength, fault_of, kinds, only, suite
from pathspace_graph.io.overrides import leaves
from pathspace_graph.sim.faults import Faults
from pathspace_graph.sim.simulate import SimulationSettings

from ...scenes.paths import ROOT


@pytest.mark.parametrize(
    ("noise", "fault"),
    [
        ("latency: 20 ms", Fault("latency", 20.0, "ms")),
        ("false positives a cycle: 0.5", Fault("false positives a cycle", 0.5, "")),
        ("yaw-rate bias: 0.01 rad/s", Fault("yaw-rate bias", 0.01, "rad/s")),
        (CLEAN, Fault(CLEAN, 0.0, "")),
    ],
)
def test_a_noise_says_the_fault_and_its_strength(noise: str, fault: Fault) -> None:
    assert fault_of(noise) == fault


@pytest.mark.parametrize("noise", ["latency", "latency: much", "latency: 1.2.3 s", ": 1 s"])
def test_any_other_name_is_refused(noise: str) -> None:
    with pytest.raises(SettingsError, match="expected a name such as"):
        fault_of(noise)


def test_every_fault_has_up_to_three_rising_strengths_of_one_unit_and_is_no_other_run() -> None:
    study = suite()
    assert next(iter(study.noise)) == CLEAN
    assert study.simulation(CLEAN).faults == Faults()
    faults = [fault_of(noise) for noise in study.noise]
    for kind in kinds(study):
        strengths = [fault.value for fault in faults if fault.kind == kind]
        assert strengths == sorted(set(strengths))
        assert len(strengths) == 3
        assert len({fault.unit for fault in faults if fault.kind == kind}) == 1
    simulations = [study.simulation(noise) for noise in study.noise]
    assert len({repr(one) + repr(one.faults) for one in simulations}) == len(simulations)
    assert simulations[0] == SimulationSettings(laps=study.laps)


def test_the_strength_in_the_name_is_that_of_the_settings() -> None:
    study = suite()
    faults = {noise: study.simulation(noise).faults for noise in study.noise}
    assert faults["latency of detections: 50 ms"].sensor.latency == 0.05
    assert faults["sensor turned: 2 °"].sensor.yaw == pytest.approx(0.0349, abs=1e-4)
    assert faults["range bias: 0.4 m"].sensor.range_bias == 0.4
    assert faults["odometry missing in lap 2: 1 s"].odometry.gap == 1.0
    assert faults["odometry missing in lap 2: 1 s"].odometry.gap_at == 1.5
    assert faults["put down farther on in lap 2: 30 m"].vehicle.put_down == 30.0


def test_only_some_faults_are_chosen_beside_the_clean_run() -> None:
    study = suite()
    assert list(only(study, ["range bias"]).noise) == [
        CLEAN,
        *(f"range bias: {strength} m" for strength in ("0.1", "0.2", "0.4")),
    ]
    assert only(study, []) == study
    with pytest.raises(SettingsError, match=r"--only: expected a known fault.*the nearest is 'range bias'"):
        only(study, ["range bia"])


def test_the_quick_suite_has_the_greatest_strength_of_each_fault() -> None:
    study = suite()
    quick = at_strength(study, 1.0)
    assert kinds(quick) == kinds(study)
    assert len(quick.noise) == 1 + len(kinds(study))
    assert "range bias: 0.4 m" in quick.noise and "range bias: 0.2 m" not in quick.noise


def test_the_page_names_every_setting_of_a_fault_and_no_other() -> None:
    page = (ROOT / "docs" / "reliability.md").read_text()
    known = set(leaves(SimulationSettings()))
    named = set(re.findall(r"`(faults\.[a-z_.]+|sensor\.[a-z_.]+)`", page))
    assert named <= known
    for setting in leaves(Faults()):
        assert setting.rpartition(".")[2] in page, setting
