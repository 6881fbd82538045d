"""The batch optimization of the spline graph over a whole log, which is the ground reference."""
