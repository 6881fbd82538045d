"""Health: how far an online estimate can be trusted, cycle by cycle, with a reason in plain words."""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from math import nan
from typing import ClassVar, Final

from pathspace_graph.settings.online import HealthSettings

from .labels import BOUNDARIES, NAMES
from .lengths import Length, Text

GOOD: Final = "good"
DEGRADED: Final = "degraded"
LOST: Final = "lost"
CONDITIONS: Final = (GOOD, DEGRADED, LOST)


@dataclass(frozen=True)
class Health:
    """How far the estimate of a cycle can be trusted."""

    LENGTHS: ClassVar = {"reason": 0}

    condition: str = ""  # good, degraded or lost; empty without a monitor
    reason: str = ""  # why the condition is not good


@dataclass(frozen=True)
class Evidence:
    """What a cycle's detections say about the estimate, before they change it."""

    t: float  # stamp of the cycle (s)
    offered: int = 0  # coloured detections in the view of the curves
    explained: int = 0  # those on a curve of their colour
    used: int = 0
    innovations: float = 0.0  # sum of squared normalized innovations of those in use
    closed: bool = False
    sigma: float = nan  # of the position in its worst direction on a closed map (m)
    offered_by: tuple[int, int] = (0, 0)  # offered detections, left and right, of a closed map
    explained_by: tuple[int, int] = (0, 0)  # explained ones
    unmapped: tuple[int, int] = (0, 0)  # other coloured ones beside a gap of a closed map
    rests: bool = False  # whether the vehicle stands, and needs no detections
    odometry: str = ""  # what is wrong with it since the cycle before


class HealthMonitor:
    """Judge of the newest cycles' evidence together."""

    def __init__(self, settings: HealthSettings | None = None) -> None:
        self.settings = settings or HealthSettings()
        self._recent: deque[Evidence] = deque()
        self._offered = 0  # by all the recent cycles together
        self._last_offered: float | None = None
        self._wrong: int | None = None  # this boundary is wrong, as long as it explains too little

    def restart(self) -> None:
        self._recent.clear()
        self._offered, self._last_offered, self._wrong = 0, None, None

    def update(self, evidence: Evidence) -> Health:
        if self._recent and self._recent[-1].closed != evidence.closed:
            self.restart()
        self._remember(evidence)
        offered, explained, used, squares = self._offered, 0, 0, 0.0
        for one in self._recent:
            explained, used, squares = explained + one.explained, used + one.used, squares + one.innovations
        share = explained / offered if offered >= self.settings.min_offered else 1.0
        innovation = squares / used if used >= self.settings.min_offered else 0.0
        cones = max(used / len(self._recent), 1.0)  # cycles show the same ones, with the same errors
        most = self.settings.innovation * (1.0 + (2.0 / cones) ** 0.5)
        health = self._judge(evidence, share, innovation, most)
        return self._beside_gap(offered) if health == Health(GOOD) else health

    def _beside_gap(self, offered: int) -> Health:
        """Return the health where nothing is wrong, but the map may have a gap of a boundary."""
        unmapped = [sum(one.unmapped[label] for one in self._recent) for label in BOUNDARIES]
        most = (1.0 - self.settings.share_degraded) * (offered + sum(unmapped))
        names = [NAMES[label] for label in BOUNDARIES if unmapped[label] > most]
        if len(names) == len(BOUNDARIES):
            return Health(DEGRADED, "no boundary is mapped here")
        return Health(DEGRADED, f"the {names[0]} boundary is not mapped here") if names else Health(GOOD)

    def _wrong_side(self) -> str:
        """Return which boundary is wrong, where the other one explains its detections or did so last."""
        holds = [self._holds(label) for label in BOUNDARIES]
        if True in holds:
            self._wrong = 1 - holds.index(True)
        elif self._wrong is not None and holds[1 - self._wrong] is False:
            self._wrong = None
        return "" if self._wrong is None else f"the {NAMES[self._wrong]} boundary is not where the map has it"

    def _holds(self, label: int) -> bool | None:
        offered = sum(one.offered_by[label] for one in self._recent)
        explained = sum(one.explained_by[label] for one in self._recent)
        if offered < self.settings.min_offered / len(BOUNDARIES):
            return None
        return explained >= self.settings.share_degraded * offered

    def _remember(self, evidence: Evidence) -> None:
        recent = self._recent
        recent.append(evidence)
        self._offered += evidence.offered
        if evidence.offered or evidence.rests or self._last_offered is None:
            self._last_offered = evidence.t
        while recent[0].t <= evidence.t - self.settings.window:
            if self._offered - recent[0].offered < self.settings.min_offered:
                return
            self._offered -= recent.popleft().offered

    def _judge(self, newest: Evidence, share: float, innovation: float, most: float) -> Health:
        settings = self.settings
        lost = settings.share_lost if newest.closed else 0.0  # on an open map it goes on by dead reckoning
        degraded = settings.share_degraded if newest.closed else settings.open_degraded
        blind = newest.t - (newest.t if self._last_offered is None else self._last_offered)
        if newest.sigma > settings.sigma_degraded:
            uncertain = Text("the position is uncertain by {sigma:.2g} m", sigma=Length(newest.sigma))
            return Health(LOST if newest.sigma > settings.sigma_lost else DEGRADED, uncertain)
        if share < degraded:
            wrong = self._wrong_side() if share < lost and newest.closed else ""
            reason = wrong or f"{100 * share:.0f} % of the detections lie on the map"
            return Health(LOST if share < lost and not wrong else DEGRADED, reason)
        self._wrong = None
        if newest.odometry:
            return Health(DEGRADED, newest.odometry)
        if blind > settings.blind:
            return Health(DEGRADED, f"no detection in view of the map for {blind:.1f} s")
        if innovation > most:
            sigmas = innovation**0.5
            return Health(DEGRADED, f"detections lie {sigmas:.1f} standard deviations beside the map")
        return Health(GOOD)


@dataclass(frozen=True)
class HealthStretch:
    """A run of cycles of one condition that is not good."""

    health: str
    begin: float  # stamp of its first cycle (s)
    end: float  # stamp of its last cycle (s)
    reason: str  # of its first cycle


def stretches(t: Sequence[float], healths: Sequence[Health]) -> list[HealthStretch]:
    found = []
    for condition, group in groupby(zip(t, healths, strict=True), key=lambda cycle: cycle[1].condition):
        cycles = list(group)
        if condition in (DEGRADED, LOST):
            found.append(HealthStretch(condition, cycles[0][0], cycles[-1][0], cycles[0][1].reason))
    return found


def counts(healths: Sequence[Health]) -> dict[str, int]:
    number = Counter(health.condition for health in healths)
    return {condition: number[condition] for condition in CONDITIONS}
