"""The spline graph over a whole log: the ground reference."""
