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

struct Limits {
  explicit Limits(const py::tuple& of)
      : farthest(of[0].cast<double>()),
        min_weight(of[1].cast<double>()),
        huber(of[2].cast<double>()),
        sigma(of[3].cast<double>()),
        min_matched(of[4].cast<double>()),
        least_share(of[5].cast<double>()) {}
  double farthest, min_weight, huber, sigma, min_matched, least_share;
};

struct LineLimits {
  explicit LineLimits(const py::tuple& of)
      : reach(of[0].cast<double>()),
        points(of[1].cast<double>()),
        spread(of[2].cast<double>()),
        shape(of[3].cast<double>()),
        inside(of[4].cast<double>()) {}
  double reach, points, spread, shape, inside;
};

// A detection beside recent ones: its offset from their mean, or along the normal of their line.
struct Beside {
  bool matched;
  double weight, off[2], normal[2];
};

Beside beside_line(const double* p, const Array& recent, double reach, double farthest,
                   const LineLimits& line) {
  const double tiny = std::numeric_limits<double>::min();
  double total = 0.0, x = 0.0, y = 0.0, xx = 0.0, xy = 0.0, yy = 0.0;
  reach *= line.reach;
  for (Index j = 0; j < recent.shape(0); ++j) {
    const double dx = recent.data()[2 * j] - p[0], dy = recent.data()[2 * j + 1] - p[1];
    const double square = (dx * dx + dy * dy) / (reach * reach);
    if (!(square < farthest * farthest)) continue;
    const double weight = std::exp(-0.5 * square);
    total += weight, x += weight * dx, y += weight * dy;
    xx += weight * dx * dx, xy += weight * dx * dy, yy += weight * dy * dy;
  }
  total = std::max(total, tiny);
  x /= total, y /= total;
  xx = xx / total - x * x, xy = xy / total - x * y, yy = yy / total - y * y;
  const double middle = 0.5 * (xx + yy), half = std::hypot(0.5 * (xx - yy), xy);
  const double along = middle + half, across = std::max(middle - half, 0.0);
  const Turn tangent(0.5 * std::atan2(2.0 * xy, xx - yy));
  const bool matched = total > line.points && along > line.spread * line.spread * reach * reach &&
                       along > line.shape * across &&
                       std::abs(x * tangent.c + y * tangent.s) < line.inside * reach;
  const double off = x * tangent.s - y * tangent.c;
  return {matched, total, {-off * tangent.s, off * tangent.c}, {-tangent.s, tangent.c}};
}

std::vector<Beside> beside(const Array& recent, const Array& points, double reach, const Limits& limits,
                           const py::tuple& line) {
  const Index m = points.shape(0);
  std::vector<Beside> out(m);
  if (line.size()) {
    const LineLimits own(line);
    for (Index i = 0; i < m; ++i)
      out[i] = beside_line(points.data() + 2 * i, recent, reach, limits.farthest, own);
    return out;
  }
  const py::tuple found = weighted_means(points, recent, reach, limits.farthest);
  const Array means = found[0].cast<Array>(), weights = found[1].cast<Array>();
  for (Index i = 0; i < m; ++i) {
    const double *p = points.data() + 2 * i, *mean = means.data() + 2 * i, weight = weights.data()[i];
    out[i] = {weight > limits.min_weight, weight, {p[0] - mean[0], p[1] - mean[1]}, {0.0, 0.0}};
  }
  return out;
}

double precision_of(const Beside& one, double variance, double sigma) {
  return 1.0 / (variance * (1.0 + 1.0 / one.weight) + sigma * sigma);
}

// A step of `match`: how many are matched, the information and the gradient at a pose, and the cost there.
Index match_step(const Array& recent, const Array& points_vehicle, const Array& variances, const double* pose,
                 double reach, const Limits& limits, const py::tuple& line, double* information,
                 double* gradient, bool* is_matched, double* total) {
  const Index m = points_vehicle.shape(0);
  const Array place(Shape{1, 3}, pose);
  const Array points = to_map(points_vehicle, place);
  const std::vector<Beside> all = beside(recent, points, reach, limits, line);
  double w = 0.0, wx = 0.0, wy = 0.0, turning = 0.0, cost = 0.0, g[3] = {0.0, 0.0, 0.0};
  double across[9] = {};
  Index count = 0;
  for (Index i = 0; i < m; ++i) {
    const Beside& one = all[i];
    is_matched[i] = one.matched;
    if (!one.matched) continue;
    ++count;
    const double ex = one.off[0], ey = one.off[1];
    const double ax = points.data()[2 * i] - pose[0], ay = points.data()[2 * i + 1] - pose[1];
    const double square = ex * ex + ey * ey;
    double precision = precision_of(one, variances.data()[i], limits.sigma);
    const double stated = precision;
    precision *= 1.0 / std::max(std::sqrt(square * precision) / limits.huber, 1.0);
    g[0] += precision * ex, g[1] += precision * ey, g[2] += precision * (ax * ey - ay * ex);
    cost += line.size() ? square * stated : square * precision;
    if (line.size()) {
      const double by[3] = {one.normal[0], one.normal[1], ax * one.normal[1] - ay * one.normal[0]};
      for (int k = 0; k < 9; ++k) across[k] += precision * by[k / 3] * by[k % 3];
    } else {
      w += precision, wx += precision * ax, wy -= precision * ay;
      turning += precision * (ax * ax + ay * ay);
    }
  }
  const double round[9] = {w, 0.0, wy, 0.0, w, wx, wy, wx, turning};
  std::copy_n(line.size() ? across : round, 9, information);
  std::copy_n(g, 3, gradient);
  *total = cost;
  return count;
}

py::tuple matched(const Array& recent, const Array& points_vehicle, const Array& variances,
                  const Array& start, const Array& reaches, const py::tuple& limits, const py::tuple& line,
                  const Array& held) {
  const Index m = points_vehicle.shape(0);
  const Limits own(limits);
  double pose[3], information[9], gradient[3], cost = 0.0;
  expect(start.size() == 3 && variances.size() == m && reaches.size() > 0);
  expect(held.size() == (line.size() ? 9 : 0));
  std::copy_n(start.data(), 3, pose);
  py::array_t<bool> is_matched(m);
  for (Index k = 0; k < reaches.size(); ++k) {
    const Index count = match_step(recent, points_vehicle, variances, pose, reaches.data()[k], own, line,
                                   information, gradient, is_matched.mutable_data(), &cost);
    if (!line.size() && count < own.min_matched) break;  // a line's start is held
    double A[3][3];
    for (int i = 0; i < 9; ++i) A[i / 3][i % 3] = information[i] * (i % 4 ? 1.0 : 1.0 + own.least_share);
    for (Index i = 0; i < held.size(); ++i) {
      A[i / 3][i % 3] += held.data()[i];
      gradient[i / 3] += held.data()[i] * (pose[i % 3] - start.data()[i % 3]);
    }
    solve3(A, gradient);
    for (int i = 0; i < 3; ++i) pose[i] -= gradient[i];
  }
  if (line.size())  // what a line's points show depends on the pose more than what cones show
    match_step(recent, points_vehicle, variances, pose, reaches.data()[reaches.size() - 1], own, line,
               information, gradient, is_matched.mutable_data(), &cost);
  return py::make_tuple(Array(Shape{3}, pose), Array(Shape{3, 3}, information), is_matched, cost);
}

double misfit(const Array& recent, const Array& points_vehicle, const Array& variances, const Array& pose,
              double reach, const py::tuple& limits, const py::tuple& line, double most) {
  const Index m = points_vehicle.shape(0);
  const Limits own(limits);
  expect(pose.size() == 3 && variances.size() == m);
  const Array points = to_map(points_vehicle, Array(Shape{1, 3}, pose.data()));
  double sum = 0.0;
  Index i = 0;
  for (const Beside& one : beside(recent, points, reach, own, line)) {
    const double square = (one.off[0] * one.off[0] + one.off[1] * one.off[1]) *
                          precision_of(one, variances.data()[i++], own.sigma);
    sum += one.matched ? std::min(square, most) : most;
  }
  return m ? sum / m : 0.0;
}

// Gains of the hypotheses of Standstill: shares of the motion by odometry since each of some cycles.
Array standstill_gains(const Array& points, const Array& covariances, const Array& pose,
                       const py::sequence& cycles, const Array& shares, double sigma, double most) {
  const Index m = points.shape(0), k = cycles.size(), h = shares.size();
  expect(points.size() == 2 * m && covariances.size() == 4 * m && pose.size() == 3 && h > 0);
  const Turn turn(pose.data()[2]);
  std::vector<double> precisions(4 * m), gains(h);
  for (Index i = 0; i < m; ++i) {
    double K[4];
    for (int e = 0; e < 4; ++e) K[e] = 2.0 * covariances.data()[4 * i + e] + (e % 3 ? 0.0 : sigma * sigma);
    inverse2(K, &precisions[4 * i]);
  }
  Array out(Shape{h + 1, k});
  std::fill_n(out.mutable_data(), out.size(), 0.0);
  for (Index c = 0; c < k; ++c) {
    const py::tuple cycle = cycles[c].cast<py::tuple>();
    const Array resting = cycle[0].cast<Array>(), before = cycle[1].cast<Array>();
    const Index n = resting.shape(0);
    expect(resting.size() == 2 * n && before.size() == 3);
    const double dx = before.data()[0] - pose.data()[0], dy = before.data()[1] - pose.data()[1];
    const double x = turn.c * dx + turn.s * dy, y = -turn.s * dx + turn.c * dy;
    const Turn turned(before.data()[2] - pose.data()[2]);
    double farthest = 0.0;
    for (Index j = 0; j < n; ++j)
      farthest = std::max(farthest, std::hypot(resting.data()[2 * j], resting.data()[2 * j + 1]));
    const double view = farthest - std::hypot(x, y);
    for (Index i = 0; i < m; ++i) {
      const double *p = points.data() + 2 * i, *P = &precisions[4 * i];
      if (!(std::hypot(p[0], p[1]) <= view)) continue;
      for (Index s = 0; s < h; ++s) {
        double least = most;
        for (Index j = 0; j < n; ++j) {
          const double *q = resting.data() + 2 * j, share = shares.data()[s];
          const double ex = p[0] - q[0] - share * (turned.c * q[0] - turned.s * q[1] + x - q[0]);
          const double ey = p[1] - q[1] - share * (turned.s * q[0] + turned.c * q[1] + y - q[1]);
          least = std::min(least, P[0] * ex * ex + 2.0 * P[1] * ex * ey + P[3] * ey * ey);
        }
        gains[s] = most - least;
        out.mutable_data()[s * k + c] += gains[s];
      }
      const double more = gains[0] - gains[h - 1];
      out.mutable_data()[h * k + c] += more * more;
    }
  }
  return out;
}

// How far a match is off a prediction, its covariance without and with the sensor errors, and its square.
py::tuple off_prediction(const Array& pose, const Array& information, double excess, const Array& predicted,
                         const Array& covariance, const Array& shifts, const Array& errors) {
  expect(pose.size() == 3 && information.size() == 9 && predicted.size() == 3 && covariance.size() == 9);
  expect(shifts.size() == 6 && errors.size() == 4);
  const double *x = predicted.data(), *S = shifts.data(), *P = errors.data();
  const Turn turn(x[2]);
  const double T[3][3] = {{turn.c, turn.s, 0.0}, {-turn.s, turn.c, 0.0}, {0.0, 0.0, 1.0}};
  double spread[9], off[3] = {0.0, 0.0, 0.0}, K[9], A[3][3], solved[3], square = 0.0;
  inverse3(information.data(), spread);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      off[i] += T[i][j] * (pose.data()[j] - x[j]);
      double sum = 0.0;
      for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) sum += T[i][a] * spread[3 * a + b] * T[j][b];
      A[i][j] = K[3 * i + j] = excess * sum + covariance.data()[3 * i + j];
      for (int a = 0; a < 2; ++a)
        for (int b = 0; b < 2; ++b) A[i][j] += S[2 * i + a] * P[2 * a + b] * S[2 * j + b];
    }
  const Array whole(Shape{3, 3}, &A[0][0]);
  std::copy_n(off, 3, solved);
  solve3(A, solved);
  for (int i = 0; i < 3; ++i) square += off[i] * solved[i];
  return py::make_tuple(Array(Shape{3}, off), Array(Shape{3, 3}, K), whole, square);
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
  module.def("misfit", &misfit);
  module.def("standstill_gains", &standstill_gains);
  module.def("off_prediction", &off_prediction);
  module.def("learned", &learned);
}

}  // namespace kernels
