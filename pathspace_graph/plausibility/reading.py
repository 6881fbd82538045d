"""Logs are read together with the hints about them; where one is refused, its likely cause is told."""

from collections import Counter
from pathlib import Path
from typing import Final

import numpy as np

from pathspace_graph.errors import InputError
from pathspace_graph.front_end.gate import read_usable_log
from pathspace_graph.io.log import DETECTIONS_FILE, ODOMETRY_FILE, Log, Odometry, covariances_of, cycles_of
from pathspace_graph.io.parsing import Table, read_table, shown
from pathspace_graph.labels import UNKNOWN, label_from_name
from pathspace_graph.settings.online import LimitSettings

from .hint import Hint, because, told
from .judge import hints

MOST: Final = 1e20  # largest number that is read, to say what it means
NO_LABEL: Final = frozenset({"unknown", "", "none", "nan", "null"})  # words for no label
SHOWN_WORDS: Final = 3  # most foreign labels that are shown


def read_plausible_log(folder: Path, limits: LimitSettings) -> tuple[Log, list[Hint]]:
    """Read and judge a log; an InputError names file, row, what was expected, and the likely cause."""
    try:
        log = read_usable_log(folder, limits)
    except InputError as error:
        of_data = error.file.name in (ODOMETRY_FILE, DETECTIONS_FILE)
        causes = because(refused_hints(folder)) if of_data else ""
        if not causes:
            raise
        raise InputError(error.file, f"{error.message}; {causes}", error.row) from error
    return log, hints(log) + _foreign_labels(folder, log)


def refused_hints(folder: Path) -> list[Hint]:
    """Return the hints about a log that was refused; there are none where it cannot even be parsed."""
    try:
        odometry = read_table(folder / ODOMETRY_FILE, ("t", "vx", "vy", "wz"))
        detections = read_table(folder / DETECTIONS_FILE, ("t", "x", "y", "label", "xx", "xy", "yy"))
        return hints(_unchecked(odometry, detections))
    except InputError:
        return []


def _unchecked(odometry: Table, detections: Table) -> Log:
    twists = Odometry(odometry.numbers("t", MOST), odometry.stack(("vx", "vy", "wz"), MOST))
    stamps, points = detections.numbers("t", MOST), detections.stack(("x", "y"), MOST)
    covariances = covariances_of(*(detections.numbers(name, MOST) for name in ("xx", "xy", "yy")))
    labels = np.array([label_from_name(name) for name in detections.columns["label"]], dtype=int)
    cycles = cycles_of(stamps, points, covariances, labels)
    return Log(twists, cycles, np.ones(3), odometry_stated=False, detections_stated=False)


def _foreign_labels(folder: Path, log: Log) -> list[Hint]:
    if not log.cycles or any((cycle.labels != UNKNOWN).any() for cycle in log.cycles):
        return []
    words = Counter(read_table(folder / DETECTIONS_FILE, ("label",)).columns["label"])
    foreign = [word for word, _ in words.most_common() if word.strip().lower() not in NO_LABEL]
    if not foreign:
        return []
    return [told("foreign labels", words=", ".join(shown(word) for word in foreign[:SHOWN_WORDS]))]
