"""What is measured of a map, a trajectory and a run, with one definition of each metric."""
