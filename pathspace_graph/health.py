"""Health: how far an online estimate can be trusted, cycle by cycle, with a reason in plain words."""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from math import nan
from typing import ClassVar, Final

from pathspace_graph.copies import Copyable

from .labels import BOUNDARIES, NAMES
from .lengths import Length, Text

GOOD: Final = "good"
DEGRADED: Final = "degraded"
LOST: Final = "lost"
CONDITIONS: Final = (GOOD, DEGRADED, LOST)

# A coloured detection in the view of the curves is explained if it is in use, or lies on a closed curve of
# its colour farther along: in a hairpin the sensor sees the next stretch across the infield.
WINDOW: Final = 1.0  # age up to which detections are judged together (s)
MIN_OFFERED: Final = 12  # least number of detections that are judged, older ones if the window holds fewer
BLIND: Final = 2.0  # time without detections from which on the estimate is degraded (s)
SHARE_DEGRADED: Final = 0.8  # share of explained detections on a closed map, below which it is degraded
SHARE_LOST: Final = 0.55  # the same share below which the vehicle is lost
OPEN_DEGRADED: Final = 0.35  # the same on an open map, low since much of what is seen is not mapped yet
MAX_INNOVATION: Final = 1.2  # mean squared normalized innovation of a good estimate; one sigma is added
SIGMA_DEGRADED: Final = 1.0  # standard deviation of the position on a closed map, beyond which (m)
SIGMA_LOST: Final = 5.0  # the same beyond which the vehicle is lost (m)


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


class HealthMonitor(Copyable):
    """Judge of the newest cycles' evidence together."""

    def __init__(self) -> None:
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
        share = explained / offered if offered >= MIN_OFFERED else 1.0
        innovation = squares / used if used >= MIN_OFFERED else 0.0
        cones = max(used / len(self._recent), 1.0)  # cycles show the same ones, with the same errors
        most = MAX_INNOVATION * (1.0 + (2.0 / cones) ** 0.5)
        health = self._judge(evidence, share, innovation, most)
        return self._beside_gap(offered) if health == Health(GOOD) else health

    def _beside_gap(self, offered: int) -> Health:
        """Return the health where nothing is wrong, but the map may have a gap of a boundary."""
        unmapped = [sum(one.unmapped[label] for one in self._recent) for label in BOUNDARIES]
        most = (1.0 - SHARE_DEGRADED) * (offered + sum(unmapped))
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
        if offered < MIN_OFFERED / len(BOUNDARIES):
            return None
        return explained >= SHARE_DEGRADED * offered

    def _remember(self, evidence: Evidence) -> None:
        recent = self._recent
        recent.append(evidence)
        self._offered += evidence.offered
        if evidence.offered or evidence.rests or self._last_offered is None:
            self._last_offered = evidence.t
        while recent[0].t <= evidence.t - WINDOW:
            if self._offered - recent[0].offered < MIN_OFFERED:
                return
            self._offered -= recent.popleft().offered

    def _judge(self, newest: Evidence, share: float, innovation: float, most: float) -> Health:
        lost = SHARE_LOST if newest.closed else 0.0  # on an open map it goes on by dead reckoning
        degraded = SHARE_DEGRADED if newest.closed else OPEN_DEGRADED
        blind = newest.t - (newest.t if self._last_offered is None else self._last_offered)
        if newest.sigma > SIGMA_DEGRADED:
            uncertain = Text("the position is uncertain by {sigma:.2g} m", sigma=Length(newest.sigma))
            return Health(LOST if newest.sigma > SIGMA_LOST else DEGRADED, uncertain)
        if share < degraded:
            wrong = self._wrong_side() if share < lost and newest.closed else ""
            reason = wrong or f"{100 * share:.0f} % of the detections lie on the map"
            return Health(LOST if share < lost and not wrong else DEGRADED, reason)
        self._wrong = None
        if newest.odometry:
            return Health(DEGRADED, newest.odometry)
        if blind > BLIND:
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
