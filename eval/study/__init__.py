"""Studies: tracks, seeds, estimators and settings, run in parallel and compared in pairs."""
