// Usable detections (`front_end/gate.py`) and their measured noise.

#include "detections.hpp"

namespace kernels {
namespace {

py::tuple usable(const Array& points, const Array& covariances, const py::tuple& limits) {
  const Index m = points.shape(0);
  expect(points.size() == 2 * m && covariances.size() == 4 * m);
  const double min_range = limits[0].cast<double>(), max_range = limits[1].cast<double>();
  const double asymmetry = limits[2].cast<double>(), determinant = limits[3].cast<double>();
  const double min_sigma = limits[4].cast<double>(), max_sigma = limits[5].cast<double>();
  py::array_t<bool> near(m), definite(m);
  for (Index i = 0; i < m; ++i) {
    const double* K = covariances.data() + 4 * i;
    const double distance = std::hypot(points.data()[2 * i], points.data()[2 * i + 1]);
    near.mutable_data()[i] = distance >= min_range && distance <= max_range;
    const double det = K[0] * K[3] - K[1] * K[2];
    const double largest = 0.5 * (K[0] + K[3]) + std::hypot(0.5 * (K[0] - K[3]), K[1]);
    definite.mutable_data()[i] = K[0] > 0.0 && K[3] > 0.0 && std::abs(K[1] - K[2]) <= asymmetry * largest &&
                                 det > determinant * K[0] * K[3] && det >= min_sigma * min_sigma * largest &&
                                 largest <= max_sigma * max_sigma;
  }
  return py::make_tuple(near, definite);
}

// --- measured noise ---------------------------------------------------------------------------------------

py::tuple centred(const Ints& begins, const Array& information, const Array& columns, const Array& points) {
  constexpr Index kErrors = kSensor + 2, kBoth = kErrors + 1;
  const Index cones = begins.size(), n = points.shape(0);
  expect(information.size() == 4 * n && columns.size() == 2 * kErrors * n && points.size() == 2 * n);
  Array moved(Shape{n, 2, kErrors}), off(Shape{n, 2}), own(Shape{cones, kErrors, kErrors});
  Array vectors(Shape{cones, kErrors});
  const double* W = information.data();
  for (Index c = 0; c < cones; ++c) {
    const Index begin = begins.data()[c], end = c + 1 < cones ? begins.data()[c + 1] : n;
    expect(0 <= begin && begin <= end && end <= n);
    double total[4] = {}, inverse[4], sums[2][kBoth] = {}, mean[2][kBoth], products[kErrors][kBoth] = {};
    for (Index i = begin; i < end; ++i) {
      const double *w = W + 4 * i, *A = columns.data() + 2 * kErrors * i, *p = points.data() + 2 * i;
      for (int k = 0; k < 4; ++k) total[k] += w[k];
      for (Index j = 0; j < kBoth; ++j) {
        const double x = j < kErrors ? A[j] : p[0], y = j < kErrors ? A[kErrors + j] : p[1];
        sums[0][j] += w[0] * x + w[1] * y;
        sums[1][j] += w[2] * x + w[3] * y;
      }
    }
    inverse2(total, inverse);
    for (int a = 0; a < 2; ++a)
      for (Index j = 0; j < kBoth; ++j)
        mean[a][j] = inverse[2 * a] * sums[0][j] + inverse[2 * a + 1] * sums[1][j];
    for (Index i = begin; i < end; ++i) {
      const double* w = W + 4 * i;
      double both[2][kBoth], weighted[2][kBoth];
      for (int a = 0; a < 2; ++a) {
        const Index row = 2 * i + a;
        for (Index j = 0; j < kErrors; ++j)
          both[a][j] = moved.mutable_data()[kErrors * row + j] =
              columns.data()[kErrors * row + j] - mean[a][j];
        both[a][kErrors] = off.mutable_data()[row] = points.data()[row] - mean[a][kErrors];
      }
      for (int a = 0; a < 2; ++a)
        for (Index j = 0; j < kBoth; ++j) weighted[a][j] = w[2 * a] * both[0][j] + w[2 * a + 1] * both[1][j];
      for (Index j = 0; j < kErrors; ++j)
        for (Index k = 0; k < kBoth; ++k)
          products[j][k] += both[0][j] * weighted[0][k] + both[1][j] * weighted[1][k];
    }
    for (Index j = 0; j < kErrors; ++j) {
      std::copy_n(products[j], kErrors, own.mutable_data() + kErrors * (kErrors * c + j));
      vectors.mutable_data()[kErrors * c + j] = products[j][kErrors];
    }
  }
  return py::make_tuple(moved, off, own, vectors);
}

Array by_constants(const Array& seen, const Array& twists, const Array& poses, const Array& by_bias,
                   const Ints& first, double bends_from) {
  const Index n = seen.shape(0), width = kSensor + 2;
  expect(seen.size() == 2 * n && twists.size() == 3 * n && poses.size() == 3 * n);
  expect(by_bias.size() == 3 * n && first.size() == n);
  Array columns(Shape{n, 2, width});
  double C[2][kSensor];
  for (Index i = 0; i < n; ++i) {
    const Index at = first.data()[i];
    expect(0 <= at && at < n);
    const double *z = seen.data() + 2 * i, *pose = poses.data() + 3 * i, *began = poses.data() + 3 * at;
    const double *bias = by_bias.data() + 3 * i, *then = by_bias.data() + 3 * at;
    const Turn turn(pose[2]);
    double* out = columns.mutable_data() + 2 * width * i;
    sensor_columns(z, twists.data() + 3 * i, C);
    for (Index k = 0; k < kSensor; ++k) {
      out[k] = turn.c * C[0][k] - turn.s * C[1][k];
      out[width + k] = turn.s * C[0][k] + turn.c * C[1][k];
    }
    const double x = turn.c * z[0] - turn.s * z[1], y = turn.s * z[0] + turn.c * z[1],
                 turned = bias[2] - then[2];
    const double distance = std::hypot(z[0], z[1]), beyond = std::max(distance - bends_from, 0.0);
    const double bend = beyond * beyond / std::max(distance, bends_from);
    out[kSensor] = -bend * x;
    out[width + kSensor] = -bend * y;
    out[kSensor + 1] = bias[0] - then[0] + then[2] * (pose[1] - began[1]) - turned * y;
    out[width + kSensor + 1] = bias[1] - then[1] - then[2] * (pose[0] - began[0]) + turned * x;
  }
  return columns;
}

py::tuple references(const Ints& cone, const Array& t, const Array& ranges, const Array& weight,
                     const Array& values, const py::tuple& sought) {
  const Index n = cone.size(), width = values.shape(1);
  const double share = sought[0].cast<double>(), time = sought[1].cast<double>();
  expect(t.size() == n && ranges.size() == n && weight.size() == n && values.shape(0) == n);
  std::vector<Index> rows, counts;
  std::vector<double> means, sums(1 + width);
  for (Index begin = 0, end = 0; begin < n; begin = end) {
    while (end < n && cone.data()[end] == cone.data()[begin]) ++end;
    for (Index i = begin; i < end; ++i) {
      Index count = 0;
      double total = 0.0;
      std::fill(sums.begin(), sums.end(), 0.0);
      for (Index j = begin; j < end; ++j) {
        const double lag = std::abs(t.data()[j] - t.data()[i]), w = weight.data()[j];
        if (!(lag < time && ranges.data()[j] < share * ranges.data()[i])) continue;
        ++count, total += w, sums[0] += w * lag;
        for (Index k = 0; k < width; ++k) sums[1 + k] += w * values.data()[width * j + k];
      }
      if (count < 2) continue;
      rows.push_back(i), counts.push_back(count);
      for (const double sum : sums) means.push_back(sum / total);
    }
  }
  const Index k = rows.size();
  return py::make_tuple(Ints(k, rows.data()), Ints(k, counts.data()),
                        Array(Shape{k, 1 + width}, means.data()));
}

}  // namespace

void add_noise(py::module_& module) {
  module.def("centred", &centred);
  module.def("by_constants", &by_constants);
  module.def("references", &references);
  module.def("usable", &usable);
}

}  // namespace kernels
