"""Plane B-splines: curves, their knots, and the boundary that a mapper grows."""
