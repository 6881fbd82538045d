"""What the estimators share: their state, detections, the path driven, and the rows of the curves."""
