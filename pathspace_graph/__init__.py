"""B-spline SLAM of race tracks on GTSAM factor graphs."""
