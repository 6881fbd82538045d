// The search for the point of a curve that is nearest to a given one.

#pragma once

#include "common.hpp"

namespace kernels {

constexpr int kSafeguarded = 50;  // most steps of a row that a Newton step has led farther away
constexpr double kStepTolerance =
    1e-9;                        // a row's last step, by the length of the domain; the error is its square
constexpr double kFlat = 1e-12;  // f' counts as zero where |f'| <= this * |S'|^2
constexpr double kEqualSquare = 1e-12;  // squared distances d, e (m^2) differ where e > d + this * (1 + d)
constexpr double kEndTolerance =
    1e-9;  // a foot point this near (by the length of the domain) to an end is at it
constexpr double kNoTangent =
    1e-12;  // S' vanishes where |S'| <= this * largest coordinate / length of the domain
constexpr double kTiny = 1e-300;  // smallest divisor of a step; the numerator vanishes before it does

// One of the curves that are searched together.
struct Curve {
  Curve(const py::object& basis, Index offset, Index distinct, double shift);

  Index column(Index span, Index j) const { return offset + (distinct ? (span + j) % distinct : span + j); }

  double low, high, interval, shift;
  Index degree, spans, stride;  // spans up to the last that is not empty, and all
  Index offset, distinct;       // first control point, and their number if they are wrapped, else 0
  std::vector<double> starts;   // of the spans, of three periods where the curve is closed
  Array coefficients, inverse;  // of the basis, and one over the widths of spans
};

// Curves of one degree, all periodic or none (_kernels.pyi).
class Curves {
 public:
  Curves(const py::sequence& bases, const std::vector<Index>& offsets, const std::vector<Index>& distinct);

  py::tuple search(const Array& control_points, const Array& points, const Ints& curve, const Array& u_low,
                   const Array& u_high, double coarse_step, int iterations) const;
  py::tuple refine(const Array& control_points, const Array& points, const Ints& curve, const Array& u_start,
                   const Array& u_low, const Array& u_high, int iterations) const;

  Index degree;
  bool periodic;
  std::vector<Curve> all;
  std::vector<Index> first;  // number of the first span of each curve, among those of all
};

struct Probe {
  double v, s, offset[2], first[2], square, slope, step;
  Index span;
};

struct Stretch {
  double begin, end, low, high, floor, ceiling, interval;
  double length() const { return end - begin; }
  double within(double v) const { return clipped(v, floor, ceiling); }
};

class Search {
 public:
  Search(const Curves& curves, const Array& control_points, const Array& points, const Ints& curve,
         const Array& u_low, const Array& u_high)
      : curves_(curves),
        points_(points),
        curve_(curve),
        size_(points.shape(0)),
        control_points_(control_points.data()),
        is_known_(curves.first.back(), false),
        polynomials_(new double[is_known_.size() * 6 * (curves.degree + 1)]) {
    expect(points.size() == 2 * size_ && curve.size() == size_);
    expect(u_low.size() == size_ && u_high.size() == size_);
    stretches(u_low.data(), u_high.data());
  }

  void nearest_on_grid(double step);
  void start_at(const double* u);
  void descend(const std::vector<Index>& rows, std::vector<double> reach, int iterations);
  void refine(int iterations);
  py::tuple finish(const Array& control_points) const;

  std::vector<Index> all() const {
    std::vector<Index> rows(size_);
    for (Index i = 0; i < size_; ++i) rows[i] = i;
    return rows;
  }
  std::vector<double> reach(double by) const { return std::vector<double>(size_, by); }

 private:
  const Curve& on(Index row) const { return curves_.all[curve_.data()[row]]; }

  // C (3, p + 1, 2) of a span, on which d^r S / du^r = sum_k C[r, k] s^k; most spans are never asked for.
  const double* polynomials(Index curve, Index span) const {
    const Curve& own = curves_.all[curve];
    const Index p = curves_.degree + 1, number = curves_.first[curve] + span;
    double* out = &polynomials_[number * 3 * p * 2];
    if (is_known_[number]) return out;
    is_known_[number] = true;
    const double inverse = own.inverse.data()[span], scale[3] = {1.0, inverse, inverse * inverse};
    for (Index k = 0; k < p; ++k)
      for (Index r = 0; r < 3; ++r) {
        double x = 0.0, y = 0.0;
        if (k + r < p) {
          const double* row = own.coefficients.data() + ((k + r) * own.stride + span) * p;
          double factor = 1.0;  // (k + r)! / k!
          for (Index f = k + 1; f <= k + r; ++f) factor *= static_cast<double>(f);
          for (Index j = 0; j < p; ++j) {
            const double* at = control_points_ + 2 * own.column(span, j);
            const double by = row[j] * factor * scale[r];
            x += by * at[0];
            y += by * at[1];
          }
        }
        out[(r * p + k) * 2] = x, out[(r * p + k) * 2 + 1] = y;
      }
    return out;
  }

  void stretches(const double* u_low, const double* u_high) {
    stretch_.resize(size_);
    for (Index i = 0; i < size_; ++i) {
      expect(curve_.data()[i] >= 0 && curve_.data()[i] < static_cast<Index>(curves_.all.size()));
      const Curve& own = on(i);
      const double begin = own.low, end = own.high;
      double low = u_low[i] + own.shift, high = u_high[i] + own.shift;
      double floor, ceiling;
      if (!curves_.periodic) {
        low = clipped(low, begin, end);
        high = std::max(low, std::min(high, end));
        floor = low, ceiling = high;
      } else {
        const double period = end - begin;
        const bool whole = !(high - low < period);
        if (whole) low = begin, high = end;
        const double turns = period * std::floor((low - begin) / period);
        high = std::max(low, high) - turns;
        low -= turns;
        floor = whole ? -kInfinity : low, ceiling = whole ? kInfinity : high;
      }
      stretch_[i] = {begin, end, low, high, floor, ceiling, own.interval};
    }
  }

  Index locate(Index curve, double v, double* s) const {
    const Curve& own = curves_.all[curve];
    const Index laid = std::upper_bound(own.starts.begin() + 1, own.starts.end(), v) - own.starts.begin() - 1;
    const Index span = laid % own.spans;
    *s = (v - own.starts[laid]) * own.inverse.data()[span];
    return span;
  }

  void evaluate(Index curve, Index span, double s, int order, double* out) const {
    const Index p = curves_.degree + 1;
    const double* terms = polynomials(curve, span) + order * p * 2;
    double x = terms[2 * (p - 1)], y = terms[2 * (p - 1) + 1];
    for (Index k = p - 2; k >= 0; --k) x = x * s + terms[2 * k], y = y * s + terms[2 * k + 1];
    out[0] = x, out[1] = y;
  }

  Probe probe(Index row, double v) const {
    Probe at;
    double second[2];
    at.v = v;
    const Index curve = curve_.data()[row];
    at.span = locate(curve, v, &at.s);
    evaluate(curve, at.span, at.s, 0, at.offset);
    evaluate(curve, at.span, at.s, 1, at.first);
    evaluate(curve, at.span, at.s, 2, second);
    at.offset[0] -= points_.data()[2 * row];
    at.offset[1] -= points_.data()[2 * row + 1];
    at.square = at.offset[0] * at.offset[0] + at.offset[1] * at.offset[1];
    at.slope = at.first[0] * at.offset[0] + at.first[1] * at.offset[1];
    const double speed = at.first[0] * at.first[0] + at.first[1] * at.first[1];
    const double curvature = std::abs(speed + (second[0] * at.offset[0] + second[1] * at.offset[1]));
    const double divisor = curvature > kFlat * speed ? curvature : speed;
    at.step = -at.slope / std::max(divisor, kTiny);
    return at;
  }

  bool no_farther(double square, double than) const { return square <= than + kEqualSquare * (1.0 + than); }

  const Curves& curves_;
  Array points_;
  Ints curve_;
  Index size_;
  const double* control_points_;  // of the caller, who holds them
  mutable std::vector<char> is_known_;
  std::unique_ptr<double[]> polynomials_;
  std::vector<Stretch> stretch_;
  std::vector<Probe> probe_;
};

}  // namespace kernels
