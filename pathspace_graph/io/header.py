"""The header of a log: sections of texts and numbers in TOML, among them where its noise comes from."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import MeasuredNoise, RayNoise
from pathspace_graph.factors.sensor import SENSOR

from .parsing import MAX_HEADER_BYTES, MAX_NOISE, parse_toml, read_text, shown

FORMAT: Final = "pathspace-log/1"
POSITIVE: Final = math.ulp(0.0)
STATED: Final = "stated"
UNSTATED: Final = ("measured", "assumed")  # measured, or assumed where the drive shows too little
MEASURED: Final = "noise.measured"  # section, whose entries have so many numbers of at least so much
_ODOMETRY: Final = {"odometry": (3, 0.0), "drift": (3, 0.0), "interval": (1, POSITIVE)}
_SECONDS: Final = {"seconds": (1, 0.0)}
_RAYS: Final = {"along": (4, 0.0), "across": (4, 0.0)}
_DETECTIONS: Final = {
    **_RAYS,
    **{"count": (1, 1.0), "period": (1, POSITIVE), "per_cycle": (1, POSITIVE)},
    **dict.fromkeys(SENSOR, (2, -MAX_NOISE)),
}
_BEND: Final = {"range_bend": (1, -MAX_NOISE)}  # beside these where ranges bend


class Header:
    """A header as it was read; whatever is wrong with an entry is an InputError that names it."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._content = parse_toml(read_text(file, most=MAX_HEADER_BYTES), file)
        if self._content.get("format") != FORMAT:
            found = shown(self._content.get("format"))
            raise InputError(file, f'expected format = "{FORMAT}", found {found}')

    def section(self, path: str) -> dict[str, Any]:
        """Return the section of a dotted name, which is empty where there is none."""
        section = self._content
        for name in path.split("."):
            section = section.get(name, {})
            if not isinstance(section, dict):
                raise InputError(self.file, f"expected a section [{path}], found {shown(section)}")
        return section

    def numbers(self, path: str, name: str, count: int = 1, least: float = -MAX_NOISE) -> Array:
        """Return an entry of `count` numbers (count,), each from `least` to MAX_NOISE."""
        value = self.section(path).get(name)
        values = value if isinstance(value, list) else [value]
        if len(values) != count or not all(_is_number(one, least) for one in values):
            bound = {-MAX_NOISE: "", POSITIVE: "positive "}.get(least)
            what = f"{count} {bound or ''}number{'s' if count > 1 else ''}"
            what += f" of at least {least:g}" if bound is None else ""
            raise InputError(self.file, f"expected {what} as [{path}] {name}, found {shown(value)}")
        return np.array(values, dtype=float)

    def word(self, path: str, name: str, known: tuple[str, ...]) -> Any:
        """Return an entry that is one of the known words, or None where there is none."""
        value = self.section(path).get(name)
        if value is None or value in known:
            return value
        quoted = [f'"{word}"' for word in known]
        expected = f"expected {', '.join(quoted[:-1])} or {quoted[-1]} as [{path}] {name}"
        raise InputError(self.file, f"{expected}, found {shown(value)}")

    def noise(self) -> dict[str, Any]:
        """Return the fields of a log about its noise; one without the section has stated it."""
        found: dict[str, Any] = {}
        for name in ("odometry", "detections"):
            word = self.word("noise", name, (STATED, *UNSTATED))
            found[f"{name}_stated"] = word in (None, STATED)
        return found | {"measured": self._measured() if "measured" in self.section("noise") else None}

    def _measured(self) -> MeasuredNoise:
        entries = _ODOMETRY | (_DETECTIONS if "along" in self.section(MEASURED) else {}) | _SECONDS
        entries |= _BEND if "range_bend" in self.section(MEASURED) else {}
        values = {name: self.numbers(MEASURED, name, *expected) for name, expected in entries.items()}
        noisy = values["odometry"] + values["drift"] > 0.0
        self._require(noisy, "a twist with some noise as odometry or drift")
        fields: dict[str, Any] = {name: values.pop(name) for name in ("odometry", "drift")}
        if "along" in values:
            for name in _RAYS:
                near, growth, share, time = values.pop(name)
                good = near + growth > 0.0 and share <= 1.0 and time > 0.0
                self._require(good, f"some noise, a share of at most 1 and a positive time as {name}")
                fields[name] = RayNoise(np.array([near, growth]), float(share), float(time))
            sensor, sigma = np.array([values.pop(name) for name in SENSOR]).T
            self._require(sigma > 0.0, "a positive sigma as the second number of each error of the sensor")
            fields |= {"sensor": sensor, "sensor_sigma": sigma}
            self._require(values["count"] % 1.0 == 0.0, "a whole number as count")
            fields["count"] = int(values.pop("count").item())
        return MeasuredNoise(**fields | {name: value.item() for name, value in values.items()})

    def _require(self, good: Any, expected: str) -> None:
        if not np.all(good):
            raise InputError(self.file, f"[{MEASURED}]: expected {expected}")


def _is_number(value: object, least: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= MAX_NOISE


def to_toml(sections: Mapping[str, Mapping[str, Any]]) -> str:
    lines = [f'format = "{FORMAT}"']
    for name, entries in sections.items():
        lines += ["", f"[{name}]"]
        lines += [f"{key} = {toml_text(value)}" for key, value in entries.items() if value is not None]
    return "\n".join(lines) + "\n"


def toml_text(value: Any) -> str:
    """Return a text, a number or a list of numbers as TOML."""
    if not isinstance(value, str):
        return repr(value)
    # a JSON string is a TOML string, but for the delete character
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def noise_sections(odometry: bool, detections: bool, measured: MeasuredNoise | None) -> dict[str, Any]:
    if odometry and detections and measured is None:
        return {}
    rays = measured is not None and measured.along is not None
    section = {
        "odometry": STATED if odometry else UNSTATED[measured is None],
        "detections": STATED if detections else UNSTATED[not rays],
    }
    if measured is None:
        return {"noise": section}
    errors = np.column_stack([measured.sensor, measured.sensor_sigma])
    values = vars(measured) | dict(zip(SENSOR, errors, strict=True))
    for name in _RAYS if rays else ():
        values[name] = [*values[name].sigma, values[name].share, values[name].time]
    entries = [*_ODOMETRY, *(_DETECTIONS if rays else ()), *_SECONDS, *(_BEND if measured.range_bend else ())]
    return {"noise": section, MEASURED: {name: np.asarray(values[name]).tolist() for name in entries}}
