"""The suite of faults: a study whose noises are single faults, `fault: strength`, each beside a clean run."""

import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any, Final, NamedTuple

import pandas as pd

from pathspace_graph.errors import SettingsError, check_name
from pathspace_graph.eval.metrics.measures import METRICS, Metric
from pathspace_graph.io.files import write_json
from pathspace_graph.plausibility.diagnosis import PRIOR_LIMIT

from .study import Study, find_study, read_study_file
from .tables import RUN, TextTable, last_laps, write_csv, write_results

CLEAN: Final = "clean"  # name of the noise without a fault, which every other one is compared with
FIGURES: Final = {  # of an outcome: metric, ratio or sign of the runs, how it is taken over them, its column
    "with_map": ("ratio", "count", None),
    "ratio_mean": ("ratio", "mean", Metric("ratio_mean", "rmse by clean", digits=2)),
    "ratio_min": ("ratio", "min", Metric("ratio_min", "least", digits=2)),
    "ratio_max": ("ratio", "max", Metric("ratio_max", "most", digits=2)),
    "size_ratio": ("size_ratio", "mean", Metric("size_ratio", "size by clean", digits=2)),
    "missed": ("missed", "mean", Metric("missed", "missed", "%", 1)),
    "closed": ("closed_at_end", "sum", Metric("closed", "closed", "%", 0)),
    "lost": ("lost_at_end", "sum", Metric("lost", "lost at the end", "%", 0)),
    "error_max": ("error_max", "max", Metric("error_max", "largest error", "m", 1)),
    "reported_degraded": ("reported_degraded", "mean", Metric("degraded", "called degraded", "%", 1)),
    "reported_lost": ("reported_lost", "mean", Metric("called_lost", "called lost", "%", 1)),
    "reported": ("reported", "sum", Metric("reported", "reported", "%", 0)),
    "divergence_time": ("divergence_time", "max", Metric("time", "longest time over 1 m off", "s", 1)),
    "divergence_distance": ("divergence_distance", "max", Metric("way", "longest way over 1 m off", "m", 0)),
}
COUNTS: Final = ("with_map", "closed", "lost", "reported")  # which the table has as shares


class Fault(NamedTuple):
    """A fault of a kind, and its strength."""

    kind: str
    value: float
    unit: str


def fault_of(noise: str) -> Fault:
    """Return the fault of a noise such as `latency: 20 ms`; SettingsError for any other name."""
    if noise == CLEAN:
        return Fault(CLEAN, 0.0, "")
    match = re.fullmatch(r"(?P<kind>.+): (?P<value>[-+]?\d+(\.\d+)?)( (?P<unit>\S+))?", noise)
    if match is None:
        raise SettingsError(f"noise: expected a name such as 'latency: 20 ms', found '{noise}'")
    return Fault(match["kind"], float(match["value"]), match["unit"] or "")


def suite() -> Study:
    return read_study_file(find_study(Path("faults")))


def kinds(study: Study) -> list[str]:
    return [kind for kind in dict.fromkeys(fault_of(noise).kind for noise in study.noise) if kind != CLEAN]


def only(study: Study, wanted: Sequence[str]) -> Study:
    """Return the suite with the clean run and the faults of these kinds; all of them where none is named."""
    for kind in wanted:
        check_name(kind, kinds(study), "--only: expected a known fault")
    keep = {CLEAN, *(wanted or kinds(study))}
    return replace(study, noise={name: of for name, of in study.noise.items() if fault_of(name).kind in keep})


def at_strength(study: Study, share: float) -> Study:
    """Return the suite with one strength of each fault: the middle one at 0.5, the greatest at 1."""
    groups = ([*noises] for _, noises in groupby(study.noise, lambda noise: fault_of(noise).kind))
    chosen = [noises[min(int(share * len(noises)), len(noises) - 1)] for noises in groups]
    return replace(study, noise={noise: study.noise[noise] for noise in chosen})


# --- outcomes --------------------------------------------------------------------------------------------


def outcomes(study: Study, frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Return plain values of every noise of a suite at the end of the last lap; NaN is unknown."""
    every, failures = beside_clean(frame), frame.loc[frame["failure"] != "", "noise"].value_counts()
    found = []
    for noise in study.noise:
        fault, runs = fault_of(noise), every[every["noise"] == noise]
        values: dict[str, Any] = {"fault": fault.kind, "strength": fault.value, "unit": fault.unit}
        values |= {"runs": len(runs), "failed": int(failures.get(noise, 0))}
        values |= {name: float(runs[key].agg(how)) for name, (key, how, _) in FIGURES.items()}
        values |= {name: int(values[name]) for name in COUNTS}
        sigmas = {key: float(runs[key].astype(float).mean()) for key in runs if key.endswith("_by_prior")}
        titles = {key: METRICS[key].title.removesuffix(" by its prior's sigma") for key in sigmas}
        values["calibration"] = {titles[key]: v for key, v in sigmas.items() if abs(v) > PRIOR_LIMIT}
        values["notices"] = dict(Counter(text for text in runs["notices"] if text).most_common())
        found.append(values)
    return found


def beside_clean(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the last laps of the runs that finished, beside the clean run of the same track and seed.

    `ratio` (of rmse) and `size_ratio` are to that run, NaN without a map; `reported`: anything was said.
    """
    metrics = ["rmse", "size", *(key for key, *_ in FIGURES.values() if key in METRICS)]
    last = last_laps(frame)
    last = last.reindex(columns=[*dict.fromkeys([*last, *metrics])]).astype(dict.fromkeys(metrics, float))
    clean = last[last["noise"] == CLEAN].set_index([*RUN])
    own = pd.MultiIndex.from_frame(last[[*RUN]])
    for name, ratio in (("rmse", "ratio"), ("size", "size_ratio")):
        last[ratio] = last[name] / clean[name].where(clean[name] > 0.0).reindex(own).to_numpy()
    return last.assign(reported=(last["notices"] != "") | (last["reported_lost"] > 0.0))


def fault_table(study: Study, found: Sequence[dict[str, Any]], *, notices: bool = False) -> TextTable:
    """Return the cost of each fault relative to the clean run of its track, and how often it is reported.

    With `notices` it has what was said as well: calibrations far from their prior (sigmas), and notices.
    """
    rows = []
    for noise, values in zip(study.noise, found, strict=True):
        row = {"fault": noise, "runs": str(values["runs"]), "failed": str(values["failed"])}
        for name, (*_, column) in FIGURES.items():
            if column is not None:
                share = max(values["runs"], 1) if name in COUNTS else 1
                row[column.heading] = column.text(values[name] / share)
        if notices:
            far = (f"{name} {sigmas:+.1f}" for name, sigmas in values["calibration"].items())
            row["calibration by its prior's sigma"] = ", ".join(far)
            said = values["notices"].items()  # the JSON file has all of a text
            short = {text: text if len(text) <= 60 else f"{text[:60].rstrip()} …" for text, _ in said}
            counted = (f"{number} of {values['runs']}: {short[text]}" for text, number in said)
            row["notices"] = "; ".join(counted) or "nothing"
        rows.append(row)
    title = (
        f"{study.name}: {study.question} {len(study.tracks)} tracks, {len(study.seeds)} seeds, "
        f"{study.laps} laps, {', '.join(study.estimators)}. The rmse is the map's at the end by that "
        "of the clean run on the same track and with the same seed. Lost means more than 5 m off in the last "
        "second."
    )
    return TextTable(pd.DataFrame(rows), title)


def write_suite(study: Study, frame: pd.DataFrame, out: Path) -> str:
    """Write the results of every run, the table and the values; return the table's text."""
    faults = outcomes(study, frame)
    table = fault_table(study, faults, notices=True)
    write_results(frame, out)
    table.write(out, "faults", "txt", "md", "tex")
    about = {"estimator": study.estimators, "seeds": study.seeds, "laps": study.laps}
    write_json(out / "faults.json", {"format": "pathspace-faults/1", **about, "faults": faults}, indent=1)
    flat = pd.DataFrame(faults)
    for key in ("calibration", "notices"):  # as JSON texts
        flat[key] = [json.dumps(value, ensure_ascii=False) for value in flat[key]]
    write_csv(out / "faults.csv", flat)
    return table.text()
