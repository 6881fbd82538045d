"""The paper's spline filter: a cubature Kalman filter over the pose and the control points of two curves."""
