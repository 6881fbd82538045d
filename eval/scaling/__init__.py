"""Time per update against the size of the map, the detections of an update, and the laps."""
