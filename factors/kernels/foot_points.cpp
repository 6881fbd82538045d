// Foot points: `factors/footpoint.py` says what is searched.

#include "foot_points.hpp"

#include <pybind11/stl.h>

namespace kernels {

Curve::Curve(const py::object& basis, Index offset, Index distinct, double shift)
    : low(basis.attr("low").cast<double>() + shift),
      high(basis.attr("high").cast<double>() + shift),
      shift(shift),
      degree(basis.attr("degree").cast<Index>()),
      spans(basis.attr("occupied").cast<Index>()),
      offset(offset),
      distinct(distinct),
      coefficients(basis.attr("coefficients").cast<Array>()),
      inverse(basis.attr("inverse_widths").cast<Array>()) {
  const Array begins = basis.attr("starts").cast<Array>();
  const bool periodic = basis.attr("periodic").cast<bool>();
  const double length = basis.attr("length").cast<double>();
  stride = begins.size();
  interval = length / static_cast<double>(stride);
  expect(spans > 0 && spans <= stride && inverse.size() == stride);
  expect(coefficients.size() == (degree + 1) * (degree + 1) * stride);
  for (int period = periodic ? -1 : 0; period <= (periodic ? 1 : 0); ++period)
    for (Index span = 0; span < spans; ++span)
      starts.push_back((begins.data()[span] + length * period) + shift);
}

Curves::Curves(const py::sequence& bases, const std::vector<Index>& offsets,
               const std::vector<Index>& distinct) {
  expect(bases.size() > 0 && offsets.size() == bases.size());
  expect(distinct.empty() || distinct.size() == bases.size());
  first.push_back(0);
  double end = 0.0;
  for (size_t k = 0; k < bases.size(); ++k) {
    const py::object basis = bases[k];
    const bool is_periodic = basis.attr("periodic").cast<bool>();
    const double length = is_periodic ? basis.attr("length").cast<double>() : 0.0;
    const double low = basis.attr("low").cast<double>(), high = basis.attr("high").cast<double>();
    const double shift = k ? std::ceil(end - (low - length) + 1.0) : 0.0;
    end = high + length + shift;
    all.emplace_back(basis, offsets[k], is_periodic && !distinct.empty() ? distinct[k] : 0, shift);
    if (k == 0) degree = all[0].degree, periodic = is_periodic;
    expect(all[k].degree == degree && is_periodic == periodic);
    first.push_back(first.back() + all[k].spans);
  }
}

// The grid of each curve reaches over the stretches of all rows on it, as in Python.
void Search::nearest_on_grid(double step) {
  const Index curves = static_cast<Index>(curves_.all.size());
  std::vector<double> least(curves, kInfinity), most(curves, -kInfinity);
  for (Index i = 0; i < size_; ++i) {
    const Index k = curve_.data()[i];
    least[k] = std::min(least[k], stretch_[i].low);
    most[k] = std::max(most[k], stretch_[i].high);
  }
  std::vector<std::vector<double>> on_grid(curves);
  for (Index k = 0; k < curves; ++k) {
    if (least[k] == kInfinity) continue;
    const Index count = std::max<Index>(static_cast<Index>(std::ceil((most[k] - least[k]) / step)), 1) + 1;
    on_grid[k].resize(2 * count);
    for (Index g = 0; g < count; ++g) {
      double s;
      const Index span = locate(k, least[k] + step * static_cast<double>(g), &s);
      evaluate(k, span, s, 0, &on_grid[k][2 * g]);
    }
  }
  probe_.resize(size_);
  for (Index i = 0; i < size_; ++i) {
    const Index k = curve_.data()[i];
    const Stretch& stretch = stretch_[i];
    const double x = points_.data()[2 * i], y = points_.data()[2 * i + 1];
    const Index count = static_cast<Index>(on_grid[k].size() / 2);
    const Index from = std::max<Index>(static_cast<Index>((stretch.low - least[k]) / step) - 1, 0);
    double best = kInfinity, place = stretch.low;
    for (Index g = from; g < count; ++g) {
      const double v = least[k] + step * static_cast<double>(g);
      if (v > stretch.high) break;
      const double dx = x - on_grid[k][2 * g], dy = y - on_grid[k][2 * g + 1];
      const double square = dx * dx + dy * dy;
      if (v >= stretch.low && square < best) best = square, place = v;
    }
    for (double v : {stretch.low, stretch.high}) {
      double s, at[2];
      const Index span = locate(k, v, &s);
      evaluate(k, span, s, 0, at);
      const double square = (at[0] - x) * (at[0] - x) + (at[1] - y) * (at[1] - y);
      if (square < best) best = square, place = v;
    }
    probe_[i] = probe(i, place);
  }
}

void Search::start_at(const double* u) {
  probe_.resize(size_);
  for (Index i = 0; i < size_; ++i) {
    const Stretch& stretch = stretch_[i];
    double v = u[i] + on(i).shift;
    if (!curves_.periodic) {
      v = clipped(v, stretch.low, stretch.high);
    } else {
      const double period = stretch.length();
      double ahead = std::fmod(v - stretch.low, period);
      if (ahead < 0.0) ahead += period;
      const double inside = stretch.low + ahead;
      v = inside;
      if (!(inside <= stretch.high))
        v = inside - stretch.high < stretch.low + period - inside ? stretch.high : stretch.low;
    }
    probe_[i] = probe(i, v);
  }
}

void Search::descend(const std::vector<Index>& rows, std::vector<double> reach, int iterations) {
  const Index count = static_cast<Index>(rows.size());
  std::vector<double> end(count), step(count);
  std::vector<Probe> next(count);
  for (Index r = 0; r < count; ++r) {
    const Probe& best = probe_[rows[r]];
    const double sign = (best.slope > 0.0) - (best.slope < 0.0);
    end[r] = best.v - sign * reach[rows[r]];
    step[r] = best.step;
  }
  for (int iteration = 0; iteration < iterations; ++iteration) {
    bool moves = false;
    for (Index r = 0; r < count; ++r) {
      const Probe& best = probe_[rows[r]];
      const Stretch& stretch = stretch_[rows[r]];
      const bool inside = std::abs(step[r]) < std::abs(end[r] - best.v);
      const double v = stretch.within(inside ? best.v + step[r] : 0.5 * (best.v + end[r]));
      next[r] = probe(rows[r], v);
      moves |= std::abs(v - best.v) > kStepTolerance * stretch.length();
    }
    for (Index r = 0; r < count; ++r) {
      Probe& best = probe_[rows[r]];
      if (!moves) {
        best = next[r];
      } else if (no_farther(next[r].square, best.square)) {
        if (next[r].slope * best.slope <= 0.0) end[r] = best.v;
        step[r] = next[r].step;
        best = next[r];
      } else {
        end[r] = next[r].v;
        step[r] = kInfinity;
      }
    }
    if (!moves) return;
  }
}

void Search::refine(int iterations) {
  std::vector<double> intervals(size_);
  for (Index i = 0; i < size_; ++i) intervals[i] = stretch_[i].interval;
  for (int iteration = 0; iteration < iterations; ++iteration) {
    std::vector<Index> farther;
    for (Index i = 0; i < size_; ++i) {
      const Probe& last = probe_[i];
      const double step = clipped(last.step, -intervals[i], intervals[i]);
      const Probe next = probe(i, stretch_[i].within(last.v + step));
      if (no_farther(next.square, last.square))
        probe_[i] = next;
      else
        farther.push_back(i);
    }
    if (!farther.empty()) descend(farther, intervals, kSafeguarded);
  }
}

py::tuple Search::finish(const Array& control_points) const {
  const Index p = curves_.degree + 1;
  Array u(size_), position(Shape{size_, 2}), tangent(Shape{size_, 2}), normal(Shape{size_, 2});
  Array distance(size_), basis(Shape{size_, p});
  py::array_t<bool> interior(size_);
  Ints span(size_), columns(Shape{size_, p});
  double largest = 0.0;
  for (Index i = 0; i < control_points.size(); ++i)
    largest = std::max(largest, std::abs(control_points.data()[i]));
  for (Index i = 0; i < size_; ++i) {
    const Probe& at = probe_[i];
    const Stretch& stretch = stretch_[i];
    const double length = stretch.length();
    double v = at.v;
    if (curves_.periodic) v -= length * std::floor((v - stretch.begin) / length);
    u.mutable_data()[i] = clipped(v, stretch.begin, stretch.end) - on(i).shift;
    const Curve& own = on(i);
    for (Index j = 0; j < p; ++j) columns.mutable_data()[i * p + j] = own.column(at.span, j);
    double tx = at.first[0], ty = at.first[1], norm = std::sqrt(tx * tx + ty * ty);
    if (!(norm * length > kNoTangent * largest)) {
      const double* from = control_points.data() + 2 * own.column(at.span, 0);
      const double* to = control_points.data() + 2 * own.column(at.span, p - 1);
      tx = to[0] - from[0], ty = to[1] - from[1];
      if (tx == 0.0 && ty == 0.0) tx = 1.0;
      norm = std::hypot(tx, ty);
    }
    tx /= norm, ty /= norm;
    for (int c = 0; c < 2; ++c) position.mutable_data()[2 * i + c] = points_.data()[2 * i + c] + at.offset[c];
    tangent.mutable_data()[2 * i] = normal.mutable_data()[2 * i + 1] = tx;
    tangent.mutable_data()[2 * i + 1] = ty;
    normal.mutable_data()[2 * i] = -ty;
    distance.mutable_data()[i] = -(-ty * at.offset[0] + tx * at.offset[1]);
    const double tolerance = kEndTolerance * length;
    bool outside = (at.v - stretch.floor <= tolerance && at.slope > 0.0) ||
                   (stretch.ceiling - at.v <= tolerance && at.slope < 0.0);
    if (!curves_.periodic) outside |= at.v <= stretch.begin + tolerance || at.v >= stretch.end - tolerance;
    interior.mutable_data()[i] = !outside;
    for (Index j = 0; j < p; ++j) {
      const double* values = own.coefficients.data() + at.span * p + j;
      double total = values[(p - 1) * own.stride * p];
      for (Index k = p - 2; k >= 0; --k) total = total * at.s + values[k * own.stride * p];
      basis.mutable_data()[i * p + j] = total;
    }
    const Index number = curves_.first[curve_.data()[i]] + at.span;
    span.mutable_data()[i] = number + curves_.all[0].offset + curves_.degree;
  }
  return py::make_tuple(u, position, tangent, normal, distance, interior, basis, span, columns);
}

py::tuple Curves::search(const Array& control_points, const Array& points, const Ints& curve,
                         const Array& u_low, const Array& u_high, double coarse_step, int iterations) const {
  Search search(*this, control_points, points, curve, u_low, u_high);
  search.nearest_on_grid(coarse_step);
  search.descend(search.all(), search.reach(coarse_step), iterations);
  return search.finish(control_points);
}

py::tuple Curves::refine(const Array& control_points, const Array& points, const Ints& curve,
                         const Array& u_start, const Array& u_low, const Array& u_high,
                         int iterations) const {
  Search search(*this, control_points, points, curve, u_low, u_high);
  search.start_at(u_start.data());
  search.refine(iterations);
  return search.finish(control_points);
}

void add_foot_points(py::module_& module) {
  py::class_<Curves>(module, "Curves")
      .def(py::init<const py::sequence&, const std::vector<Index>&, const std::vector<Index>&>(),
           py::arg("bases"), py::arg("offsets") = std::vector<Index>{0},
           py::arg("distinct") = std::vector<Index>{})
      .def("search", &Curves::search)
      .def("refine", &Curves::refine);
}

}  // namespace kernels
