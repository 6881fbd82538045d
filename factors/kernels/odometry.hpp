// Twists integrated on SE(2) (`factors/odometry.py`).

#pragma once

#include "common.hpp"

namespace kernels {

// End pose (3,), its covariance (3, 3) in its own frame, and its derivative (3, 2) by the calibration.
struct Integrated {
  Pose end{};
  Matrix3 covariance{};
  std::array<double, 6> by_calibration{};
};

Integrated integrate(Index count, const double* durations, const double* twists, const double* sigmas);

// Lower triangular W (3, 3) with W' W the inverse of a covariance (3, 3) plus `least^2`.
Matrix3 whitener_of(const double* covariance, double least);

}  // namespace kernels
