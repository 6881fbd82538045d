"""`convert`: a ROS bag, CSV files or JSON lines as a log."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from pathspace_graph.console import note, progress, say
from pathspace_graph.convert.bag import read_bag
from pathspace_graph.convert.recording import Recording, rate, to_log, windowed
from pathspace_graph.convert.settings import LabelRule
from pathspace_graph.convert.text_files import read_csv, read_json_lines
from pathspace_graph.errors import InputError, PathspaceError
from pathspace_graph.front_end.front_end import measure_log
from pathspace_graph.io.files import check_target
from pathspace_graph.io.log import DETECTIONS_FILE, LOG_FILE, ODOMETRY_FILE, Log, write_log
from pathspace_graph.labels import NAMES
from pathspace_graph.lengths import scaled
from pathspace_graph.options.data import Convert
from pathspace_graph.plausibility.diagnosis import measured_line
from pathspace_graph.plausibility.hint import because
from pathspace_graph.plausibility.judge import hints
from pathspace_graph.scale import scale_of
from pathspace_graph.settings.mapper import MapperSettings

from .estimate import tell
from .outcome import Outcome
from .simulate import describe

SUFFIXES: Final = {"bag": (".bag", ".mcap", ".db3"), "jsonl": (".jsonl", ".json")}  # of records in a folder


def convert_command(options: Convert) -> Outcome:
    records = _records(options)
    if not records:
        _convert(options, options.source, options.out)
        return Outcome([options.out])
    written, refused = list[Path](), list[str]()
    for record in records:
        say(f"{record}:")
        try:
            _convert(options, record, options.out / record.stem)
            written.append(options.out / record.stem)
        except PathspaceError as error:
            refused.append(str(error))
    if refused:
        some = f"{len(refused)} of {len(records)} records were refused"
        raise PathspaceError(f"{some}: {'; '.join(refused)}")
    return Outcome(written)


def _records(options: Convert) -> list[Path]:
    """Records in a folder of several; none where the source is a record itself."""
    folder = options.source
    if not folder.is_dir() or (folder / "metadata.yaml").exists():
        return []
    if options.kind == "csv":
        file = options.topics.odometry or ODOMETRY_FILE
        return [] if (folder / file).exists() else sorted(one.parent for one in folder.glob(f"*/{file}"))
    known = [one for one in folder.iterdir() if one.suffix in SUFFIXES.get(options.kind, ())]
    bags = [one.parent for one in folder.glob("*/metadata.yaml")] if options.kind == "bag" else []
    return sorted({*known, *bags})


def _convert(options: Convert, source: Path, out: Path) -> None:
    check_target(out, LOG_FILE, force=options.force)
    rule = LabelRule(options.labels, options.label_field)
    with progress("converting"):
        record = windowed(_read(options, source, rule), options.window, source)
        recorded = to_log(record, options.frames, options.noise, source, options.window.spacing)
        log = with_measured_noise(recorded)
        write_checked(log, out, source, force=options.force)
    report(record.notes, rule, log)
    tell(hints(log))


def _read(options: Convert, source: Path, rule: LabelRule) -> Recording:
    if options.kind == "jsonl":
        return read_json_lines(source, rule)
    if options.kind == "csv":
        files = options.topics.odometry or ODOMETRY_FILE, options.topics.detections or DETECTIONS_FILE
        return read_csv(source / files[0], source / files[1], rule, options.columns, options.units)
    return read_bag(source, options.topics, rule, mounted=options.frames.mounting is not None)


def with_measured_noise(log: Log) -> Log:
    """Measure the noise of a log where it is not stated."""
    if log.odometry_stated and log.detections_stated:
        return log
    scale, settings = scale_of(log), MapperSettings(kind=log.sensor.kind)
    measured = scaled(measure_log(scaled(log, 1.0 / scale), settings), scale)
    if measured is None:
        return log
    sigma = log.odometry_sigma if log.odometry_stated else measured.twist_sigma
    log = replace(log, measured=measured, odometry_sigma=sigma)
    if log.detections_stated:
        return log
    cycles = []
    for cycle in log.cycles:
        covariances = measured.covariances(cycle.points_vehicle, inflated=False)
        cycles.append(cycle if covariances is None else replace(cycle, covariances=covariances))
    return replace(log, cycles=tuple(cycles))


def write_checked(log: Log, out: Path, source: Path, *, force: bool) -> None:
    """Write a log; InputError of its source where reading it would fail."""
    try:
        write_log(log, out, check=True, force=force)
    except InputError as error:
        where = f"{error.file.name}, row {error.row}" if error.row else error.file.name
        likely = because(hints(log))
        why = f"{error.message}; {likely}" if likely else error.message
        raise InputError(source, f"its log would be refused ({where}): {why}") from None


def report(notes: Counter[str], rule: LabelRule, log: Log) -> None:
    """Print the meaning of labels, what was dropped or assumed and how often, and a summary of the log."""
    say(*(f"{count} {text}" for text, count in notes.items() if count))
    measured = [] if log.measured is None else [measured_line(log.measured, scale_of(log))]
    labels = [rule.summary()] if rule.met else []
    if hint := rule.hint():
        note(f"hint: {hint}")
    say(*labels, outline(log), *measured, describe(log))


def outline(log: Log) -> str:
    """One line about the log: rates, speeds, ranges and labels."""
    twists, seconds = log.odometry.twist, float(np.ptp(log.odometry.t))
    ranges = np.concatenate([np.hypot(*cycle.points_vehicle.T) for cycle in log.cycles])
    labels = np.bincount(np.concatenate([cycle.labels for cycle in log.cycles]), minlength=len(NAMES))
    counted = ", ".join(
        f"{count} {name}" for name, count in zip(NAMES, labels.tolist(), strict=True) if count
    )
    return (
        f"odometry at {rate(len(twists), seconds)}, up to {np.hypot(*twists[:, :2].T).max():.3g} m/s and "
        f"{np.abs(twists[:, 2]).max():.3g} rad/s; detections at {rate(len(log.cycles), seconds)}, "
        f"{ranges.min():.3g} m to {ranges.max():.3g} m away: {counted}"
    )
