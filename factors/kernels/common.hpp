// Types, checks and small algebra that all kernels share.

#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
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

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kTurn = 6.283185307179586;

inline double clipped(double v, double low, double high) { return std::min(std::max(v, low), high); }

inline void expect(bool fits) {
  if (!fits) throw py::value_error("expected arrays of shapes that fit each other");
}

struct Turn {
  explicit Turn(double theta) : c(std::cos(theta)), s(std::sin(theta)) {}
  double c, s;
};

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

// The inverse of a matrix (3, 3), row after row.
inline void inverse3(const double* matrix, double* out) {
  for (int c = 0; c < 3; ++c) {
    double A[3][3], column[3] = {0.0, 0.0, 0.0};
    std::copy_n(matrix, 9, &A[0][0]);
    column[c] = 1.0;
    solve3(A, column);
    for (int r = 0; r < 3; ++r) out[3 * r + c] = column[r];
  }
}

// The inverse of a matrix (2, 2), row after row.
inline void inverse2(const double* A, double* out) {
  const double det = A[0] * A[3] - A[1] * A[2];
  out[0] = A[3] / det, out[1] = -A[1] / det, out[2] = -A[2] / det, out[3] = A[0] / det;
}

}  // namespace kernels
