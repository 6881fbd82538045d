// Detections of a cycle registered to earlier ones (`front_end/motion.py`).

#pragma once

#include "detections.hpp"

namespace kernels {

using Doubles = std::vector<double>;

// The fields of `front_end.motion:Matching`, which says what they are.
struct Matching {
  explicit Matching(const py::handle& of);
  bool of_lines;
  Index min_matched, min_doubting;
  double farthest, min_weight, huber, sigma_cone, least_share, most_misfit, misfit_gain, large_misfit;
  double line_reach, least_points, least_spread, least_shape, least_inside;
  Pose line_held, lines_alike;  // standard deviations
};

// Detections of a cycle as they are matched: points (m, 2), vehicle frame, and the variance of a coordinate.
struct Seen {
  Doubles points, variances;
};

struct Match {
  Pose pose{};
  Matrix3 information{};         // about the pose, in the frame of the earlier detections
  std::vector<char> is_matched;  // whether each detection coincides with earlier ones
  Index count = 0;               // number of these
  double misfit = 0.0;           // mean square of their whitened distances
  bool is_certain = false;       // whether the pose is observable in every direction
};

// Sums over earlier points (n, 2) near a place, with the weights exp(-d^2 / 2 reach^2) of their offsets d.
struct Nearby {
  Nearby(const double* place, const Doubles& earlier, double reach, double farthest);
  double weight = 0.0, x = 0.0, y = 0.0, xx = 0.0, xy = 0.0, yy = 0.0;
};

Match match(const Doubles& earlier, const Seen& seen, const Pose& start, const Doubles& reaches,
            const Matching& by);

double misfit(const Doubles& earlier, const Seen& seen, const Pose& pose, double reach, const Matching& by);

}  // namespace kernels
