"""Simulation: tracks, a vehicle and a sensor give a log; no estimator is known here."""
