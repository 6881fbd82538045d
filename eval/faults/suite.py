"""The suite is a study whose noises are single faults, named `fault: strength`, beside a clean run."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from pathspace_graph.errors import SettingsError, check_name
from pathspace_graph.eval.study.file import find_study, read_study
from pathspace_graph.eval.study.study import Study

SUITE: Final = Path("faults")
"""The suite is the shipped study of this name."""
CLEAN: Final = "clean"
"""The noise of this name has no fault, and every other one is compared with it."""
_NAME: Final = re.compile(r"(?P<kind>.+): (?P<strength>(?P<value>[-+.\d]+)(?: (?P<unit>\S+))?)")


@dataclass(frozen=True)
class Fault:
    """A fault has a kind and a strength."""

    kind: str
    """The fault is of this kind, in plain words; it is `clean` where there is no fault."""
    strength: str
    """This is its strength as it is written."""
    value: float
    """This is the number of the strength."""
    unit: str
    """The number has this unit; it is empty for counts."""

    @property
    def noise(self) -> str:
        """Returns the name of the fault's noise in the study."""
        return f"{self.kind}: {self.strength}" if self.strength else self.kind


def fault_of(noise: str) -> Fault:
    """Returns the fault of a noise such as `latency of detections: 20 ms`; SettingsError for any other
    name."""
    if noise == CLEAN:
        return Fault(CLEAN, "", 0.0, "")
    found = _NAME.fullmatch(noise)
    try:
        assert found is not None
        return Fault(found["kind"], found["strength"], float(found["value"]), found["unit"] or "")
    except (AssertionError, ValueError) as error:
        raise SettingsError(f"noise: expected a name such as 'latency: 20 ms', found '{noise}'") from error


def suite() -> Study:
    """Returns the suite that ships with the package."""
    return read_study(find_study(SUITE))


def kinds(study: Study) -> list[str]:
    """Returns the kinds of faults of a suite, in its order."""
    found = (fault_of(noise).kind for noise in study.noise)
    return [kind for kind in dict.fromkeys(found) if kind != CLEAN]


def only(study: Study, wanted: Sequence[str]) -> Study:
    """Returns the suite with the clean run and the faults of these kinds; all of them where none is named."""
    for kind in wanted:
        check_name(kind, kinds(study), "--only: expected a known fault")
    keep = {CLEAN, *(wanted or kinds(study))}
    return _with(study, [noise for noise in study.noise if fault_of(noise).kind in keep])


def strongest(study: Study) -> Study:
    """Returns the suite with the clean run and each fault at the last of its strengths."""
    return _with(study, list({fault_of(noise).kind: noise for noise in study.noise}.values()))


def _with(study: Study, noises: Sequence[str]) -> Study:
    return replace(study, noise={noise: study.noise[noise] for noise in noises})
