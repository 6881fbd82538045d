"""HTML of records for notebooks and pages: tables, health in time, and pictures."""

from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from functools import singledispatch
from html import escape
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.eval.metrics.measures import METRICS, health_of, measure, rows_by_lap, summarize
from pathspace_graph.health import CONDITIONS, stretches
from pathspace_graph.io.log import Log, Odometry, Truth
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import RunResult
from pathspace_graph.plausibility.judge import Hint
from pathspace_graph.settings.checked import Checked, leaves

from .drawing import GREEN, HEALTH_COLORS

UNITS: Final = {  # of the calibrations of a summary
    **{"scale": "-", "bias": "rad/s", "yaw": "rad", "lateral": "m", "latency": "s"},
    **{"range_scale": "-", "range_bias": "m"},
}


def table(rows: Iterable[Sequence[object]], header: Sequence[object] = ()) -> str:
    """HTML table of texts, which are escaped."""
    lines = [("th", header)] * bool(header) + [("td", row) for row in rows]
    cells = ("".join(f"<{tag}>{escape(str(cell))}</{tag}>" for cell in row) for tag, row in lines)
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


def sections(summary: Mapping[str, Any]) -> dict[str, str]:
    """HTML of what a summary (docs/formats.md) says, by title: facts, warnings, notices, calibration."""
    final, seconds = summary.get("final", {}), summary.get("seconds") or {}
    loop = "closed" if summary.get("closed") else "not closed"
    facts = [("estimator", summary.get("estimator", "")), ("laps", summary.get("lap_count", ""))]
    facts += [("loop", loop), ("size of the map", summary.get("size", ""))]
    for name in ("mean", "p99"):
        if seconds.get(name):
            facts.append((METRICS[f"ms_{name}"].heading, METRICS[f"ms_{name}"].text(1e3 * seconds[name])))
    for name, value in (*final.items(), ("ate", summary.get("ate"))):
        if name in METRICS and name != "size" and value is not None:
            facts.append((METRICS[name].heading, METRICS[name].text(value)))
    if "made" in summary:
        facts += [(name, str(summary["made"].get(name, ""))[:16]) for name in ("commit", "date")]
    found = {"Result": table(facts)}
    if lines := warnings(summary):
        found["Warnings"] = table([line] for line in lines)
    if events := summary.get("events"):
        found["Notices"] = table([(f"{one['t']:.1f}\N{NO-BREAK SPACE}s", notice(one)) for one in events])
    rows, known = [], summary.get("calibration", {})
    for name, unit in UNITS.items():
        if known.get(name) is not None:
            value, sigma = known[name], known[f"{name}_sigma"]
            rows.append((f"{name} [{unit}]", f"{value:.3g}", f"{sigma:.2g}", f"{value / sigma:+.1f}"))
    if rows:
        found["Calibration at the end"] = table(rows, ("", "value", "sigma", "by sigma"))
    if lines := summary.get("notes", []):
        found["Noise"] = table([line] for line in lines)
    return found


def warnings(summary: Mapping[str, Any]) -> list[str]:
    """Lines of a summary that question the result or the log."""
    lines = [f"hint: {Hint(**hint).line}" for hint in summary.get("hints", [])]
    for one in summary.get("crossings", []):
        where = f"at x = {one['x']:.1f} m, y = {one['y']:.1f} m"
        lines.append(f"the {one['boundary']} boundary lies across the driven path {where}")
    lines += [*summary.get("not_mapped", []), *summary.get("diagnosis", [])]
    if summary.get("converged") is False:
        lines.append("the batch has not converged")
    if summary.get("objection"):
        lines.append(f"not a map of the drive: {summary['objection']}")
    lines += [f"{name} is left out: {why}" for name, why in summary.get("left_out", {}).items()]
    return lines


def notice(event: Mapping[str, Any]) -> str:
    """Words of an event of a summary: its notice, and the jump where the map was replaced."""
    jump = event.get("jump")
    told = "" if jump is None else f"the map was replaced, the pose has jumped by {np.hypot(*jump[:2]):.2f} m"
    return "; ".join(filter(None, (event.get("notice", ""), told)))


def image(picture: Any) -> str:
    """HTML image of a `Picture`."""
    data = b64encode(picture._repr_png_()).decode()
    return f'<img style="max-width:700px;width:100%" src="data:image/png;base64,{data}">'


@singledispatch
def html(record: object) -> str:
    """HTML of a record: picture, tables, health in time, and warnings."""
    return f"<code>{escape(repr(record))}</code>"


@html.register(Map)
@html.register(Log)
def _(record: Map | Log) -> str:
    return image(record.plot()) + f"<p>{escape(repr(record))}</p>"


@html.register
def _(record: RunResult) -> str:
    ended = {name: getattr(record, name) for name in ("converged", "objection") if hasattr(record, name)}
    parts = (f"<h4>{title}</h4>{part}" for title, part in sections(summarize(record, None) | ended).items())
    bar, t, healths = "", record.trajectory_t.tolist(), [health_of(one) for one in record.cycles]
    if any(one.condition for one in healths):  # over the time, the reason of each stretch as its tooltip
        begin, whole, spans = t[0], max(t[-1] - t[0], 1e-9), ""
        for one in stretches(t, healths):
            left, width = 100.0 * (one.begin - begin) / whole, 100.0 * (one.end - one.begin) / whole
            place = f"left:{left:.2f}%;width:{max(width, 0.3):.2f}%;background:{HEALTH_COLORS[one.health]}"
            told = f"{one.begin - begin:.1f} to {one.end - begin:.1f} s: {one.health}, {one.reason}"
            spans += f'<div style="position:absolute;height:14px;{place}" title="{escape(told)}"></div>'
        shares = (
            f"{name} {sum(one.condition == name for one in healths) / len(t):.1%}" for name in CONDITIONS
        )
        bar = f'<div style="position:relative;height:14px;max-width:700px;background:{GREEN}">{spans}</div>'
        bar += f"<p>health over time: {', '.join(shares)} of cycles</p>"
    return image(record.plot()) + bar + "".join(parts)


@html.register
def _(record: Checked) -> str:
    usual = leaves(type(record)())
    rows = [(key, value, "" if value == usual[key] else usual[key]) for key, value in leaves(record).items()]
    return f"<h4>{type(record).__name__}</h4>{table(rows, ('setting', 'value', 'default, where changed'))}"


def metrics(result: RunResult, truth: Truth) -> pd.DataFrame:
    """Metrics of `ablate` (`eval.metrics.measures`) of a run: a row for each complete lap, by its number."""
    n = len(result.trajectory_t)
    odometry = Odometry(result.trajectory_t, np.zeros((n, 3)))  # of which metrics with truth need nothing
    log = Log(odometry, (), np.zeros(3), truth=truth, scale=result.scale)
    rows = rows_by_lap(measure(result, log))
    return pd.DataFrame(rows).set_index("lap").reindex(columns=[key for key in METRICS if key in rows[-1]])
