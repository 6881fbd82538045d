"""The engine: keys, values, linear factors, the fixed-lag window and the inactive map.

GTSAM holds the graphs, eliminates and marginalizes. The engine knows curves and points only as variables and
rows. All other code names a variable by its key.
"""
