"""Parts that estimators share: state, detections, tentative tracks, the driven path, and loop closure."""
