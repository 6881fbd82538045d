"""The names of what a recording holds: its timelines, and the paths of its entities."""

from __future__ import annotations

from typing import Final

TIMELINE: Final = "cycle"
"""This timeline counts the perception cycles, from 0."""
TIME: Final = "time"
"""This timeline is the time of the log (s)."""
TIMELINES: Final = (TIMELINE, TIME)
"""A recording has these timelines."""

MAP: Final = "map"
"""All that has a place lies below this, in the map frame (m)."""
TRAJECTORY: Final = f"{MAP}/trajectory"
"""Each cycle adds the way from the pose before to its own."""
VEHICLE: Final = f"{MAP}/vehicle"
"""This is the outline of the vehicle."""
WINDOW: Final = f"{MAP}/window"
"""These are the poses of the window."""
READINGS: Final = f"{MAP}/readings"
"""Below this are the detections of the cycle: `used`, `gated` or, where it isn't known, `detected`."""
FEET: Final = f"{READINGS}/feet"
"""Each detection in use is connected with its foot point."""
TRUE_CONES: Final = f"{MAP}/truth/cones"
"""These are the true cones."""

HEALTH: Final = "health"
"""This is the health: good, degraded or lost."""
MESSAGES: Final = "messages"
"""These are the reasons of a health that is not good, and what else is to be told."""
UPDATE: Final = "update"
"""Below this is the time of each update (ms)."""
SIZES: Final = "size"
"""Below this are the numbers of control points or landmarks."""
READING_COUNTS: Final = "readings"
"""Below this are the numbers of detections that were offered and used."""
