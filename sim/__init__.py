"""Simulation: tracks, a vehicle, a sensor; gives a log and knows no estimator."""
