"""`convert`: a ROS bag, CSV files or JSON lines as a log."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from pathspace_graph.console import progress, say
from pathspace_graph.convert.bag import read_bag
from pathspace_graph.convert.recording import rate, to_log, windowed
from pathspace_graph.convert.settings import LabelRule
from pathspace_graph.convert.text_files import read_csv, read_json_lines
from pathspace_graph.errors import InputError, PathspaceError, SettingsError
from pathspace_graph.front_end.front_end import seen_cycles
from pathspace_graph.front_end.gate import check_usable
from pathspace_graph.front_end.noise import measure_noise
from pathspace_graph.io.files import check_target
from pathspace_graph.io.log import LOG_FILE, ODOMETRY_FILE, Log, Odometry
from pathspace_graph.io.log_files import write_log
from pathspace_graph.labels import NAMES
from pathspace_graph.lengths import scaled
from pathspace_graph.options.data import Convert
from pathspace_graph.plausibility.diagnosis import measured_line
from pathspace_graph.plausibility.judge import because, hints
from pathspace_graph.settings.mapper import LimitSettings, MapperSettings

from .simulate import Outcome, describe, tell

OF_KIND: Final = {  # kinds of records that take an option; any other option is for all of them
    **dict.fromkeys(("odometry", "detections"), ("bag", "csv")),
    **dict.fromkeys(("imu", "wheelbase", "definition", "received", "namespaces", "label_field"), ("bag",)),
    **dict.fromkeys(("columns", "units"), ("csv",)),
}


def convert_command(options: Convert) -> Outcome:
    for name, kinds in OF_KIND.items():
        given: Any = options if hasattr(options, name) else options.topics
        if options.kind not in kinds and getattr(given, name) != getattr(type(given), name):
            expected = f"expected --from {' or '.join(kinds)}"
            raise SettingsError(f"--{name.replace('_', '-')}: {expected}, found {options.kind}")
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
    suffixes = {"bag": (".bag", ".mcap", ".db3"), "jsonl": (".jsonl", ".json")}[options.kind]
    known = [one for one in folder.iterdir() if one.suffix in suffixes]
    bags = [one.parent for one in folder.glob("*/metadata.yaml")] if options.kind == "bag" else []
    return sorted({*known, *bags})


def _convert(options: Convert, source: Path, out: Path) -> None:
    """Convert a record and report it; InputError of the source where an estimator could not use its log."""
    check_target(out, LOG_FILE, force=options.force)
    rule = LabelRule(options.labels, options.label_field)
    with progress("converting"):
        if options.kind == "csv":
            read = read_csv(source, options.topics, rule, options.columns, options.units)
        elif options.kind == "jsonl":
            read = read_json_lines(source, options.topics, rule)
        else:
            read = read_bag(source, options.topics, rule, mounted=options.frames.mounting is not None)
        record = windowed(read, options.window, source)
        recorded = to_log(record, options.frames, options.noise, source, options.window.spacing)
        log = with_measured_noise(replace(recorded, scale=options.scale), record.parts)
        try:
            check_usable(log, out, LimitSettings())
            write_log(log, out, check=True, force=options.force)
        except InputError as error:  # an estimator could not use it
            where = f"{error.file.name}, row {error.row}" if error.row else error.file.name
            likely = because(hints(log))
            why = f"{error.message}; {likely}" if likely else error.message
            part = "--start and --end take a part of the record"
            raise InputError(source, f"its log would be refused ({where}): {why}; {part}") from None
    # what was dropped or assumed and how often, labels, rates, speeds, ranges and the length
    twists, seconds = log.odometry.twist, float(np.ptp(log.odometry.t))
    ranges = np.concatenate([np.hypot(*cycle.points_vehicle.T) for cycle in log.cycles])
    labels = np.bincount(np.concatenate([cycle.labels for cycle in log.cycles]), minlength=len(NAMES))
    counted = [f"{count} {name}" for name, count in zip(NAMES, labels.tolist(), strict=True) if count]
    measured = [] if log.measured is None else [measured_line(scaled(log.measured, 1.0 / log.scale))]
    say(
        *(f"{count} {text}" for text, count in record.notes.items() if count),
        *([rule.summary()] if rule.met else []),
        f"odometry at {rate(len(twists), seconds)}, up to {np.hypot(*twists[:, :2].T).max():.3g} m/s and "
        f"{np.abs(twists[:, 2]).max():.3g} rad/s; detections at {rate(len(log.cycles), seconds)}, "
        f"{ranges.min():.3g} m to {ranges.max():.3g} m away: {', '.join(counted)}",
        *measured,
        describe(log),
    )
    tell(hints(log))


def with_measured_noise(log: Log, parts: int = 1) -> Log:
    """Measure the noise of a log where it is not stated.

    Of interpolated twists, `parts` of a sample, the white noise is that of the samples: each part has it
    `sqrt(parts)` times, so that the parts of a sample move the vehicle as uncertainly as the sample held.
    """
    if log.odometry_stated:
        log = replace(log, odometry_sigma=log.odometry_sigma * np.sqrt(parts))
    if log.odometry_stated and log.detections_stated:
        return log
    settings = MapperSettings(kind=log.sensor.kind)
    at_one = log.at_scale_one()
    samples = Odometry(at_one.odometry.t[::parts], at_one.odometry.twist[::parts])
    measured = measure_noise(seen_cycles(at_one, settings), samples, of_lines=settings.kind == "line")
    if measured is None:
        return log
    white = measured.odometry * np.sqrt(parts)
    measured = scaled(replace(measured, odometry=white, interval=measured.interval / parts), log.scale)
    log = replace(log, measured=measured)
    if not log.odometry_stated:
        sigma = np.maximum(measured.odometry, 1e-6)  # a vy that is always 0 has none, and a header wants some
        log = replace(log, odometry_sigma=sigma, odometry_drift=measured.drift)
    if log.detections_stated:
        return log
    return log.with_covariances(partial(measured.covariances, inflated=False))
