"""The names of our own estimators, the default ones first."""

from typing import Final

ONLINE_NAMES: Final = ("fixed-lag", "landmark-fixed-lag", "ckf", "landmark-ckf")
BATCH_NAMES: Final = ("spline", "landmark-batch")
