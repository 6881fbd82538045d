"""What the live viewer shows without anything being arranged: map, times, sizes, health and messages."""

from typing import Any, Final

from .entities import HEALTH, MAP, MESSAGES, READING_COUNTS, SIZES, TIMELINE, TIMELINES, TRAJECTORY, UPDATE

WHITE: Final = (255, 255, 255)
"""The map is drawn on this, as in all our figures, since the colours are made for it."""


def blueprint(rerun: Any) -> Any:
    """Returns the arrangement: the map on the left, and all else below each other on the right."""
    views = rerun.blueprint
    beside = views.Vertical(
        views.StateTimelineView(origin=HEALTH, name="health"),
        views.TimeSeriesView(origin=UPDATE, name="time per cycle [ms]"),
        views.TimeSeriesView(origin=SIZES, name="size of the map"),
        views.TimeSeriesView(origin=READING_COUNTS, name="readings per cycle"),
        views.TextLogView(origin=MESSAGES, name="messages"),
        row_shares=[1, 2, 2, 2, 2],
    )
    return views.Blueprint(
        views.Horizontal(_map_view(rerun), beside, column_shares=[3, 2]),
        views.TimePanel(timeline=TIMELINE, state="collapsed"),
        views.BlueprintPanel(state="collapsed"),
        views.SelectionPanel(state="collapsed"),
    )


def _map_view(rerun: Any) -> Any:
    """Returns the view of the map; the trajectory is all that was driven so far."""
    views = rerun.blueprint
    driven = views.VisibleTimeRanges(
        [
            rerun.VisibleTimeRange(
                name,
                start=rerun.TimeRangeBoundary.infinite(),
                end=rerun.TimeRangeBoundary.cursor_relative(),
            )
            for name in TIMELINES
        ]
    )
    return views.Spatial2DView(
        origin="/", contents=f"{MAP}/**", name="map", background=WHITE, overrides={TRAJECTORY: driven}
    )
