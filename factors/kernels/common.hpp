// Types, checks and small algebra that all kernels share.

#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <stdexcept>
#include <vector>

namespace kernels {

namespace py = pybind11;

using Index = py::ssize_t;
using Array = py::array_t<double, py::array::c_style | py::array::forcecast>;
using Ints = py::array_t<Index, py::array::c_style | py::array::forcecast>;
using Columns = py::array_t<double, py::array::f_style>;
using Shape = std::vector<Index>;
using Pose = std::array<double, 3>;     // x, y and heading
using Matrix3 = std::array<double, 9>;  // (3, 3), row after row

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kTurn = 6.283185307179586;

inline double clipped(double v, double low, double high) { return std::min(std::max(v, low), high); }

inline void expect(bool fits) {
  if (!fits) throw py::value_error("expected arrays of shapes that fit each other");
}

template <size_t n>
Array array_of(const Shape& shape, const std::array<double, n>& values) {
  return Array(shape, values.data());
}

inline Pose pose_of(const Array& values) {
  expect(values.size() == 3);
  return {values.data()[0], values.data()[1], values.data()[2]};
}

struct Turn {
  explicit Turn(double theta) : c(std::cos(theta)), s(std::sin(theta)) {}
  double c, s;
};

// The pose (3,) of a motion (3,) from a pose.
inline Pose compose(const Pose& pose, const Pose& delta) {
  const Turn turn(pose[2]);
  return {pose[0] + turn.c * delta[0] - turn.s * delta[1], pose[1] + turn.s * delta[0] + turn.c * delta[1],
          pose[2] + delta[2]};
}

// The motion (3,) from a pose to another one.
inline Pose relative(const Pose& pose, const Pose& other) {
  const Turn turn(pose[2]);
  const double dx = other[0] - pose[0], dy = other[1] - pose[1];
  return {turn.c * dx + turn.s * dy, -turn.s * dx + turn.c * dy, other[2] - pose[2]};
}

// Turn the pairs from each of `columns` on by an angle with this cosine and sine.
inline void turn_pairs(double* values, const Ints& columns, double c, double s) {
  for (Index k = 0; k < columns.size(); ++k) {
    double* at = values + columns.data()[k];
    const double x = at[0], y = at[1];
    at[0] = c * x - s * y, at[1] = s * x + c * y;
  }
}

// Move values from the map frame into that of a pose: graph.inactive:to_frame.
inline void to_frame(double* values, const Ints& turning, const Ints& headings, const double* frame,
                     const Turn& turn) {
  for (Index k = 0; k < turning.size(); ++k) {
    double* at = values + turning.data()[k];
    at[0] -= frame[0], at[1] -= frame[1];
  }
  turn_pairs(values, turning, turn.c, -turn.s);
  for (Index k = 0; k < headings.size(); ++k) values[headings.data()[k]] -= frame[2];
}

// The diagonal matrix of squares.
inline Matrix3 squares_of(const Pose& values) {
  Matrix3 out{};
  for (int i = 0; i < 3; ++i) out[4 * i] = values[i] * values[i];
  return out;
}

// T M T' with T the turn by an angle, for a matrix (3, 3) about a pose.
inline Matrix3 turned(const Matrix3& M, double angle) {
  const Turn turn(angle);
  const double T[3][3] = {{turn.c, -turn.s, 0.0}, {turn.s, turn.c, 0.0}, {0.0, 0.0, 1.0}};
  Matrix3 out{};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) out[3 * i + j] += T[i][a] * M[3 * a + b] * T[j][b];
  return out;
}

// Solve A x = b for three unknowns by elimination with pivoting, in place.
inline void solve3(double (*A)[3], double* b) {
  for (int k = 0; k < 3; ++k) {
    int best = k;
    for (int i = k + 1; i < 3; ++i)
      if (std::abs(A[i][k]) > std::abs(A[best][k])) best = i;
    if (best != k) std::swap_ranges(A[k], A[k] + 3, A[best]), std::swap(b[k], b[best]);
    for (int i = k + 1; i < 3; ++i) {
      const double by = A[i][k] / A[k][k];
      for (int j = k + 1; j < 3; ++j) A[i][j] -= by * A[k][j];
      b[i] -= by * b[k];
    }
  }
  for (int k = 2; k >= 0; --k) {
    for (int j = k + 1; j < 3; ++j) b[k] -= A[k][j] * b[j];
    b[k] /= A[k][k];
  }
}

inline Pose solved(const Matrix3& matrix, Pose b) {
  double A[3][3];
  for (int i = 0; i < 9; ++i) A[i / 3][i % 3] = matrix[i];
  solve3(A, b.data());
  return b;
}

inline Matrix3 inverse3(const Matrix3& matrix) {
  Matrix3 out;
  for (int c = 0; c < 3; ++c) {
    Pose unit{};
    unit[c] = 1.0;
    const Pose column = solved(matrix, unit);
    for (int r = 0; r < 3; ++r) out[3 * r + c] = column[r];
  }
  return out;
}

// The inverse of a matrix (2, 2), row after row.
inline void inverse2(const double* A, double* out) {
  const double det = A[0] * A[3] - A[1] * A[2];
  out[0] = A[3] / det, out[1] = -A[1] / det, out[2] = -A[2] / det, out[3] = A[0] / det;
}

}  // namespace kernels
