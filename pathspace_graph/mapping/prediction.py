"""The prediction of the newest pose (paper: Predict), and the engine's settings."""

from __future__ import annotations

from pathspace_graph.graph.smoother import SmootherSettings
from pathspace_graph.settings.mapper import MapperSettings


def smoother_settings(settings: MapperSettings) -> SmootherSettings:
    """What the engine is told of the settings."""
    return SmootherSettings(
        lag=settings.lag,
        tolerances=(settings.relinearize.point, settings.relinearize.heading),
        keyframe_interval=settings.closing.keyframe_interval,
        sigma_calibration=(settings.odometry.sigma_scale, settings.odometry.sigma_bias),
    )
