// Kernels over rows, compiled. Each has the name, the arguments and the results of the function in Python that
// it takes the place of (see kernels.py), which says what it computes and is what tests hold it against.

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <vector>

namespace py = pybind11;

using Index = py::ssize_t;
using Array = py::array_t<double, py::array::c_style | py::array::forcecast>;
using Ints = py::array_t<Index, py::array::c_style | py::array::forcecast>;
using Shape = std::vector<Index>;

namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

double clipped(double v, double low, double high) { return std::min(std::max(v, low), high); }

void expect(bool fits) {
  if (!fits) throw py::value_error("expected arrays of shapes that fit each other");
}

struct Turn {
  explicit Turn(double theta) : c(std::cos(theta)), s(std::sin(theta)) {}
  double c, s;
};

// --- foot points ------------------------------------------------------------------------------------------

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
      : spans_(spans), points_(points), curve_(curve), eps_(tolerances), size_(points.shape(0)) {
    expect(points.size() == 2 * size_ && curve.size() == size_);
    expect(u_low.size() == size_ && u_high.size() == size_);
    coefficients(control_points);
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
  // C (n, 3, p + 1, 2): on span i, d^r S / du^r = sum_k C[i, r, k] s^k.
  void coefficients(const Array& control_points) {
    const Index p = spans_.degree + 1, spans = spans_.columns.shape(0);
    const double* basis = spans_.by_span.data();
    const double* points = control_points.data();
    polynomials_.assign(spans * 3 * p * 2, 0.0);
    for (Index i = 0; i < spans; ++i) {
      const Index* columns = spans_.columns.data() + i * p;
      for (Index k = 0; k < p; ++k)
        for (Index r = 0; r < 3; ++r) {
          const double* row = basis + (i * 3 * p + k * 3 + r) * p;
          double x = 0.0, y = 0.0;
          for (Index j = 0; j < p; ++j) {
            x += row[j] * points[2 * columns[j]];
            y += row[j] * points[2 * columns[j] + 1];
          }
          double* at = &polynomials_[((i * 3 + r) * p + k) * 2];
          at[0] = x, at[1] = y;
        }
    }
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
    const double* terms = &polynomials_[(number * 3 + order) * p * 2];
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

  bool no_farther(double square, double than) const {
    return square <= than + eps_.equal * (1.0 + than);
  }

  Spans spans_;
  Array points_;
  Ints curve_;
  Tolerances eps_;
  Index size_;
  std::vector<double> polynomials_;
  std::vector<Stretch> stretch_;
  std::vector<Probe> probe_;
};

// The grid of each curve reaches over the stretches of all rows on it, as in Python.
void Search::nearest_on_grid(double step) {
  const Index curves = spans_.low.shape(0);
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
      const Index number = locate(least[k] + step * static_cast<double>(g), &s);
      evaluate(number, s, 0, &on_grid[k][2 * g]);
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
      const Index number = locate(v, &s);
      evaluate(number, s, 0, at);
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
    double v = u[i] + spans_.shift.data()[curve_.data()[i]];
    if (!spans_.periodic) {
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
      moves |= std::abs(v - best.v) > eps_.step * stretch.length();
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

void Search::refine(int iterations, int safeguarded) {
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
    if (!farther.empty()) descend(farther, intervals, safeguarded);
  }
}

py::tuple Search::finish(const Array& control_points) const {
  const Index p = spans_.degree + 1;
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
    if (spans_.periodic) v -= length * std::floor((v - stretch.begin) / length);
    u.mutable_data()[i] = clipped(v, stretch.begin, stretch.end) - spans_.shift.data()[curve_.data()[i]];
    const Index* own = spans_.columns.data() + at.number * p;
    double tx = at.first[0], ty = at.first[1], norm = std::sqrt(tx * tx + ty * ty);
    if (!(norm * length > eps_.tangent * largest)) {
      const double* points = control_points.data();
      tx = points[2 * own[p - 1]] - points[2 * own[0]];
      ty = points[2 * own[p - 1] + 1] - points[2 * own[0] + 1];
      if (tx == 0.0 && ty == 0.0) tx = 1.0;
      norm = std::hypot(tx, ty);
    }
    tx /= norm, ty /= norm;
    for (int c = 0; c < 2; ++c)
      position.mutable_data()[2 * i + c] = points_.data()[2 * i + c] + at.offset[c];
    tangent.mutable_data()[2 * i] = normal.mutable_data()[2 * i + 1] = tx;
    tangent.mutable_data()[2 * i + 1] = ty;
    normal.mutable_data()[2 * i] = -ty;
    distance.mutable_data()[i] = -(-ty * at.offset[0] + tx * at.offset[1]);
    const double tolerance = eps_.end * length;
    bool outside = (at.v - stretch.floor <= tolerance && at.slope > 0.0) ||
                   (stretch.ceiling - at.v <= tolerance && at.slope < 0.0);
    if (!spans_.periodic)
      outside |= at.v <= stretch.begin + tolerance || at.v >= stretch.end - tolerance;
    interior.mutable_data()[i] = !outside;
    const Index spans = spans_.columns.shape(0);
    for (Index j = 0; j < p; ++j) {
      const double* values = spans_.values.data() + at.number * p + j;
      double total = values[(p - 1) * spans * p];
      for (Index k = p - 2; k >= 0; --k) total = total * at.s + values[k * spans * p];
      basis.mutable_data()[i * p + j] = total;
      columns.mutable_data()[i * p + j] = own[j];
    }
    span.mutable_data()[i] = at.number + spans_.first + spans_.degree;
  }
  return py::make_tuple(u, position, tangent, normal, distance, interior, basis, span, columns);
}

Tolerances tolerances_of(const py::tuple& eps) {
  return {eps[0].cast<double>(), eps[1].cast<double>(), eps[2].cast<double>(),
          eps[3].cast<double>(), eps[4].cast<double>(), eps[5].cast<double>()};
}

py::tuple searched(const py::object& spans, const Array& control_points, const Array& points,
                   const Ints& curve, const Array& u_low, const Array& u_high, double coarse_step,
                   int iterations, const py::tuple& tolerances) {
  Search search(spans, control_points, points, curve, u_low, u_high, tolerances_of(tolerances));
  search.nearest_on_grid(coarse_step);
  search.descend(search.all(), search.reach(coarse_step), iterations);
  return search.finish(control_points);
}

py::tuple refined(const py::object& spans, const Array& control_points, const Array& points,
                  const Ints& curve, const Array& u_start, const Array& u_low, const Array& u_high,
                  int iterations, int safeguarded, const py::tuple& tolerances) {
  Search search(spans, control_points, points, curve, u_low, u_high, tolerances_of(tolerances));
  search.start_at(u_start.data());
  search.refine(iterations, safeguarded);
  return search.finish(control_points);
}

// --- rows -------------------------------------------------------------------------------------------------

using Columns = py::array_t<double, py::array::f_style>;

void add_rows(Columns hessian, Array gradient, const Ints& columns, const Array& jacobian,
              const Array& residual, const Array& change) {
  const Index rows = jacobian.shape(0), width = jacobian.shape(1), n = gradient.shape(0);
  expect(hessian.size() == n * n && change.size() == n && residual.size() == rows);
  expect(columns.size() == rows * width);
  double* H = hessian.mutable_data();
  double* g = gradient.mutable_data();
  for (Index i = 0; i < rows; ++i) {
    const Index* at = columns.data() + i * width;
    const double* J = jacobian.data() + i * width;
    double r = residual.data()[i];
    for (Index a = 0; a < width; ++a) r += J[a] * change.data()[at[a]];
    for (Index a = 0; a < width; ++a) {
      g[at[a]] -= J[a] * r;
      for (Index b = 0; b <= a; ++b) {
        const Index high = std::max(at[a], at[b]), low = std::min(at[a], at[b]);
        H[high + low * n] += J[a] * J[b];
      }
    }
  }
}

Ints columns_of(const Ints& keys, const Ints& starts, const Ints& sought, const Ints& key,
                const Ints& entry) {
  const Index rows = sought.shape(0), k = sought.shape(1), width = key.shape(0);
  const Index* known = keys.data();
  const Index* last = known + keys.shape(0);
  Ints columns(Shape{rows, width});
  std::vector<Index> begin(k);  // UNKNOWN is -1
  for (Index i = 0; i < rows; ++i) {
    for (Index j = 0; j < k; ++j) {
      const Index wanted = sought.data()[i * k + j];
      const Index* place = std::lower_bound(known, last, wanted);
      begin[j] = place == last || *place != wanted ? -1 : starts.data()[place - known];
    }
    for (Index j = 0; j < width; ++j) {
      const Index first = begin[key.data()[j]];
      columns.mutable_data()[i * width + j] = first < 0 ? -1 : first + entry.data()[j];
    }
  }
  return columns;
}

Ints spread(const Ints& starts, const Ints& widths) {
  const Index count = starts.shape(0);
  expect(widths.size() == count);
  Index total = 0;
  for (Index i = 0; i < count; ++i) total += widths.data()[i];
  Ints out(total);
  Index* at = out.mutable_data();
  for (Index i = 0; i < count; ++i)
    for (Index j = 0; j < widths.data()[i]; ++j) *at++ = starts.data()[i] + j;
  return out;
}

// --- detections -------------------------------------------------------------------------------------------

constexpr Index kSensor = 5;

void sensor_columns(const double* z, const double* twist, double (*C)[kSensor]) {
  const double distance =
      std::max(std::hypot(z[0], z[1]), std::numeric_limits<double>::min());
  const double turned[2] = {-z[1], z[0]};
  for (int c = 0; c < 2; ++c) {
    C[c][0] = turned[c];
    C[c][1] = c;
    C[c][2] = -(twist[c] + twist[2] * turned[c]);
    C[c][3] = -z[c];
    C[c][4] = -z[c] / distance;
  }
}

Array by_sensor(const Array& points, const Array& twists) {
  const Index m = points.shape(0);
  expect(points.size() == 2 * m && twists.size() == 3 * m);
  Array columns(Shape{m, 2, kSensor});
  for (Index i = 0; i < m; ++i)
    sensor_columns(points.data() + 2 * i, twists.data() + 3 * i,
                   reinterpret_cast<double(*)[kSensor]>(columns.mutable_data() + 2 * kSensor * i));
  return columns;
}

Array shifted(const Array& points, const Array& twists, const Array& sensor) {
  const Index m = points.shape(0);
  expect(points.size() == 2 * m && twists.size() == 3 * m && sensor.size() == kSensor);
  Array out(Shape{m, 2});
  double C[2][kSensor];
  for (Index i = 0; i < m; ++i) {
    sensor_columns(points.data() + 2 * i, twists.data() + 3 * i, C);
    for (int c = 0; c < 2; ++c) {
      double by = 0.0;
      for (Index k = 0; k < kSensor; ++k) by += C[c][k] * sensor.data()[k];
      out.mutable_data()[2 * i + c] = points.data()[2 * i + c] + by;
    }
  }
  return out;
}

Array to_map(const Array& points, const Array& poses) {
  const Index m = points.shape(0) == 1 ? poses.shape(0) : points.shape(0);
  const Index by_point = points.shape(0) == 1 ? 0 : 2, by_pose = poses.shape(0) == 1 ? 0 : 3;
  expect(points.size() == 2 * (by_point ? m : 1) && poses.size() == 3 * (by_pose ? m : 1));
  Array out(Shape{m, 2});
  Turn turn(0.0);
  for (Index i = 0; i < m; ++i) {
    const double* z = points.data() + by_point * i;
    const double* x = poses.data() + by_pose * i;
    if (by_pose || i == 0) turn = Turn(x[2]);
    out.mutable_data()[2 * i] = turn.c * z[0] - turn.s * z[1] + x[0];
    out.mutable_data()[2 * i + 1] = turn.s * z[0] + turn.c * z[1] + x[1];
  }
  return out;
}

py::tuple detection_rows(const Array& points, const Array& covariances, const Array& poses,
                         const Array& normals, const Array& distances, const Array& basis,
                         const Array& measured, const Array& twists, const Array& sensor,
                         double sigma_model) {
  const Index m = points.shape(0), p = basis.shape(1), sensed = sensor.shape(0);
  const Index width = 3 + sensed + 2 * p;
  expect(covariances.size() == 4 * m && poses.size() == 3 * m && normals.size() == 2 * m);
  expect(distances.size() == m && basis.size() == p * m && measured.size() == 2 * m);
  expect(twists.size() == 3 * m && (sensed == 0 || sensed == kSensor));
  Array residual(m), sigma(m), jacobian(Shape{m, width});
  double C[2][kSensor];
  for (Index i = 0; i < m; ++i) {
    const double* n = normals.data() + 2 * i;
    const double* pose = poses.data() + 3 * i;
    const double* K = covariances.data() + 4 * i;
    const double* z = measured.data() + 2 * i;
    double* J = jacobian.mutable_data() + width * i;
    const Turn turn(pose[2]);
    const double own[2] = {turn.c * n[0] + turn.s * n[1], turn.c * n[1] - turn.s * n[0]};
    const double variance =
        own[0] * own[0] * K[0] + 2.0 * own[0] * own[1] * K[1] + own[1] * own[1] * K[3];
    sigma.mutable_data()[i] = std::sqrt(variance + sigma_model * sigma_model);
    const double r = distances.data()[i];
    double factor = 1.0;
    if (sensed) {
      const double distance = std::max(std::hypot(z[0], z[1]), std::numeric_limits<double>::min());
      const double along = (own[0] * z[0] + own[1] * z[1]) / distance;
      const double square = own[0] * own[0] + own[1] * own[1];
      const double rates[2] = {square, (square - along * along) / distance};
      factor += rates[0] * sensor.data()[3] + rates[1] * sensor.data()[4];
      sensor_columns(z, twists.data() + 3 * i, C);
      for (Index k = 0; k < kSensor; ++k) J[3 + k] = factor * (own[0] * C[0][k] + own[1] * C[1][k]);
      J[6] += r * rates[0];
      J[7] += r * rates[1];
    }
    residual.mutable_data()[i] = factor * r;
    J[0] = factor * n[0];
    J[1] = factor * n[1];
    J[2] = factor * (n[1] * (points.data()[2 * i] - pose[0]) - n[0] * (points.data()[2 * i + 1] - pose[1]));
    for (Index j = 0; j < p; ++j)
      for (int c = 0; c < 2; ++c) J[3 + sensed + 2 * j + c] = -factor * basis.data()[i * p + j] * n[c];
  }
  return py::make_tuple(residual, sigma, jacobian);
}

// --- odometry and path ------------------------------------------------------------------------------------

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

// The exponential of SE(2) of a twist over a time.
void se2_exp(const double* twist, double dt, double* pose) {
  const double x = twist[0] * dt, y = twist[1] * dt, theta = twist[2] * dt;
  const double half = theta == 0.0 ? std::numeric_limits<double>::min() : 0.5 * theta;
  const double sine = std::sin(half), cosine = std::cos(half);
  const double sinc = sine * cosine / half, cosc = sine * sine / half;
  pose[0] = sinc * x - cosc * y, pose[1] = cosc * x + sinc * y, pose[2] = theta;
}

py::tuple integrated(const Array& durations, const Array& twists, const Array& sigmas) {
  const Index count = durations.shape(0);
  expect(count > 0 && twists.size() == 3 * count && sigmas.size() == 3 * count);
  std::vector<double> poses(3 * count);
  double end[3] = {0.0, 0.0, 0.0}, step[3];
  for (Index k = 0; k < count; ++k) {
    se2_exp(twists.data() + 3 * k, durations.data()[k], step);
    const Turn turn(end[2]);
    end[0] += turn.c * step[0] - turn.s * step[1];
    end[1] += turn.s * step[0] + turn.c * step[1];
    end[2] += step[2];
    std::copy(end, end + 3, &poses[3 * k]);
  }
  Array covariance(Shape{3, 3}), by_calibration(Shape{3, 2});
  double* K = covariance.mutable_data();
  double* G = by_calibration.mutable_data();
  std::fill(K, K + 9, 0.0);
  std::fill(G, G + 6, 0.0);
  const Turn last(end[2]);
  for (Index k = 0; k < count; ++k) {
    const double* twist = twists.data() + 3 * k;
    const double* after = &poses[3 * k];
    const double dt = durations.data()[k];
    se2_exp(twist, -0.5 * dt, step);
    const Turn turn(after[2]), from_end(after[2] + step[2] - end[2]);
    const double dx = after[0] + turn.c * step[0] - turn.s * step[1] - end[0];
    const double dy = after[1] + turn.s * step[0] + turn.c * step[1] - end[1];
    const double A[3][3] = {{from_end.c, -from_end.s, -last.s * dx + last.c * dy},
                            {from_end.s, from_end.c, -(last.c * dx + last.s * dy)},
                            {0.0, 0.0, 1.0}};
    for (int i = 0; i < 3; ++i) {
      G[2 * i] += (A[i][0] * twist[0] + A[i][1] * twist[1]) * dt;
      G[2 * i + 1] += A[i][2] * dt;
      for (int j = 0; j < 3; ++j)
        for (int c = 0; c < 3; ++c) {
          const double sigma = dt * sigmas.data()[3 * k + c];
          K[3 * i + j] += A[i][c] * sigma * (A[j][c] * sigma);
        }
    }
  }
  return py::make_tuple(Array(Shape{3}, end), covariance, by_calibration);
}

py::tuple odometry_residuals(const Array& starts, const Array& ends, const Array& deltas,
                             double series_below) {
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
    if (!(std::abs(phi) < series_below)) {
      const double cot = 1.0 / std::tan(h);
      a = h * cot;
      slope = 0.5 * cot - 0.5 * h * (1.0 + cot * cot);
    }
    double* r = residuals.mutable_data() + 3 * i;
    r[0] = a * dx + h * dy, r[1] = a * dy - h * dx, r[2] = phi;
    double* E = by_end.mutable_data() + 9 * i;
    const double c = turn.c, s = turn.s;
    const double values[9] = {a * c - h * s,  a * s + h * c, slope * dx + 0.5 * dy,
                              -a * s - h * c, a * c - h * s, slope * dy - 0.5 * dx,
                              0.0,            0.0,           1.0};
    double* S = by_start.mutable_data() + 9 * i;
    for (int k = 0; k < 9; ++k) E[k] = values[k], S[k] = -values[k];
    S[2] += a * across - h * along;
    S[5] += -a * along - h * across;
  }
  return py::make_tuple(residuals, by_start, by_end);
}

// --- scan matching ----------------------------------------------------------------------------------------

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

py::tuple matched(const Array& recent, const Array& points_vehicle, const Array& variances, const Array& pose,
                  double reach, const py::tuple& limits) {
  const Index m = points_vehicle.shape(0);
  const double farthest = limits[0].cast<double>(), min_weight = limits[1].cast<double>();
  const double huber = limits[2].cast<double>(), sigma_cone = limits[3].cast<double>();
  expect(variances.size() == m && pose.size() == 3);
  const Array place(Shape{1, 3}, pose.data());
  const Array points = to_map(points_vehicle, place);
  const py::tuple beside = weighted_means(points, recent, reach, farthest);
  const Array means = beside[0].cast<Array>(), weights = beside[1].cast<Array>();
  double w = 0.0, wx = 0.0, wy = 0.0, turning = 0.0, cost = 0.0, g[3] = {0.0, 0.0, 0.0};
  py::array_t<bool> is_matched(m);
  for (Index i = 0; i < m; ++i) {
    const bool own = is_matched.mutable_data()[i] = weights.data()[i] > min_weight;
    if (!own) continue;
    const double* p = points.data() + 2 * i;
    const double ex = p[0] - means.data()[2 * i], ey = p[1] - means.data()[2 * i + 1];
    const double ax = p[0] - pose.data()[0], ay = p[1] - pose.data()[1];
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
  return py::make_tuple(Array(Shape{3, 3}, values), Array(Shape{3}, g), is_matched, cost);
}

// --- sightings --------------------------------------------------------------------------------------------

Array gated_squares(const Array& points, const Array& others, const Array& place, const Array& along,
                    const Array& across) {
  const Index m = points.shape(0), n = others.shape(0);
  expect(points.size() == 2 * m && others.size() == 2 * n && place.size() == 2);
  expect(along.size() == m && across.size() == m);
  Array squares(Shape{m, n});
  for (Index i = 0; i < m; ++i) {
    const double* p = points.data() + 2 * i;
    double rx = p[0] - place.data()[0], ry = p[1] - place.data()[1];
    const double range = std::max(std::hypot(rx, ry), std::numeric_limits<double>::min());
    rx /= range, ry /= range;
    for (Index j = 0; j < n; ++j) {
      const double dx = others.data()[2 * j] - p[0], dy = others.data()[2 * j + 1] - p[1];
      const double a = (dx * rx + dy * ry) / along.data()[i], c = (dy * rx - dx * ry) / across.data()[i];
      squares.mutable_data()[i * n + j] = a * a + c * c;
    }
  }
  return squares;
}

}  // namespace

PYBIND11_MODULE(_kernels, module) {
  module.doc() = "Kernels over rows; pathspace_graph.factors.kernels says which functions they take the place of.";
  module.def("searched", &searched);
  module.def("refined", &refined);
  module.def("add_rows", &add_rows, py::arg("hessian").noconvert(), py::arg("gradient").noconvert(),
             py::arg("columns"), py::arg("jacobian"), py::arg("residual"), py::arg("change"));
  module.def("columns_of", &columns_of);
  module.def("by_sensor", &by_sensor);
  module.def("shifted", &shifted);
  module.def("to_map", &to_map);
  module.def("detection_rows", &detection_rows);
  module.def("along_and_across", &along_and_across);
  module.def("odometry_residuals", &odometry_residuals);
  module.def("integrated", &integrated);
  module.def("weighted_means", &weighted_means);
  module.def("matched", &matched);
  module.def("gated_squares", &gated_squares);
  module.def("spread", &spread);
}
