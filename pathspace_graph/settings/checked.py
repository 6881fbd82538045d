"""Settings whose numbers are checked where they are made, and the settings that are gone."""

from dataclasses import fields
from functools import cache
from math import inf, isfinite
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, ClassVar, Final, Literal, Union, get_args, get_origin, get_type_hints

from pathspace_graph.errors import SettingsError

_NUMBERS: Final[dict[Any, tuple[type[Any], str]]] = {
    float: (Real, "a number"),
    int: (Integral, "a whole number"),
}


class Positive:
    """Settings whose numbers are all positive and, unless they are listed as unlimited, finite."""

    UNLIMITED: ClassVar[tuple[str, ...]] = ()  # numbers that may be infinite: there is no limit then
    SIGNED: ClassVar[tuple[str, ...]] = ()  # numbers that may have either sign
    prefix: ClassVar[str]  # what stands before the names of the settings on the command line

    def __init_subclass__(cls, group: str | None = None) -> None:
        """Set the prefix from the name of the group, which is by default that of the class."""
        group = cls.__name__.removesuffix("Settings").lower() if group is None else group
        cls.prefix = "" if group == "mapper" else f"{group}."

    def __post_init__(self) -> None:
        """Raise a SettingsError that names the first wrong setting, as the command line knows it."""
        types = _types(type(self))  # type: ignore[arg-type]  # a class has a hash, whatever its heirs'
        for entry in fields(self):  # type: ignore[arg-type]  # every heir is a dataclass
            value = getattr(self, entry.name)
            if not is_of(value, types[entry.name]):
                expected = f"expected {in_words(types[entry.name])}, found {value!r}"
                raise SettingsError(f"{self.prefix}{entry.name}: {expected:.200}")
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            if entry.name in self.SIGNED:
                expected = "" if isfinite(value) else "a number"
            elif value > 0:
                expected = "a finite number" if value == inf and entry.name not in self.UNLIMITED else ""
            else:
                expected = "a positive number"
            if expected:
                raise SettingsError(f"{self.prefix}{entry.name}: expected {expected}, found {value}")


@cache
def _types(settings: Any) -> dict[str, Any]:
    return get_type_hints(settings)


def is_of(value: Any, kind: Any) -> bool:
    """Return whether a value is of the type of a field; NumPy's numbers are numbers."""
    options = get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        return any(is_of(value, option) for option in options)
    if get_origin(kind) is Literal:
        return value in options
    if get_origin(kind) is tuple:
        each = options[:1] * len(value) if isinstance(value, tuple) and options[-1] is ... else options
        return isinstance(value, tuple) and len(value) == len(each) and all(map(is_of, value, each))
    if kind in _NUMBERS:
        return isinstance(value, _NUMBERS[kind][0]) and not isinstance(value, bool)
    return isinstance(value, kind)


def in_words(kind: Any) -> str:
    options = get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        return " or ".join(map(in_words, options))
    if get_origin(kind) is Literal:
        return " or ".join(map(repr, options))
    if get_origin(kind) is tuple:
        return f"a list, each {in_words(options[0])}"
    if kind in _NUMBERS:
        return _NUMBERS[kind][1]
    return {bool: "True or False", NoneType: "None"}.get(kind) or f"a {getattr(kind, '__name__', kind)}"


GONE: Final = """
: sigma_step 0.5
limits: stamp 1e11, interval 1e-3, twists 100000, detections 500, range_min 0.01, sigma_min 1e-6,
 sigma_max 100.0
spline: min_size 8, sigma_simplify 0.1, confirmed_margin 0.5, search_step 1.0, fit_smoothness 0.1,
 fit_held 4, residual across
gauge: sigma_anchor 1e4
gate: chi_unknown 1.5, sigma_floor 0.1, rough 3.0, view_behind 4.0, station_step 1.5, station_ahead 8.0,
 station_behind 3.0, station_lateral 10.0, station_room 40.0
place: room 1.0, apart 2.0, use none, sigma 0.1
motion: doubt_again 3.8, distrust 12.0, doubt_rate 2.0, memory 0.65, max_remembered 2000, reach 1.0,
 reach_last 0.4, iterations 6, min_weight 0.7, min_matched 3, min_doubting 4, huber 2.5, misfit 1.5,
 misfit_gain 0.02, max_misfit 3.0, misfit_odometry 2.0, misfit_ratio 1.3, max_change 3.5, sigma_cone 0.05,
 sigma_latency 0.05, sigma_latency_changes 0.005, sigma_yaw 0.02, sigma_yaw_changes 0.001, before 0.5,
 widening 1.5, sigma_speed 3.0, sigma_lateral 1.0, sigma_rate 0.5, hold 0.15, hold_intervals 3.0, stuck 3,
 rest 1.0, rest_speed 0.1, rest_rate 0.05, rest_sigmas 3.0, rest_sigma 5e-4, rest_sigma_heading 5e-5
sides: reach 8.0, min_lateral 0.5, max_lateral 8.0, majority 2.5, enough_votes 30, remembered 0.98,
 min_detections 6, merge_radius 1.0, forget_after 3.0, max_cones 2000, sightings 2, behind 8.0, sure 3.0,
 beside 2.0, lateral_gap 0.8, half_width 1.5, gap 8.0, turn 1.3, turn_cost 2.0, clear 1.3, min_width 1.8
odometry: wide 10.0, doubt_cycles 10, sigma_start 1e-4, sigma_start_heading 1e-5
calibration: wide 20.0
film: widest_band 5.0
recording: widest_band 5.0
batch: pose_steps 3, rough_rounds 24, rough_tolerance 8.0, knot_passes 2, max_rounds 80, loose_gate 8.0,
 gate_factor 0.7, damping 1e-2, damping_up 5.0, damping_down 0.1, damping_least 1e-6, damping_most 1e6,
 share_least 0.3, share_most 0.97, tolerance_cost 1e-5, tolerance_curve 2e-3, tolerance_decrease 5e-3,
 min_size_share 0.6, curve_samples 2, size none
batch.recurrence: profile_step 0.5, smoothing 3.0, correlation_share 0.8, min_correlation 0.7,
 min_overlap 20.0
batch.laps: reference_step 8.0, sigma_position 1.5, sigma_heading 0.15, max_steps 8, tolerance 1e-6
batch.cones: density_step 0.1, separation 0.6, bandwidth 0.4, sigma 0.6, sharp_share 0.1, min_share 0.1,
 min_share_beside 0.3, max_lateral 15.0, min_count 4, fold_cosine 0.5, fold_distance 1.5
batch.foot_points: refine_room 8.0, refine_iterations 2, search_iterations 4
batch.scatter: folds 4, foot_room 1.5
batch.closure: used_again 0.85, misfit 1.5, gap 25.0, overlap 15.0, sigma 0.3
open_lap: rough_rounds 8, rounds 20, rounds_from_odometry 24, tolerance 10.0
ckf: penalty solution, prediction fitted, sigma_kept 0.05, least_basis 1e-3, reach 9.0, stretch 12.0,
 sigma_carry 1.0, sigma_start 0.3, sigma_tie 0.15, sigma_match 0.6, patience 30.0, sigma_patience 1000.0,
 tie_reach 1.0
centerline: room 4.0, rounds 2, max_iterations 15, tolerance 1e-5, sigma_edge 0.05
landmark: rough 5.0, max_rounds 10, settled 1e-3, tolerance 1e-6, sigma_merge 0.1, unseen 40.0, min_pairs 4,
 min_lead 2.0
path: step 0.3, memory 60.0, beginning_step 1.0, max_curvature 0.3, curvature_gain 0.4, min_speed 1.0
growth: lateral_change 1.5, lateral_rate 0.2, beside 2.0, lateral_gap 0.8, station_margin 0.3,
 end_behind 5.0, recall 25.0, stranded 2.0, stranded_left 0.5, min_lateral 0.5, min_carry 0.5,
 length_driven 2.0, length_free 50.0, max_tracks 1000
tentative: reach 12.5, memory 0.35, gap 11.0, turn 2.0, turn_rate 0.1, turn_cost 1.0, min_width 1.5,
 width_ratio 1.8, width_slack 1.0, tail 20.0, tail_step 1.0, begin_lateral 1.5, sigma_cone 0.1,
 sigma_bend 1.0
closing: heading 0.8, start_lateral 5.0, start_heading 0.5, min_readings 25, min_boundary_readings 5,
 window 2.0, beginning 60.0, beginning_share 0.6, icp_reach 3.0, icp_shrink 0.7, icp_iterations 7,
 start_step 2.0, start_chi2 16.3, keyframe_interval 12.0, sigma_step 10.0, join_margin 10.0, join_share 0.5,
 overlap_step 1.0, overlap_room 4.0, seam_margin 0.5
closing.recognition: stretch 150.0, interval 10.0, stretch_room 10.0, starts 6
health: beside 1.0, gap 3.0
finding: interval 0.5, memory 60.0, readings 200, min_readings 40, step 2.0, lead 4.0, misfit 3.0,
 sample 0.25, reach 3.0, starts 12, apart 4.0, sigma_position 3.0, sigma_heading 0.2, sigma_fit 0.3,
 min_score 0.6, margin 0.1, sigma_max 0.5, confirmations 2, widening 3.0, steps 2
mending: sightings 6, cones 3, beside 0.5, row 11.0, settle 1.5, most 20, memory 30.0, interval 0.5,
 attempts 8, explained 0.5, sample 0.25
"""
"""A line for each group: `group: name value, ...`, with the value that a constant has now."""


def check_gone(name: str, said: str) -> None:
    """Raise a SettingsError for a dotted setting that is gone, with the value of its constant."""
    for line in GONE.replace("\n ", " ").strip().splitlines():
        group, _, entries = line.partition(": ")
        for entry in entries.split(", "):
            old, _, value = entry.partition(" ")
            if name == f"{group}.{old}".lstrip("."):
                found = f"found one that is gone: a constant now ({value})"
                raise SettingsError(f"{said}: expected a setting, {found}")
