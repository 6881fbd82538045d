"""The suite of faults: a study whose noises are single faults, `fault: strength`, each beside a clean run."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.errors import SettingsError, check_name
from pathspace_graph.eval.metrics.metric import METRICS, UNKNOWN
from pathspace_graph.plausibility.diagnosis import LIMIT

from .frame import RUN, last_laps
from .study import Study, find_study, read_study
from .tables import TextTable, group_starts

SUITE: Final = Path("faults")
"""Name of the shipped study that is the suite."""
CLEAN: Final = "clean"
"""Name of the noise without a fault, which every other one is compared with."""
Values = Mapping[str, Any]
"""Values of an outcome by name."""
_WORST: Final = ("error_max", "error_end", "astray_time", "astray_way")
_MEASURED: Final = (
    *("rmse", "size", "missed", "closed_at_end", "lost_at_end", "told_degraded", "told_lost", *_WORST),
)
_NAME: Final = re.compile(r"(?P<kind>.+): (?P<strength>(?P<value>[-+.\d]+)(?: (?P<unit>\S+))?)")


# --- the suite -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fault:
    """A fault of a kind and a strength."""

    kind: str
    strength: str
    """Strength as it is written, a number and a unit."""
    value: float
    unit: str


def fault_of(noise: str) -> Fault:
    """Return the fault of a noise such as `latency: 20 ms`; SettingsError for any other name."""
    if noise == CLEAN:
        return Fault(CLEAN, "", 0.0, "")
    match = _NAME.fullmatch(noise)
    try:
        value = float(match["value"] if match else "")
    except ValueError as error:
        raise SettingsError(f"noise: expected a name such as 'latency: 20 ms', found '{noise}'") from error
    assert match is not None
    return Fault(match["kind"], match["strength"], value, match["unit"] or "")


def suite() -> Study:
    return read_study(find_study(SUITE))


def by_kind(study: Study) -> list[list[str]]:
    """Return the noises of each kind of fault, in ascending strength."""
    return [list(noises) for _, noises in groupby(study.noise, lambda noise: fault_of(noise).kind)]


def kinds(study: Study) -> list[str]:
    return [fault_of(noises[0]).kind for noises in by_kind(study) if noises != [CLEAN]]


def only(study: Study, wanted: Sequence[str]) -> Study:
    """Return the suite with the clean run and the faults of these kinds; all of them where none is named."""
    for kind in wanted:
        check_name(kind, kinds(study), "--only: expected a known fault")
    keep = {CLEAN, *(wanted or kinds(study))}
    return _with(study, [noise for noise in study.noise if fault_of(noise).kind in keep])


def strongest(study: Study) -> Study:
    """Return the suite with the clean run and each fault at the last of its strengths."""
    return _with(study, [noises[-1] for noises in by_kind(study)])


def of_middle_strength(study: Study) -> Study:
    """Return the suite with the clean run and each fault at the middle one of its strengths."""
    return _with(study, [noises[len(noises) // 2] for noises in by_kind(study)])


def _with(study: Study, noises: Sequence[str]) -> Study:
    return replace(study, noise={noise: study.noise[noise] for noise in noises})


# --- outcomes --------------------------------------------------------------------------------------------


def outcomes(study: Study, frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Return plain values of every noise of a suite, in its order, at the end of the last lap.

    `runs` that finished count, `failed` ones don't. What is not known is NaN.
    """
    runs = beside_clean(frame)
    failures = frame[frame["failure"] != ""].groupby("noise").size()
    return [
        _outcome(fault_of(noise), runs[runs["noise"] == noise], int(failures.get(noise, 0)))
        for noise in study.noise
    ]


def _outcome(fault: Fault, runs: pd.DataFrame, failed: int) -> dict[str, Any]:
    ratios = runs["ratio"].dropna()
    sigmas = {key: float(runs[key].astype(float).mean()) for key in runs if key.endswith("_by_prior")}
    titles = {key: METRICS[key].title.removesuffix(" by its prior's sigma") for key in sigmas}
    return {
        "fault": fault.kind,
        "strength": fault.value,
        "unit": fault.unit,
        "runs": len(runs),
        "failed": failed,
        "with_map": len(ratios),
        "ratio_mean": float(ratios.mean()),
        "ratio_min": float(ratios.min()),
        "ratio_max": float(ratios.max()),
        "size_ratio": float(runs["size_ratio"].mean()),
        "missed": float(runs["missed"].mean()),
        "closed": int((runs["closed_at_end"] == 1.0).sum()),
        "lost": int((runs["lost_at_end"] == 1.0).sum()),
        **{name: float(runs[name].max()) for name in _WORST},
        "told": int(runs["told"].sum()),
        "told_degraded": float(runs["told_degraded"].mean()),
        "told_lost": float(runs["told_lost"].mean()),
        "calibration": {titles[key]: value for key, value in sigmas.items() if abs(value) > LIMIT},
        "said": dict(Counter(text for text in runs["said"] if text).most_common()),
    }


def beside_clean(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the last laps of the runs that finished, beside the clean run of the same track and seed.

    `ratio` of the rmse and `size_ratio` are to those of that run, NaN where either has no map; `told` is
    whether anything was said.
    """
    last = last_laps(frame)
    last = last.reindex(columns=[*dict.fromkeys([*last, *_MEASURED])]).astype(dict.fromkeys(_MEASURED, float))
    clean = last[last["noise"] == CLEAN].set_index([*RUN])
    own = pd.MultiIndex.from_frame(last[[*RUN]])
    for name, ratio in (("rmse", "ratio"), ("size", "size_ratio")):
        reference = clean[name].where(clean[name] > 0.0).reindex(own)
        last[ratio] = last[name] / reference.to_numpy()
    return last.assign(told=(last["said"] != "") | (last["told_lost"] > 0.0))


def fault_table(study: Study, found: Sequence[Values]) -> TextTable:
    """Return a row for each fault and strength, without columns that no run knows anything of."""
    columns = {title: tuple(map(text, found)) for title, text in COLUMNS.items()}
    kept = {title: texts for title, texts in columns.items() if not {"", UNKNOWN}.issuperset(texts)}
    title = (
        f"{study.name}: {study.question} {len(study.tracks)} tracks, {len(study.seeds)} seeds, "
        f"{study.laps} laps, {', '.join(study.estimators)}. The rmse is the map's at the end by that "
        "of the clean run on the same track and with the same seed, as its mean and its range. "
        "Lost means more than 5 m off in the last second."
    )
    faults = map(fault_of, study.noise)
    rows = tuple((f.kind, f.strength, *texts) for f, *texts in zip(faults, *kept.values(), strict=False))
    return TextTable(title, ("fault", "strength", *kept), rows, group_starts(rows), names=2)


def _ratio(values: Values) -> str:
    ratio, with_map, runs = values["ratio_mean"], values["with_map"], values["runs"]
    partly = "" if with_map == runs else f" ({with_map} of {runs})"
    return "no map" if np.isnan(ratio) else f"{ratio:.2f}{partly}"


def _closed(values: Values) -> str:
    failed = f", {values['failed']} failed" if values["failed"] else ""
    return f"{values['closed']} of {values['runs']}{failed}"


def _said(values: Values) -> str:
    """Return how many runs said what, shortened to 60 characters; the JSON file has all of it."""
    short = {text: text if len(text) <= 60 else f"{text[:60].rstrip()} …" for text in values["said"]}
    said = (f"{number} of {values['runs']}: {short[text]}" for text, number in values["said"].items())
    return "; ".join(said) or "nothing"


def _form(form: str, *names: str, factor: float = 1.0) -> Callable[[Values], str]:
    """Return a function that formats some of the values."""
    return lambda values: (
        UNKNOWN if np.isnan(values[names[0]]) else form.format(*(factor * values[name] for name in names))
    )


COLUMNS: Final[Mapping[str, Callable[[Values], str]]] = {
    "rmse by clean": _ratio,
    "range": _form("{:.1f} to {:.1f}", "ratio_min", "ratio_max"),
    "size by clean": _form("{:.2f}", "size_ratio"),
    "missed [%]": _form("{:.1f}", "missed", factor=100.0),
    "closed": _closed,
    "lost at the end": lambda values: f"{values['lost']} of {values['runs']}",
    "largest error [m]": _form("{:.1f}", "error_max"),
    "over 1 m off after closing [s, m]": _form("{:.1f}, {:.1f}", "astray_time", "astray_way"),
    "calibration by its prior's sigma": lambda values: ", ".join(
        f"{name} {value:+.1f}" for name, value in values["calibration"].items()
    ),
    "called degraded, lost [% of cycles]": _form(
        "{:.1f}, {:.1f}", "told_degraded", "told_lost", factor=100.0
    ),
    "said": _said,
}
"""Columns of the table after the fault and its strength, each made of the values of an outcome."""
