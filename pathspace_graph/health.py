"""Health: how far an online estimate can be trusted, cycle by cycle, with a reason in plain words."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from math import nan
from typing import Final

from .settings.health import HealthSettings

GOOD: Final = "good"
DEGRADED: Final = "degraded"
LOST: Final = "lost"
CONDITIONS: Final = (GOOD, DEGRADED, LOST)


@dataclass(frozen=True)
class Health:
    """Says how far the estimate of a cycle can be trusted."""

    condition: str = ""
    """The estimate is good, degraded or lost; this is empty for an estimator without a monitor."""
    reason: str = ""
    """This says why the condition is not good."""


@dataclass(frozen=True)
class Evidence:
    """Holds what a cycle's detections say about the estimate, before they change it."""

    t: float
    """This is the stamp of the cycle (s)."""
    offered: int = 0
    """This number of coloured detections lies in the view of the curves."""
    explained: int = 0
    """This number of them lies on a curve of its colour."""
    used: int = 0
    """This number of them is in use."""
    innovations: float = 0.0
    """This is the sum of squared normalized innovations of those in use."""
    closed: bool = False
    """This says whether the loop has closed."""
    sigma: float = nan
    """This is the standard deviation (m) of the position in its worst direction on a closed map, where it is
    known."""


class HealthMonitor:
    """Judges the evidence of the newest cycles together."""

    def __init__(self, settings: HealthSettings | None = None) -> None:
        self.settings = settings or HealthSettings()
        self._recent: deque[Evidence] = deque()
        self._last_offered: float | None = None

    def restart(self) -> None:
        """Forgets the evidence so far, because the map or the pose was replaced."""
        self._recent.clear()
        self._last_offered = None

    def update(self, evidence: Evidence) -> Health:
        """Returns the health at a cycle."""
        if self._recent and self._recent[-1].closed != evidence.closed:
            self.restart()
        self._remember(evidence)
        lost = self._why_lost(evidence)
        if lost:
            return Health(LOST, lost)
        degraded = self._why_degraded(evidence)
        return Health(DEGRADED, degraded) if degraded else Health(GOOD)

    def _remember(self, evidence: Evidence) -> None:
        """Adds the evidence of a cycle, and drops what is too old and not needed for `min_offered`."""
        recent, offered = self._recent, evidence.offered
        recent.append(evidence)
        if offered or self._last_offered is None:
            self._last_offered = evidence.t
        total = sum(one.offered for one in recent)
        while recent[0].t <= evidence.t - self.settings.window:
            if total - recent[0].offered < self.settings.min_offered:
                return
            total -= recent.popleft().offered

    def _why_lost(self, newest: Evidence) -> str:
        """Returns why the vehicle is lost, or an empty text."""
        limit = self.settings.share_lost if newest.closed else self.settings.open_lost
        if newest.sigma > self.settings.sigma_lost:
            return _uncertain(newest.sigma)
        return self._unexplained(limit)

    def _why_degraded(self, newest: Evidence) -> str:
        """Returns why the estimate is degraded, or an empty text."""
        settings, used = self.settings, sum(one.used for one in self._recent)
        squares = sum(one.innovations for one in self._recent)
        if newest.sigma > settings.sigma_degraded:
            return _uncertain(newest.sigma)
        if self._last_offered is not None and newest.t - self._last_offered > settings.blind:
            return f"no detection in view of the map for {newest.t - self._last_offered:.1f} s"
        if used >= settings.min_offered and squares > settings.innovation * used:
            return f"detections lie {(squares / used) ** 0.5:.1f} standard deviations beside the map"
        return self._unexplained(settings.share_degraded if newest.closed else settings.open_degraded)

    def _unexplained(self, limit: float) -> str:
        """Returns that less than a share of the detections is explained, if that is so."""
        offered = sum(one.offered for one in self._recent)
        explained = sum(one.explained for one in self._recent)
        if offered < self.settings.min_offered or explained >= limit * offered:
            return ""
        return f"{explained / offered:.0%} of the detections lie on the map".replace("%", " %")


def _uncertain(sigma: float) -> str:
    return f"the position is uncertain by {sigma:.1f} m"


# --- a whole run -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stretch:
    """A stretch is a run of cycles of one condition that is not good."""

    health: str
    """The cycles have this condition."""
    begin: float
    """This is the stamp of its first cycle (s)."""
    end: float
    """This is the stamp of its last cycle (s)."""
    reason: str
    """This is the reason that its first cycle gives."""


def stretches(t: Sequence[float], healths: Sequence[Health]) -> list[Stretch]:
    """Returns the stretches of a run that were not good, from the stamps and the health of its cycles."""
    found = []
    for condition, group in groupby(zip(t, healths, strict=True), key=lambda cycle: cycle[1].condition):
        cycles = list(group)
        if condition in (DEGRADED, LOST):
            found.append(Stretch(condition, cycles[0][0], cycles[-1][0], cycles[0][1].reason))
    return found


def counts(healths: Sequence[Health]) -> dict[str, int]:
    """Returns the number of cycles of each condition."""
    number = Counter(health.condition for health in healths)
    return {condition: number[condition] for condition in CONDITIONS}
