// Odometry, and the path driven.

#include "odometry.hpp"

namespace kernels {
namespace {

py::tuple along_and_across(const Array& points, const Array& path, const Array& stations) {
  const Index m = points.shape(0), n = path.shape(0) - 1;
  const double tiny = std::numeric_limits<double>::min();
  expect(n > 0 && points.size() == 2 * m && path.size() == 2 * (n + 1) && stations.size() == n + 1);
  Array along(m), across(m);
  for (Index i = 0; i < m; ++i) {
    const double x = points.data()[2 * i], y = points.data()[2 * i + 1];
    double least = kInfinity, share = 0.0;
    Index best = 0;
    for (Index j = 0; j < n; ++j) {
      const double* a = path.data() + 2 * j;
      const double ex = a[2] - a[0], ey = a[3] - a[1], dx = x - a[0], dy = y - a[1];
      const double at = clipped((dx * ex + dy * ey) / std::max(ex * ex + ey * ey, tiny), 0.0, 1.0);
      const double ox = dx - at * ex, oy = dy - at * ey, square = ox * ox + oy * oy;
      if (square < least) least = square, best = j, share = at;
    }
    const double* a = path.data() + 2 * best;
    const double ex = a[2] - a[0], ey = a[3] - a[1], dx = x - a[0], dy = y - a[1];
    const double length2 = std::max(ex * ex + ey * ey, tiny), cross = ex * dy - ey * dx;
    const double over = best == n - 1 ? (dx * ex + dy * ey) / length2 - 1.0 : 0.0;
    const double sign = (cross > 0.0) - (cross < 0.0);
    const double* station = stations.data() + best;
    along.mutable_data()[i] = station[0] + (over > 0.0 ? 1.0 + over : share) * (station[1] - station[0]);
    across.mutable_data()[i] = over > 0.0 ? cross / std::sqrt(length2) : sign * std::sqrt(least);
  }
  return py::make_tuple(along, across);
}

}  // namespace

// The exponential of SE(2) of a twist over a time.
static void se2_exp(const double* twist, double dt, double* pose) {
  const double x = twist[0] * dt, y = twist[1] * dt, theta = twist[2] * dt;
  const double half = theta == 0.0 ? std::numeric_limits<double>::min() : 0.5 * theta;
  const double sine = std::sin(half), cosine = std::cos(half);
  const double sinc = sine * cosine / half, cosc = sine * sine / half;
  pose[0] = sinc * x - cosc * y, pose[1] = cosc * x + sinc * y, pose[2] = theta;
}

Integrated integrate(Index count, const double* durations, const double* twists, const double* sigmas) {
  std::vector<double> poses(3 * count);
  Integrated out;
  Pose &end = out.end, step;
  for (Index k = 0; k < count; ++k) {
    se2_exp(twists + 3 * k, durations[k], step.data());
    const Turn turn(end[2]);
    end[0] += turn.c * step[0] - turn.s * step[1];
    end[1] += turn.s * step[0] + turn.c * step[1];
    end[2] += step[2];
    std::copy(end.begin(), end.end(), &poses[3 * k]);
  }
  const Turn last(end[2]);
  for (Index k = 0; k < count; ++k) {
    const double* twist = twists + 3 * k;
    const double* after = &poses[3 * k];
    const double dt = durations[k];
    se2_exp(twist, -0.5 * dt, step.data());
    const Turn turn(after[2]), from_end(after[2] + step[2] - end[2]);
    const double dx = after[0] + turn.c * step[0] - turn.s * step[1] - end[0];
    const double dy = after[1] + turn.s * step[0] + turn.c * step[1] - end[1];
    const double A[3][3] = {{from_end.c, -from_end.s, -last.s * dx + last.c * dy},
                            {from_end.s, from_end.c, -(last.c * dx + last.s * dy)},
                            {0.0, 0.0, 1.0}};
    for (int i = 0; i < 3; ++i) {
      out.by_calibration[2 * i] += (A[i][0] * twist[0] + A[i][1] * twist[1]) * dt;
      out.by_calibration[2 * i + 1] += A[i][2] * dt;
      for (int j = 0; j < 3; ++j)
        for (int c = 0; c < 3; ++c) {
          const double sigma = dt * sigmas[3 * k + c];
          out.covariance[3 * i + j] += A[i][c] * sigma * (A[j][c] * sigma);
        }
    }
  }
  return out;
}

Matrix3 whitener_of(const double* K, double least) {
  double L[3][3] = {};
  Matrix3 values{};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j <= i; ++j) {
      double sum = K[3 * i + j] + (i == j ? least * least : 0.0);
      for (int k = 0; k < j; ++k) sum -= L[i][k] * L[j][k];
      L[i][j] = i == j ? std::sqrt(sum) : sum / L[j][j];
    }
  for (int j = 0; j < 3; ++j)
    for (int i = j; i < 3; ++i) {
      double sum = i == j ? 1.0 : 0.0;
      for (int k = j; k < i; ++k) sum -= L[i][k] * values[3 * k + j];
      values[3 * i + j] = sum / L[i][i];
    }
  return values;
}

namespace {

py::list integrated(const Array& durations, const Array& twists, const Array& sigmas, const Ints& ends,
                    double least) {
  const Index n = durations.shape(0), m = ends.shape(0);
  expect(twists.size() == 3 * n && sigmas.size() == 3 * n);
  py::list out;
  for (Index i = 0, begin = 0; i < m; begin = ends.data()[i++]) {
    expect(begin <= ends.data()[i] && ends.data()[i] <= n);
    const Integrated of = integrate(ends.data()[i] - begin, durations.data() + begin,
                                    twists.data() + 3 * begin, sigmas.data() + 3 * begin);
    out.append(py::make_tuple(array_of({3}, of.end), array_of({3, 3}, of.covariance),
                              array_of({3, 2}, of.by_calibration),
                              array_of({3, 3}, whitener_of(of.covariance.data(), least))));
  }
  return out;
}

py::tuple odometry_residuals(const Array& starts, const Array& ends, const Array& deltas) {
  const Index m = deltas.shape(0);
  expect(starts.size() == 3 * m && ends.size() == 3 * m && deltas.size() == 3 * m);
  const double pi = std::acos(-1.0);
  Array residuals(Shape{m, 3}), by_start(Shape{m, 3, 3}), by_end(Shape{m, 3, 3});
  for (Index i = 0; i < m; ++i) {
    const double* x = starts.data() + 3 * i;
    const double* y = ends.data() + 3 * i;
    const double* d = deltas.data() + 3 * i;
    const double angle = x[2] + d[2];
    const Turn turn(angle), delta(d[2]);
    const double ox = y[0] - x[0], oy = y[1] - x[1];
    const double along = turn.c * ox + turn.s * oy, across = -turn.s * ox + turn.c * oy;
    const double dx = along - (delta.c * d[0] + delta.s * d[1]);
    const double dy = across - (delta.c * d[1] - delta.s * d[0]);
    double wrapped = std::fmod(pi - (y[2] - angle), 2.0 * pi);
    if (wrapped < 0.0) wrapped += 2.0 * pi;
    const double phi = -(wrapped - pi), h = 0.5 * phi;
    double a = 1.0 - phi * phi / 12.0, slope = -phi / 6.0;
    if (!(std::abs(phi) < 1e-3)) {
      const double cot = 1.0 / std::tan(h);
      a = h * cot;
      slope = 0.5 * cot - 0.5 * h * (1.0 + cot * cot);
    }
    double* r = residuals.mutable_data() + 3 * i;
    r[0] = a * dx + h * dy, r[1] = a * dy - h * dx, r[2] = phi;
    double* E = by_end.mutable_data() + 9 * i;
    const double c = turn.c, s = turn.s;
    const double values[9] = {a * c - h * s,
                              a * s + h * c,
                              slope * dx + 0.5 * dy,
                              -a * s - h * c,
                              a * c - h * s,
                              slope * dy - 0.5 * dx,
                              0.0,
                              0.0,
                              1.0};
    double* S = by_start.mutable_data() + 9 * i;
    for (int k = 0; k < 9; ++k) E[k] = values[k], S[k] = -values[k];
    S[2] += a * across - h * along;
    S[5] += -a * along - h * across;
  }
  return py::make_tuple(residuals, by_start, by_end);
}

py::tuple whitened_odometry(const Array& starts, const Array& ends, const Array& deltas,
                            const Array& whiteners, const Array& by_calibration, const Array& calibration) {
  const Index m = deltas.shape(0);
  expect(whiteners.size() == 9 * m && by_calibration.size() == 6 * m && calibration.size() == 2);
  const py::tuple own = odometry_residuals(starts, ends, deltas);
  const Array plain = own[0].cast<Array>(), by_start = own[1].cast<Array>(), by_end = own[2].cast<Array>();
  Array residual(Shape{m, 3}), jacobian(Shape{m, 3, 8});
  for (Index i = 0; i < m; ++i) {
    const double* G = by_calibration.data() + 6 * i;
    double D[3][9];
    for (int r = 0; r < 3; ++r) {
      std::copy_n(G + 2 * r, 2, D[r]);
      std::copy_n(by_start.data() + 9 * i + 3 * r, 3, D[r] + 2);
      std::copy_n(by_end.data() + 9 * i + 3 * r, 3, D[r] + 5);
      D[r][8] =
          plain.data()[3 * i + r] + (G[2 * r] * calibration.data()[0] + G[2 * r + 1] * calibration.data()[1]);
    }
    for (int r = 0; r < 3; ++r) {
      const double* W = whiteners.data() + 9 * i + 3 * r;
      double* J = jacobian.mutable_data() + 24 * i + 8 * r;
      for (int c = 0; c < 8; ++c) J[c] = W[0] * D[0][c] + W[1] * D[1][c] + W[2] * D[2][c];
      residual.mutable_data()[3 * i + r] = W[0] * D[0][8] + W[1] * D[1][8] + W[2] * D[2][8];
    }
  }
  return py::make_tuple(residual, jacobian);
}

}  // namespace

void add_odometry(py::module_& module) {
  module.def("whitened_odometry", &whitened_odometry);
  module.def("along_and_across", &along_and_across);
  module.def("odometry_residuals", &odometry_residuals);
  module.def("integrated", &integrated);
}

}  // namespace kernels
