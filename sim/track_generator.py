"""Random tracks by the rules of Formula Student: straights, hairpins, slaloms, chicanes, no crossing."""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import scipy  # which imports its modules when they are used
from numpy.random import Generator
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.settings.checked import Checked

from .track import SMOOTHING, STEP, Track, along_polyline, arc_lengths, curvature, ring, unit

MAX_ATTEMPTS: Final = 500  # two in three keep the default rules; contradicting ones fail them all
CONE_GAPS: Final = 1.0, 5.0  # least and greatest distance of cones along a row (m)
STRAIGHT_RADIUS: Final = 150.0  # radius above which a stretch is straight (m)
HAIRPIN_DIAMETER: Final = 9.0  # least outside diameter of a corner (m)


@dataclass(frozen=True)
class TrackGeneratorSettings(Checked, group="generator"):
    """Rules that a generated track keeps."""

    lap_length: tuple[float, float] = (220.0, 400.0)
    """Least and greatest length of the centre line (m); the rules allow 200 to 500."""
    width: tuple[float, float] = (3.2, 4.2)
    """Least and greatest distance of the boundaries, constant along a track (m); the rules ask for 3."""
    cones: int = 200
    """Cones of both boundaries together, as nearly as the gaps allow."""
    corners: tuple[int, int] = (5, 9)
    """Least and greatest number of corners of the layout that the elements are put into."""
    hairpins: tuple[int, int] = (0, 3)
    """Least and greatest number of hairpins put into the layout, whose corners may be hairpins as well."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("lap_length", "width", "corners", "hairpins"):
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise SettingsError(f"generator.{name}: expected 0 <= least <= greatest, found {low, high}")
        if self.corners[0] < 3:
            raise SettingsError(f"generator.corners: expected at least 3, found {self.corners[0]}")
        if self.width[1] >= HAIRPIN_DIAMETER:
            raise SettingsError(
                f"generator.width: expected less than {HAIRPIN_DIAMETER:g}, found {self.width}"
            )
        if self.cones < (least := 2 * self.corners[0]):
            raise SettingsError(f"generator.cones: expected at least {least}, found {self.cones}")


def generate_track(rng: Generator, settings: TrackGeneratorSettings | None = None) -> Track:
    """Generate a random closed track that keeps the rules and starts on its longest straight."""
    settings = settings or TrackGeneratorSettings()
    for _ in range(MAX_ATTEMPTS):
        width = rng.uniform(*settings.width)
        layout = _layout(width, settings, rng)
        curve = None if layout is None else _curve(layout, rng)
        if curve is not None and _keeps_rules(curve, width, settings):
            return _with_cones(curve, width, settings, rng)
    raise SettingsError(f"generator: no track kept the rules in {MAX_ATTEMPTS} attempts: {settings}")


class _Layout(NamedTuple):
    """A polygon whose corners (n, 2) are to be rounded by arcs of radii (n,), in m."""

    corners: Array
    radii: Array


def _layout(width: float, settings: TrackGeneratorSettings, rng: Generator) -> _Layout | None:
    """Draw a star-shaped polygon with hairpins on some sides, or None where a corner cannot be rounded."""
    count = int(rng.integers(*settings.corners, endpoint=True))
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    distances = rng.uniform(0.35, 1.0, count)
    corners = (
        distances[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]) * [1.0, rng.uniform(0.6, 1.0)]
    )
    legs = rng.uniform(12.0, 30.0, int(rng.integers(*settings.hairpins, endpoint=True)))
    perimeter = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum()
    # rounding the corners shortens the lap by about a tenth
    corners *= (rng.uniform(*settings.lap_length) * 1.1 - 2 * legs.sum()) / perimeter
    least = (HAIRPIN_DIAMETER - width) / 2
    radii = least + rng.gamma(2.0, 4.0, count)
    layout: _Layout | None = _Layout(corners, radii)
    for leg in legs:
        inward = rng.random() < 0.3
        if layout is not None:
            layout = _with_hairpin(layout, float(-leg if inward else leg), least, rng)
    if layout is None:
        return None
    if rng.random() < 0.5:
        layout = _Layout(layout.corners[::-1], layout.radii[::-1])
    half_turn = np.abs(_turns(layout.corners)) / 2
    before = np.linalg.norm(layout.corners - np.roll(layout.corners, 1, axis=0), axis=1)
    # both corners of a side may take half of it
    room = np.minimum(before, np.roll(before, -1)) / 2
    radii = np.minimum(layout.radii, room / np.maximum(np.tan(half_turn), np.finfo(float).eps))
    return _Layout(layout.corners, radii) if (radii >= least - 1e-9).all() else None


def _with_hairpin(layout: _Layout, leg: float, least: float, rng: Generator) -> _Layout | None:
    """Add a finger to a random side long enough for it: out (inward for a negative leg), round and back."""
    radius, bend = least + rng.uniform(0.3, 1.5), least + rng.uniform(0.5, 3.0)
    sides = np.roll(layout.corners, -1, axis=0) - layout.corners
    lengths = np.linalg.norm(sides, axis=1)
    room = 2 * radius + 4 * bend
    fits = np.flatnonzero(lengths > room)
    if not len(fits):
        return None
    side = int(rng.choice(fits))
    along = sides[side] / lengths[side]
    outward = np.array([along[1], -along[0]])
    middle = layout.corners[side] + along * rng.uniform(room / 2, lengths[side] - room / 2)
    foot = np.array([middle - along * radius, middle + along * radius])
    tip = foot + outward * leg
    finger = np.array([foot[0], tip[0], tip[1], foot[1]])
    corners = np.insert(layout.corners, side + 1, finger, axis=0)
    return _Layout(corners, np.insert(layout.radii, side + 1, [bend, radius, radius, bend]))


def _turns(corners: Array) -> Array:
    before = corners - np.roll(corners, 1, axis=0)
    after = np.roll(before, -1, axis=0)
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    return np.asarray(np.arctan2(cross, np.sum(before * after, axis=1)))


def _curve(layout: _Layout, rng: Generator) -> Array:
    """Samples (n, 2) of the centre line: straights and their elements, joined by eased arcs."""
    (corners, radii), turns = layout, _turns(layout.corners)
    tangent = radii * np.tan(np.abs(turns) / 2)
    pieces: list[Array] = []
    for k in range(len(turns)):
        following = (k + 1) % len(turns)
        side = corners[following] - corners[k]
        direction = side / np.linalg.norm(side)
        end = corners[following] - direction * tangent[following]
        pieces.append(_straight(corners[k] + direction * tangent[k], end, rng))
        pieces.append(_arc(end, direction, radii[following], turns[following]))
    polyline = ring(np.vstack(pieces))
    s = arc_lengths(polyline)
    even = np.linspace(0.0, s[-1], int(s[-1] / STEP), endpoint=False)
    curve = along_polyline(even, s, polyline)
    return np.asarray(scipy.ndimage.gaussian_filter1d(curve, SMOOTHING / STEP, axis=0, mode="wrap"))


def _arc(begin: Array, direction: Array, radius: float, turn: float) -> Array:
    """Samples of an arc from `begin` on, first along `direction`."""
    angles = turn * np.linspace(0.0, 1.0, max(int(radius * abs(turn) / STEP), 1), endpoint=False)
    normal = left_of(direction) * np.sign(turn)
    forward, sideways = np.sin(np.abs(angles))[:, None], 1 - np.cos(angles)[:, None]
    return np.asarray(begin + radius * (forward * direction + sideways * normal))


def _straight(begin: Array, end: Array, rng: Generator) -> Array:
    """Samples from `begin` to `end`, by chance with a slalom or a chicane where there is room."""
    length = float(np.linalg.norm(end - begin))
    if length < STEP:
        return begin[None]
    along = np.arange(0.0, length, STEP)
    direction = (end - begin) / length
    dice, offset = rng.random(), np.zeros_like(along)
    if dice < 0.35:
        offset = _slalom(along, length, rng)
    elif dice - 0.35 < 0.3:
        offset = _chicane(along, length, rng)
    return begin + along[:, None] * direction + offset[:, None] * left_of(direction)


def _slalom(along: Array, length: float, rng: Generator) -> Array:
    """Draw two or three eased waves `A sin(2 pi s / wavelength)`, or zeros where there is no room."""
    wavelength = rng.uniform(14.0, 22.0)
    waves = min(int(length / wavelength), 3)
    if waves < 2:
        return np.zeros_like(along)
    total = waves * wavelength
    s = along - rng.uniform(0.0, length - total)
    # the tightest bend of a sine has the radius (wavelength / 2 pi)^2 / A
    amplitude = (wavelength / (2 * np.pi)) ** 2 / rng.uniform(5.0, 9.0)
    ease = np.clip(np.minimum(s, total - s) / (wavelength / 4), 0.0, 1.0)
    wave = rng.choice([-1.0, 1.0]) * amplitude * np.sin(2 * np.pi * s / wavelength)
    return np.asarray(wave * ease**2 * (3 - 2 * ease))


def _chicane(along: Array, length: float, rng: Generator) -> Array:
    """Draw a shift to one side and back by half cosine waves, or zeros where there is no room."""
    shift, hold = rng.uniform(8.0, 13.0), rng.uniform(0.0, 5.0)
    total = 2 * shift + hold
    if length < total:
        return np.zeros_like(along)
    s = along - rng.uniform(0.0, length - total)
    # the tightest bend of the shift has the radius 2 (shift / pi)^2 / depth
    depth = min(2 * (shift / np.pi) ** 2 / rng.uniform(4.5, 8.0), rng.uniform(2.0, 4.5))
    part = np.clip(np.minimum(s, total - s) / shift, 0.0, 1.0)
    return np.asarray(rng.choice([-1.0, 1.0]) * depth * (1 - np.cos(np.pi * part)) / 2)


def _keeps_rules(curve: Array, width: float, settings: TrackGeneratorSettings) -> bool:
    bend, distance = np.abs(_curvature(curve)), width + 1.5  # m between boundaries of different stretches
    pairs = scipy.spatial.KDTree(curve).query_pairs(distance, output_type="ndarray")
    apart = np.abs(pairs[:, 0] - pairs[:, 1])
    apart = np.minimum(apart, len(curve) - apart) * STEP  # samples that are near are of one stretch
    return bool(
        settings.lap_length[0] <= arc_lengths(ring(curve))[-1] <= settings.lap_length[1]
        and bend.max() * (HAIRPIN_DIAMETER - width) / 2 <= 1
        and _longest_run(bend < 1 / STRAIGHT_RADIUS)[1] * STEP <= 80.0  # m
        and (apart < np.pi * distance / 2).all()
    )


def _curvature(curve: Array) -> Array:
    after, before = np.roll(curve, -1, axis=0), np.roll(curve, 1, axis=0)
    return curvature((after - before) / 2, after - 2 * curve + before)


def _longest_run(good: NDArray[np.bool_]) -> tuple[int, int]:
    bad = np.flatnonzero(~good)
    if not len(bad):
        return 0, len(good)
    gaps = np.diff(bad, append=bad[0] + len(good)) - 1
    longest = int(np.argmax(gaps))
    return int(bad[longest] + 1) % len(good), int(gaps[longest])


def _with_cones(curve: Array, width: float, settings: TrackGeneratorSettings, rng: Generator) -> Track:
    """Start early on the longest straight, and place cones along both boundaries."""
    first, run = _longest_run(np.abs(_curvature(curve)) < 1 / STRAIGHT_RADIUS)
    curve = np.roll(curve, -(first + run // 3), axis=0)
    along = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    normals = left_of(unit(along))
    # at a radius of 8 m cones stand twice as close as on straights
    crowding = 1 + 8.0 * scipy.ndimage.gaussian_filter1d(np.abs(_curvature(curve)), 2.0 / STEP, mode="wrap")
    rows = [curve + side * normals * width / 2 for side in (1.0, -1.0)]

    def excess(gap: float) -> float:
        return float(sum(_cumulative(row, gap, crowding)[-1] for row in rows)) - settings.cones

    widest = CONE_GAPS[1] * float(crowding.max())
    if excess(widest) >= 0:
        gap = widest
    elif excess(CONE_GAPS[0]) <= 0:
        gap = CONE_GAPS[0]
    else:
        gap = float(scipy.optimize.brentq(excess, CONE_GAPS[0], widest))
    placed = list[Array]()  # with a random offset along each row
    for row in rows:
        total = _cumulative(row, gap, crowding)
        count = int(np.ceil(total[-1]))
        at = (np.arange(count) + rng.random()) * total[-1] / count
        placed.append(along_polyline(at, total, ring(row)))
    start = np.append(curve[0], np.arctan2(along[0, 1], along[0, 0]))
    return Track(placed[0], placed[1], np.zeros((0, 2)), True, start, "generated")


def _cumulative(row: Array, gap: float, crowding: Array) -> Array:
    """Number of cones from the first sample to each, and round to the first again (n + 1,).

    They are `gap` (m) apart where nothing crowds them.
    """
    density = 1.0 / np.clip(gap / crowding, *CONE_GAPS)
    return np.concatenate([[0.0], np.cumsum(np.diff(arc_lengths(ring(row))) * density)])
