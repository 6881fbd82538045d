"""Settings refuse numbers that mean nothing, by the name that the command line knows them by."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.options.runs import Online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.sensor import OdometryNoise

UNLIMITED = {
    "gate.huber",
    "odometry.doubt",
    "motion.doubt",
    "calibration.doubt",
    "closing.gauge_laps",
    "limits.silence",
}

SIGNED = {
    "odometry.scale",
    "odometry.bias",
    "calibration.yaw",
    "calibration.lateral",
    "calibration.latency",
    "calibration.range_scale",
    "calibration.range_bias",
}
"""Known errors may have either sign, and most often are zero."""


def numbers(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any, str]]:
    """The dotted name of each number in a tree of settings, the group that holds it, and its field."""
    for entry in fields(settings):
        name, value = f"{prefix}{entry.name}", getattr(settings, entry.name)
        if is_dataclass(value):
            yield from numbers(value, f"{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield name, settings, entry.name


NUMBERS = list(numbers(MapperSettings()))


@pytest.mark.parametrize(("name", "group", "field"), NUMBERS, ids=[name for name, *_ in NUMBERS])
def test_every_number_but_a_known_error_is_positive_and_most_are_finite(
    name: str, group: Any, field: str
) -> None:
    if name in SIGNED:
        wrong_ones: tuple[float, ...] = (nan, inf, -inf)
        for right in (0.0, -0.5, 0.5):
            assert getattr(replace(group, **{field: right}), field) == right
    else:
        wrong_ones = (0, -1.0, nan, *(() if name in UNLIMITED else (inf,)))
    for wrong in wrong_ones:
        with pytest.raises(SettingsError, match=f"^{re.escape(name)}: expected a .*, found {wrong}"):
            replace(group, **{field: wrong})


def test_infinity_means_no_limit_where_a_limit_is_set() -> None:
    settings = MapperSettings()
    assert replace(settings.gate, huber=inf).huber == inf


@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ({"lag": "3"}, "lag: expected a positive number, found '3'"),
        ({"steps": 1.5}, "steps: expected a positive whole number, found 1.5"),
        ({"steps": True}, "steps: expected a positive whole number, found True"),
        ({"noise": "guessed"}, "noise: expected 'measured' or 'stated', found 'guessed'"),
        ({"spline": 3}, "spline: expected a SplineSettings, found int"),
    ],
)
def test_a_setting_of_a_wrong_type_is_named(wrong: dict[str, Any], line: str) -> None:
    with pytest.raises(SettingsError, match=f"^{re.escape(line)}$"):
        MapperSettings(**wrong)


def test_numbers_of_numpy_are_numbers() -> None:
    assert MapperSettings(lag=np.float64(2.0), steps=np.int64(2)).lag == 2.0
    assert OdometryNoise(slow=(np.float64(1.0), np.int64(2), 3)).slow[1] == 2.0


def test_a_rule_of_a_tuple_holds_for_each_number_and_none_holds_without_it() -> None:
    assert OdometryNoise(slow=(0.0, 1.0, 0.0)).slow[0] == 0.0
    with pytest.raises(
        SettingsError, match=r"^odometry.white: expected .* each a positive number, found \(1.0, 0.0"
    ):
        OdometryNoise(white=(1.0, 0.0, 1.0))
    place = Online(log=Path("log"), out=Path("map"), start=(0.0, -1.0, 0.0))
    assert place.start == (0.0, -1.0, 0.0)
