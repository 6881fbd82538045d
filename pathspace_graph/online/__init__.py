"""The spline graph online: a fixed-lag smoother in the order of the paper."""
