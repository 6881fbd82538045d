"""Health of an online estimate: good, degraded or lost in each cycle, with a reason."""

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from math import nan
from typing import Final

from pathspace_graph.copies import Copyable

from .labels import BOUNDARIES, NAMES

GOOD: Final = "good"
DEGRADED: Final = "degraded"
LOST: Final = "lost"
CONDITIONS: Final = (GOOD, DEGRADED, LOST)

# A coloured detection in view of the curves is explained if it is in use, or lies on a closed curve of its
# colour farther along: in a hairpin the sensor sees the next stretch across the infield.
WINDOW: Final = 1.0  # time over which detections are judged together (s)
MIN_OFFERED: Final = 12  # least number of judged detections, with older ones if necessary
BLIND: Final = 2.0  # longest time without detections of a good estimate (s)
SHARE_DEGRADED: Final = 0.8  # least share of explained detections of a good estimate on a closed map
SHARE_LOST: Final = 0.55  # share below which the vehicle is lost on a closed map
OPEN_DEGRADED: Final = 0.35  # least share on an open map, where much in view is not mapped yet
MAX_INNOVATION: Final = 1.2  # mean squared normalized innovation of a good estimate; one sigma is added
SIGMA_DEGRADED: Final = 1.0  # largest standard deviation of a good position on a closed map (m)
SIGMA_LOST: Final = 5.0  # standard deviation beyond which the vehicle is lost (m)


@dataclass(frozen=True)
class Health:
    """Health of the estimate in a cycle."""

    condition: str = ""  # good, degraded or lost; empty without a monitor
    reason: str = ""  # reason, if the condition is not good


@dataclass(frozen=True)
class Evidence:
    """Evidence of a cycle's detections on the estimate, before the update."""

    t: float  # stamp of the cycle (s)
    offered: int = 0  # coloured detections in the view of the curves
    explained: int = 0  # offered detections on a curve of their colour
    used: int = 0  # detections in use
    innovations: float = 0.0  # sum of squared normalized innovations of used detections
    closed: bool = False  # whether the map is closed
    sigma: float = nan  # standard deviation of the position in its worst direction, closed map (m)
    offered_by: tuple[int, int] = (0, 0)  # offered detections by label, closed map
    explained_by: tuple[int, int] = (0, 0)  # explained detections by label
    unmapped: tuple[int, int] = (0, 0)  # other coloured detections beside a gap, by label
    rests: bool = False  # whether the vehicle is at rest and needs no detections
    odometry: str = ""  # fault of the odometry since the previous cycle


class HealthMonitor(Copyable):
    """Health by the evidence of the newest cycles."""

    def __init__(self) -> None:
        self._recent: deque[Evidence] = deque()
        self._offered = 0  # offered detections of the recent cycles
        self._last_offered: float | None = None
        self._wrong: int | None = None  # wrong boundary, while it explains too few detections

    def restart(self) -> None:
        self._recent.clear()
        self._offered, self._last_offered, self._wrong = 0, None, None

    def update(self, evidence: Evidence) -> Health:
        if self._recent and self._recent[-1].closed != evidence.closed:
            self.restart()
        recent = self._recent
        recent.append(evidence)
        self._offered += evidence.offered
        if evidence.offered or evidence.rests or self._last_offered is None:
            self._last_offered = evidence.t
        while recent[0].t <= evidence.t - WINDOW and self._offered - recent[0].offered >= MIN_OFFERED:
            self._offered -= recent.popleft().offered
        offered, explained, used, squares = self._offered, 0, 0, 0.0
        for one in recent:
            explained, used, squares = explained + one.explained, used + one.used, squares + one.innovations
        share = explained / offered if offered >= MIN_OFFERED else 1.0
        innovation = squares / used if used >= MIN_OFFERED else 0.0
        cones = max(used / len(recent), 1.0)  # cycles repeat the errors of the same cones
        most = MAX_INNOVATION * (1.0 + (2.0 / cones) ** 0.5)
        health = self._judge(evidence, share, innovation, most)
        if health != Health(GOOD):
            return health
        unmapped = [*map(sum, zip(*[one.unmapped for one in recent], strict=True))]
        most = (1.0 - SHARE_DEGRADED) * (offered + sum(unmapped))
        names = [NAMES[label] for label in BOUNDARIES if unmapped[label] > most]  # beside a gap
        if len(names) == len(BOUNDARIES):
            return Health(DEGRADED, "no boundary is mapped here")
        return Health(DEGRADED, f"the {names[0]} boundary is not mapped here") if names else health

    def _wrong_side(self) -> str:
        """Name a wrong boundary, if the other one explains its detections, or was the last to do so."""
        holds = list[bool | None]()  # None with too few detections
        for label in BOUNDARIES:
            offered = sum(one.offered_by[label] for one in self._recent)
            explained = sum(one.explained_by[label] for one in self._recent)
            enough = offered >= MIN_OFFERED / len(BOUNDARIES)
            holds.append(explained >= SHARE_DEGRADED * offered if enough else None)
        if True in holds:
            self._wrong = 1 - holds.index(True)
        elif self._wrong is not None and holds[1 - self._wrong] is False:
            self._wrong = None
        return "" if self._wrong is None else f"the {NAMES[self._wrong]} boundary is not where the map has it"

    def _judge(self, newest: Evidence, share: float, innovation: float, most: float) -> Health:
        lost = SHARE_LOST if newest.closed else 0.0  # on an open map dead reckoning suffices
        degraded = SHARE_DEGRADED if newest.closed else OPEN_DEGRADED
        blind = newest.t - (newest.t if self._last_offered is None else self._last_offered)
        if newest.sigma > SIGMA_DEGRADED:
            uncertain = f"the position is uncertain by {newest.sigma:.2g} m"
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
    """Successive cycles of one condition that is not good."""

    health: str
    begin: float  # stamp of its first cycle (s)
    end: float  # stamp of its last cycle (s)
    reason: str  # reason of its first cycle


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
