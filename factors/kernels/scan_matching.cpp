// A cycle laid on the recent ones (`front_end/scan_matching.py`).

#include "detections.hpp"

namespace kernels {
namespace {

py::tuple weighted_means(const Array& points, const Array& recent, double reach, double farthest) {
  const Index m = points.shape(0), n = recent.shape(0);
  const double tiny = std::numeric_limits<double>::min();
  expect(points.size() == 2 * m && recent.size() == 2 * n);
  Array means(Shape{m, 2}), totals(m);
  for (Index i = 0; i < m; ++i) {
    double x = 0.0, y = 0.0, total = 0.0;
    for (Index j = 0; j < n; ++j) {
      const double dx = points.data()[2 * i] - recent.data()[2 * j];
      const double dy = points.data()[2 * i + 1] - recent.data()[2 * j + 1];
      const double square = (dx * dx + dy * dy) / (reach * reach);
      if (!(square < farthest * farthest)) continue;
      const double weight = std::exp(-0.5 * square);
      total += weight;
      x += weight * recent.data()[2 * j];
      y += weight * recent.data()[2 * j + 1];
    }
    means.mutable_data()[2 * i] = x / std::max(total, tiny);
    means.mutable_data()[2 * i + 1] = y / std::max(total, tiny);
    totals.mutable_data()[i] = total;
  }
  return py::make_tuple(means, totals);
}

// A step of `match`: how many are matched, the information and the gradient at a pose, and the cost there.
Index match_step(const Array& recent, const Array& points_vehicle, const Array& variances, const double* pose,
                 double reach, const py::tuple& limits, double* information, double* gradient,
                 bool* is_matched, double* total) {
  const Index m = points_vehicle.shape(0);
  const double farthest = limits[0].cast<double>(), min_weight = limits[1].cast<double>();
  const double huber = limits[2].cast<double>(), sigma_cone = limits[3].cast<double>();
  const Array place(Shape{1, 3}, pose);
  const Array points = to_map(points_vehicle, place);
  const py::tuple beside = weighted_means(points, recent, reach, farthest);
  const Array means = beside[0].cast<Array>(), weights = beside[1].cast<Array>();
  double w = 0.0, wx = 0.0, wy = 0.0, turning = 0.0, cost = 0.0, g[3] = {0.0, 0.0, 0.0};
  Index count = 0;
  for (Index i = 0; i < m; ++i) {
    is_matched[i] = weights.data()[i] > min_weight;
    if (!is_matched[i]) continue;
    ++count;
    const double* p = points.data() + 2 * i;
    const double ex = p[0] - means.data()[2 * i], ey = p[1] - means.data()[2 * i + 1];
    const double ax = p[0] - pose[0], ay = p[1] - pose[1];
    const double square = ex * ex + ey * ey;
    double precision =
        1.0 / (variances.data()[i] * (1.0 + 1.0 / weights.data()[i]) + sigma_cone * sigma_cone);
    precision *= 1.0 / std::max(std::sqrt(square * precision) / huber, 1.0);
    w += precision, wx += precision * ax, wy -= precision * ay;
    turning += precision * (ax * ax + ay * ay);
    g[0] += precision * ex, g[1] += precision * ey, g[2] += precision * (ax * ey - ay * ex);
    cost += square * precision;
  }
  const double values[9] = {w, 0.0, wy, 0.0, w, wx, wy, wx, turning};
  std::copy_n(values, 9, information);
  std::copy_n(g, 3, gradient);
  *total = cost;
  return count;
}

py::tuple matched(const Array& recent, const Array& points_vehicle, const Array& variances,
                  const Array& start, const Array& reaches, const py::tuple& limits) {
  const Index m = points_vehicle.shape(0);
  const double min_matched = limits[4].cast<double>(), least_share = limits[5].cast<double>();
  double pose[3], information[9], gradient[3], cost = 0.0;
  expect(start.size() == 3 && variances.size() == m && reaches.size() > 0);
  std::copy_n(start.data(), 3, pose);
  py::array_t<bool> is_matched(m);
  for (Index k = 0; k < reaches.size(); ++k) {
    const Index count = match_step(recent, points_vehicle, variances, pose, reaches.data()[k], limits,
                                   information, gradient, is_matched.mutable_data(), &cost);
    if (count < min_matched) break;
    double A[3][3];
    for (int i = 0; i < 9; ++i) A[i / 3][i % 3] = information[i] * (i % 4 ? 1.0 : 1.0 + least_share);
    solve3(A, gradient);
    for (int i = 0; i < 3; ++i) pose[i] -= gradient[i];
  }
  return py::make_tuple(Array(Shape{3}, pose), Array(Shape{3, 3}, information), is_matched, cost);
}

py::tuple off_prediction(const Array& pose, const Array& information, double excess, const Array& predicted,
                         const Array& covariance) {
  expect(pose.size() == 3 && information.size() == 9 && predicted.size() == 3 && covariance.size() == 9);
  const double* x = predicted.data();
  const Turn turn(x[2]);
  const double T[3][3] = {{turn.c, turn.s, 0.0}, {-turn.s, turn.c, 0.0}, {0.0, 0.0, 1.0}};
  double spread[9], off[3] = {0.0, 0.0, 0.0}, K[9];
  inverse3(information.data(), spread);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      off[i] += T[i][j] * (pose.data()[j] - x[j]);
      double sum = 0.0;
      for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) sum += T[i][a] * spread[3 * a + b] * T[j][b];
      K[3 * i + j] = excess * sum + covariance.data()[3 * i + j];
    }
  return py::make_tuple(Array(Shape{3}, off), Array(Shape{3, 3}, K));
}

double squared(const Array& off, const Array& covariance, const Array& shifts, const Array& errors) {
  expect(off.size() == 3 && covariance.size() == 9 && shifts.size() == 6 && errors.size() == 4);
  const double *S = shifts.data(), *P = errors.data();
  double A[3][3], solved[3], square = 0.0;
  for (int i = 0; i < 3; ++i) {
    solved[i] = off.data()[i];
    for (int j = 0; j < 3; ++j) {
      A[i][j] = covariance.data()[3 * i + j];
      for (int a = 0; a < 2; ++a)
        for (int b = 0; b < 2; ++b) A[i][j] += S[2 * i + a] * P[2 * a + b] * S[2 * j + b];
    }
  }
  solve3(A, solved);
  for (int i = 0; i < 3; ++i) square += off.data()[i] * solved[i];
  return square;
}

// The Kalman update of SensorErrors.update.
py::tuple learned(const Array& mean, const Array& errors, const Array& drift, const Array& off,
                  const Array& covariance, const Array& shifts, double share) {
  expect(mean.size() == 2 && errors.size() == 4 && drift.size() == 4 && off.size() == 3);
  expect(covariance.size() == 9 && shifts.size() == 6);
  const double* S = shifts.data();
  double weighted[2][3], grown[4], information[4], P[4];
  for (int e = 0; e < 2; ++e) {
    double A[3][3];
    std::copy_n(covariance.data(), 9, &A[0][0]);
    for (int i = 0; i < 3; ++i) weighted[e][i] = share * S[2 * i + e];
    solve3(A, weighted[e]);
  }
  for (int i = 0; i < 4; ++i) grown[i] = errors.data()[i] + drift.data()[i];
  inverse2(grown, information);
  double gain[2] = {0.0, 0.0}, out[2];
  for (int e = 0; e < 2; ++e)
    for (int i = 0; i < 3; ++i) {
      gain[e] += weighted[e][i] * off.data()[i];
      for (int f = 0; f < 2; ++f) information[2 * e + f] += weighted[e][i] * S[2 * i + f];
    }
  inverse2(information, P);
  for (int e = 0; e < 2; ++e) out[e] = mean.data()[e] + P[2 * e] * gain[0] + P[2 * e + 1] * gain[1];
  return py::make_tuple(Array(Shape{2}, out), Array(Shape{2, 2}, P));
}

}  // namespace

void add_scan_matching(py::module_& module) {
  module.def("weighted_means", &weighted_means);
  module.def("matched", &matched);
  module.def("off_prediction", &off_prediction);
  module.def("squared", &squared);
  module.def("learned", &learned);
}

}  // namespace kernels
