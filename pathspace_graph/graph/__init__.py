"""The engine: keys, values, finished linear factors, the fixed-lag window, the inactive map and submaps.

GTSAM holds the graphs, eliminates, and marginalizes. The engine knows curves and points only as variables and
rows. Everything outside it names a variable by its key.
"""
