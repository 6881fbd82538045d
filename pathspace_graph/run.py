"""What a run of an estimator over a log gives."""

from __future__ import annotations
