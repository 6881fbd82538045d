"""Measurement mathematics: splines on plain arrays, and the factors built on them."""
