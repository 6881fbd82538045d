// The search for the point of a curve that is nearest to a given one.

#pragma once

#include "common.hpp"

namespace kernels {

struct Tolerances {  // the constants of footpoint.py
  double step, flat, equal, end, tangent, tiny;
};

struct Spans {  // factors.bspline:Spans
  explicit Spans(const py::object& spans)
      : degree(spans.attr("degree").cast<Index>()),
        first(spans.attr("first").cast<Index>()),
        periodic(spans.attr("periodic").cast<bool>()),
        low(spans.attr("low").cast<Array>()),
        high(spans.attr("high").cast<Array>()),
        shift(spans.attr("shift").cast<Array>()),
        interval(spans.attr("interval").cast<Array>()),
        starts(spans.attr("starts").cast<Array>()),
        inverse(spans.attr("inverse_widths").cast<Array>()),
        by_span(spans.attr("by_span").cast<Array>()),
        values(spans.attr("values").cast<Array>()),
        columns(spans.attr("columns").cast<Ints>()),
        number(spans.attr("number").cast<Ints>()) {}

  Index degree, first;
  bool periodic;
  Array low, high, shift, interval, starts, inverse, by_span, values;
  Ints columns, number;
};

struct Probe {
  double v, s, offset[2], first[2], square, slope, step;
  Index number;
};

struct Stretch {
  double begin, end, low, high, floor, ceiling, interval;
  double length() const { return end - begin; }
  double within(double v) const { return clipped(v, floor, ceiling); }
};

class Search {
 public:
  Search(const py::object& spans, const Array& control_points, const Array& points, const Ints& curve,
         const Array& u_low, const Array& u_high, const Tolerances& tolerances)
      : spans_(spans),
        points_(points),
        curve_(curve),
        eps_(tolerances),
        size_(points.shape(0)),
        control_points_(control_points.data()),
        is_known_(spans_.columns.shape(0), false),
        polynomials_(new double[is_known_.size() * 6 * (spans_.degree + 1)]) {
    expect(points.size() == 2 * size_ && curve.size() == size_);
    expect(u_low.size() == size_ && u_high.size() == size_);
    stretches(u_low.data(), u_high.data());
  }

  void nearest_on_grid(double step);
  void start_at(const double* u);
  void descend(const std::vector<Index>& rows, std::vector<double> reach, int iterations);
  void refine(int iterations, int safeguarded);
  py::tuple finish(const Array& control_points) const;

  std::vector<Index> all() const {
    std::vector<Index> rows(size_);
    for (Index i = 0; i < size_; ++i) rows[i] = i;
    return rows;
  }
  std::vector<double> reach(double by) const { return std::vector<double>(size_, by); }

 private:
  // C (3, p + 1, 2) of a span, on which d^r S / du^r = sum_k C[r, k] s^k; most spans are never asked for.
  const double* polynomials(Index span) const {
    const Index p = spans_.degree + 1;
    double* own = &polynomials_[span * 3 * p * 2];
    if (is_known_[span]) return own;
    is_known_[span] = true;
    const Index* columns = spans_.columns.data() + span * p;
    for (Index k = 0; k < p; ++k)
      for (Index r = 0; r < 3; ++r) {
        const double* row = spans_.by_span.data() + (span * 3 * p + k * 3 + r) * p;
        double x = 0.0, y = 0.0;
        for (Index j = 0; j < p; ++j) {
          x += row[j] * control_points_[2 * columns[j]];
          y += row[j] * control_points_[2 * columns[j] + 1];
        }
        double* at = own + (r * p + k) * 2;
        at[0] = x, at[1] = y;
      }
    return own;
  }

  void stretches(const double* u_low, const double* u_high) {
    stretch_.resize(size_);
    for (Index i = 0; i < size_; ++i) {
      const Index k = curve_.data()[i];
      const double begin = spans_.low.data()[k], end = spans_.high.data()[k];
      double low = u_low[i] + spans_.shift.data()[k], high = u_high[i] + spans_.shift.data()[k];
      double floor, ceiling;
      if (!spans_.periodic) {
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
      stretch_[i] = {begin, end, low, high, floor, ceiling, spans_.interval.data()[k]};
    }
  }

  Index locate(double v, double* s) const {
    const double* starts = spans_.starts.data();
    const Index laid = std::upper_bound(starts + 1, starts + spans_.starts.shape(0), v) - (starts + 1);
    *s = (v - starts[laid]) * spans_.inverse.data()[laid];
    return spans_.periodic ? spans_.number.data()[laid] : laid;
  }

  void evaluate(Index number, double s, int order, double* out) const {
    const Index p = spans_.degree + 1;
    const double* terms = polynomials(number) + order * p * 2;
    double x = terms[2 * (p - 1)], y = terms[2 * (p - 1) + 1];
    for (Index k = p - 2; k >= 0; --k) x = x * s + terms[2 * k], y = y * s + terms[2 * k + 1];
    out[0] = x, out[1] = y;
  }

  Probe probe(Index row, double v) const {
    Probe at;
    double second[2];
    at.v = v;
    at.number = locate(v, &at.s);
    evaluate(at.number, at.s, 0, at.offset);
    evaluate(at.number, at.s, 1, at.first);
    evaluate(at.number, at.s, 2, second);
    at.offset[0] -= points_.data()[2 * row];
    at.offset[1] -= points_.data()[2 * row + 1];
    at.square = at.offset[0] * at.offset[0] + at.offset[1] * at.offset[1];
    at.slope = at.first[0] * at.offset[0] + at.first[1] * at.offset[1];
    const double speed = at.first[0] * at.first[0] + at.first[1] * at.first[1];
    const double curvature = std::abs(speed + (second[0] * at.offset[0] + second[1] * at.offset[1]));
    const double divisor = curvature > eps_.flat * speed ? curvature : speed;
    at.step = -at.slope / std::max(divisor, eps_.tiny);
    return at;
  }

  bool no_farther(double square, double than) const { return square <= than + eps_.equal * (1.0 + than); }

  Spans spans_;
  Array points_;
  Ints curve_;
  Tolerances eps_;
  Index size_;
  const double* control_points_;  // of the caller, who holds them
  mutable std::vector<char> is_known_;
  std::unique_ptr<double[]> polynomials_;
  std::vector<Stretch> stretch_;
  std::vector<Probe> probe_;
};

// Foot points from nowhere, by a grid with a step (m) at most.
py::tuple searched(const py::object& spans, const Array& control_points, const Array& points,
                   const Ints& curve, const Array& u_low, const Array& u_high, double coarse_step,
                   int iterations, const py::tuple& tolerances);

// Foot points from parameters nearby.
py::tuple refined(const py::object& spans, const Array& control_points, const Array& points,
                  const Ints& curve, const Array& u, const Array& u_low, const Array& u_high, int iterations,
                  int safeguarded, const py::tuple& tolerances);

}  // namespace kernels
