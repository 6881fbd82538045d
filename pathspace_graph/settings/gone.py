"""Settings that there were, with what took their place."""

from typing import Final

GONE: Final = """
: sigma_step 0.5
limits: stamp 1e11, interval 1e-3, twists 100000, detections 500, range_min 0.01, sigma_min 1e-6,
 sigma_max 100.0
spline: min_size 8, sigma_simplify 0.1, confirmed_margin 0.5, search_step 1.0, fit_smoothness 0.1, fit_held 4
gauge: sigma_anchor 1e4
gate: chi_unknown 1.5, sigma_floor 0.1, rough 3.0, view_behind 4.0, station_step 1.5, station_ahead 8.0,
 station_behind 3.0, station_lateral 10.0, station_room 40.0
place: room 1.0, apart 2.0
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
"""
"""A line for each group: `group: name value, name >new.name`, that is, a constant's value or a new name."""


def successor(name: str) -> str | None:
    """Return what took the place of a dotted setting that is gone, in words; None where it isn't gone."""
    for line in GONE.replace("\n ", " ").strip().splitlines():
        group, _, entries = line.partition(": ")
        for entry in entries.split(", "):
            old, _, place = entry.partition(" ")
            if name == f"{group}.{old}".lstrip("."):
                return f"{place[1:]} now" if place.startswith(">") else f"a constant now ({place})"
    return None
