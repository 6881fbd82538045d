// Kernels over rows. _kernels.pyi says what each computes, and tests hold each against one in numpy in
// tests/oracles.

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <stdexcept>
#include <vector>

namespace py = pybind11;

using Index = py::ssize_t;
using Array = py::array_t<double, py::array::c_style | py::array::forcecast>;
using Ints = py::array_t<Index, py::array::c_style | py::array::forcecast>;
using Shape = std::vector<Index>;

#define QUOTED_(x) #x
#define QUOTED(x) QUOTED_(x)
#if defined(__clang__)
#define COMPILER "clang " QUOTED(__clang_major__) "." QUOTED(__clang_minor__)
#elif defined(__GNUC__)
#define COMPILER "gcc " QUOTED(__GNUC__) "." QUOTED(__GNUC_MINOR__)
#else
#define COMPILER "MSVC " QUOTED(_MSC_VER)
#endif

namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kTurn = 6.283185307179586;
constexpr Index kOwn = -2;  // a detection that is the first one of a new cone

double clipped(double v, double low, double high) { return std::min(std::max(v, low), high); }

void expect(bool fits) {
  if (!fits) throw py::value_error("expected arrays of shapes that fit each other");
}

struct Turn {
  explicit Turn(double theta) : c(std::cos(theta)), s(std::sin(theta)) {}
  double c, s;
};

// Turn the pairs from each of `columns` on by an angle with this cosine and sine.
void turn_pairs(double* values, const Ints& columns, double c, double s) {
  for (Index k = 0; k < columns.size(); ++k) {
    double* at = values + columns.data()[k];
    const double x = at[0], y = at[1];
    at[0] = c * x - s * y, at[1] = s * x + c * y;
  }
}

// Move values from the map frame into that of a pose: graph.relative:to_frame.
void to_frame(double* values, const Ints& turning, const Ints& headings, const double* frame, const Turn& turn) {
  for (Index k = 0; k < turning.size(); ++k) {
    double* at = values + turning.data()[k];
    at[0] -= frame[0], at[1] -= frame[1];
  }
  turn_pairs(values, turning, turn.c, -turn.s);
  for (Index k = 0; k < headings.size(); ++k) values[headings.data()[k]] -= frame[2];
}

// Solve A x = b for three unknowns by elimination with pivoting, in place.
void solve3(double (*A)[3], double* b) {
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
void inverse3(const double* matrix, double* out) {
  for (int c = 0; c < 3; ++c) {
    double A[3][3], column[3] = {0.0, 0.0, 0.0};
    std::copy_n(matrix, 9, &A[0][0]);
    column[c] = 1.0;
    solve3(A, column);
    for (int r = 0; r < 3; ++r) out[3 * r + c] = column[r];
  }
}

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
      : spans_(spans), points_(points), curve_(curve), eps_(tolerances), size_(points.shape(0)),
        control_points_(control_points.data()), is_known_(spans_.columns.shape(0), false),
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

  bool no_farther(double square, double than) const {
    return square <= than + eps_.equal * (1.0 + than);
  }

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

struct Layout {  // graph.variables:Layout
  explicit Layout(const py::handle& layout)
      : keys(layout.attr("keys").cast<Ints>()), starts(layout.attr("starts").cast<Ints>()),
        widths(layout.attr("widths").cast<Ints>()) {
    expect(starts.size() == size() && widths.size() == size());
  }
  Index size() const { return keys.shape(0); }

  // The place of a key, which is -1 where the layout does not hold it.
  Index find(Index key) const {
    const Index* last = keys.data() + size();
    const Index* place = std::lower_bound(keys.data(), last, key);
    return place == last || *place != key ? -1 : place - keys.data();
  }
  Index place(Index key) const {
    const Index found = find(key);
    if (found < 0) throw py::value_error("expected rows on known variables, found others");
    return found;
  }

  Ints keys, starts, widths;
};

struct Rows {  // graph.rows:Rows
  explicit Rows(const py::handle& rows)
      : keys(rows.attr("keys").cast<Ints>()), jacobian(rows.attr("jacobian").cast<Array>()),
        residual(rows.attr("residual").cast<Array>()), owner(rows.attr("owner").cast<Ints>()) {
    expect(keys.shape(0) == size() && jacobian.shape(0) == size() && owner.size() == size());
  }
  Rows(Index rows, Index k, Index width)
      : keys(Shape{rows, k}), jacobian(Shape{rows, width}), residual(rows), owner(rows) {}

  Index size() const { return residual.shape(0); }
  Index width() const { return jacobian.shape(1); }
  bool same_keys(Index row, Index other) const {
    const Index k = keys.shape(1);
    return std::equal(keys.data() + row * k, keys.data() + (row + 1) * k, keys.data() + other * k);
  }
  void set(Index at, const Rows& from, Index row) {
    const Index k = keys.shape(1);
    std::copy_n(from.keys.data() + row * k, k, keys.mutable_data() + at * k);
    std::copy_n(from.jacobian.data() + row * width(), width(), jacobian.mutable_data() + at * width());
    residual.mutable_data()[at] = from.residual.data()[row];
    owner.mutable_data()[at] = from.owner.data()[row];
  }
  py::tuple parts() const { return py::make_tuple(keys, jacobian, residual, owner); }

  Ints keys;
  Array jacobian, residual;
  Ints owner;
};

// Which of a row's keys each of its columns is by, and which entry of that variable.
struct Pattern {
  Pattern() = default;
  explicit Pattern(const py::handle& rows) {
    Index number = 0;
    for (const py::handle& width : rows.attr("widths")) {
      for (Index j = 0; j < width.cast<Index>(); ++j) key.push_back(number), entry.push_back(j);
      ++number;
    }
  }
  std::vector<Index> key, entry;
};

// The columns of one row after another; the keys of neighbouring rows are mostly the same.
class RowColumns {
 public:
  RowColumns(const Layout& layout, const Rows& rows, const py::handle& own)
      : layout_(layout), rows_(rows), k_(rows.keys.shape(1)), wanted_(k_), begin_(k_), columns_(rows.width()) {
    if (rows.size()) pattern_ = Pattern(own);
    expect(rows.size() == 0 || pattern_.key.size() == columns_.size());
  }

  const std::vector<Index>& of(Index row) {
    bool same = row > 0;
    for (Index j = 0; j < k_; ++j) {
      const Index wanted = rows_.keys.data()[row * k_ + j];
      if (row > 0 && wanted == wanted_[j]) continue;
      const Index place = layout_.find(wanted);
      wanted_[j] = wanted, same = false;
      begin_[j] = place < 0 ? kUnknown : layout_.starts.data()[place];
    }
    for (std::size_t j = 0; j < columns_.size() && !same; ++j) {
      const Index first = begin_[pattern_.key[j]];
      columns_[j] = first == kUnknown ? kUnknown : first + pattern_.entry[j];
    }
    return columns_;
  }

  const std::vector<Index>& known(Index row) {
    const std::vector<Index>& found = of(row);
    if (std::find(begin_.begin(), begin_.end(), kUnknown) != begin_.end())
      throw py::value_error("expected rows on known variables, found others");
    return found;
  }

  static constexpr Index kUnknown = -1;

 private:
  const Layout& layout_;
  const Rows& rows_;
  Pattern pattern_;
  Index k_;
  std::vector<Index> wanted_, begin_, columns_;
};

void add_rows(double* H, double* g, Index n, const py::handle& own, const Layout& layout, const double* change) {
  const Rows rows(own);
  RowColumns columns(layout, rows, own);
  const Index width = rows.width();
  std::vector<Index> places(width * (width + 1) / 2);
  for (Index i = 0; i < rows.size(); ++i) {
    const std::vector<Index>& at = columns.known(i);
    const double* J = rows.jacobian.data() + i * width;
    if (i == 0 || !rows.same_keys(i, i - 1))
      for (Index a = 0, k = 0; a < width; ++a)
        for (Index b = 0; b <= a; ++b, ++k) places[k] = std::max(at[a], at[b]) + std::min(at[a], at[b]) * n;
    double r = rows.residual.data()[i];
    for (Index a = 0; a < width; ++a) r += J[a] * change[at[a]];
    const Index* place = places.data();
    for (Index a = 0; a < width; ++a) {
      g[at[a]] -= J[a] * r;
      for (Index b = 0; b <= a; ++b) H[*place++] += J[a] * J[b];
    }
  }
}

// Add a factor with `[[L, g], [g', f]]` on some keys.
void add_factor(double* H, double* g, Index n, const Ints& keys, const Columns& matrix, const Layout& layout,
                const double* change) {
  std::vector<Index> at;
  for (Index k = 0; k < keys.shape(0); ++k) {
    const Index place = layout.place(keys.data()[k]);
    for (Index j = 0; j < layout.widths.data()[place]; ++j) at.push_back(layout.starts.data()[place] + j);
  }
  const Index m = static_cast<Index>(at.size());
  expect(matrix.size() == (m + 1) * (m + 1));
  const double* vector = matrix.data() + m * (m + 1);
  for (Index a = 0; a < m; ++a) g[at[a]] += vector[a];
  for (Index b = 0; b < m; ++b) {
    const double* column = matrix.data() + b * (m + 1);
    const double by = change[at[b]];
    for (Index a = 0; a < m; ++a) g[at[a]] -= column[a] * by;
    for (Index a = b; a < m; ++a) H[std::max(at[a], at[b]) + std::min(at[a], at[b]) * n] += column[a];
  }
}

py::tuple summed(const py::handle& own_layout, const py::list& factors, const py::sequence& groups,
                 const Array& change) {
  const Layout layout(own_layout);
  const Index n = change.shape(0);
  Columns hessian(Shape{n, n});
  Array gradient(n);
  double* H = hessian.mutable_data();
  double* g = gradient.mutable_data();
  std::fill_n(H, n * n, 0.0);
  std::fill_n(g, n, 0.0);
  for (const py::handle& factor : factors) {
    const py::tuple own = factor.cast<py::tuple>();
    add_factor(H, g, n, own[0].cast<Ints>(), own[1].cast<Columns>(), layout, change.data());
  }
  for (const py::handle& rows : groups) add_rows(H, g, n, rows, layout, change.data());
  return py::make_tuple(hessian, gradient);
}

// The rows `[A b]` of some groups on the variables that they hold, and the places of these variables.
py::tuple block_of(const py::handle& own_layout, const py::sequence& groups) {
  const Layout layout(own_layout);
  std::vector<Rows> all;
  std::vector<Pattern> patterns;
  for (const py::handle& rows : groups) {
    all.emplace_back(rows);
    patterns.push_back(all.back().size() ? Pattern(rows) : Pattern());
    expect(all.back().size() == 0 || Index(patterns.back().key.size()) == all.back().width());
  }
  Index height = 0, width = 0;
  std::vector<Index> first(layout.size(), -1), held;
  for (const Rows& rows : all) {
    height += rows.size();
    const Index k = rows.keys.shape(1);
    const Index* own = rows.keys.data();
    for (Index i = 0; i < rows.keys.size(); ++i)  // neighbouring rows mostly hold the same variables
      if (i < k || own[i] != own[i - k]) first[layout.place(own[i])] = 0;
  }
  for (Index k = 0; k < layout.size(); ++k)
    if (first[k] == 0) held.push_back(k), first[k] = width, width += layout.widths.data()[k];
  Columns block(Shape{height, width + 1});
  double* at = block.mutable_data();
  std::fill_n(at, height * (width + 1), 0.0);
  for (std::size_t g = 0; g < all.size(); ++g) {
    const Rows& rows = all[g];
    const Pattern& pattern = patterns[g];
    const Index k = rows.keys.shape(1);
    std::vector<Index> begin(k);
    for (Index i = 0; i < rows.size(); ++i, ++at) {
      const Index* own = rows.keys.data() + i * k;
      for (Index c = 0; c < k; ++c)
        if (i == 0 || own[c] != own[c - k]) begin[c] = first[layout.place(own[c])];
      for (Index j = 0; j < rows.width(); ++j)
        at[(begin[pattern.key[j]] + pattern.entry[j]) * height] = rows.jacobian.data()[i * rows.width() + j];
      at[width * height] = -rows.residual.data()[i];
    }
  }
  return py::make_tuple(Ints(Shape{static_cast<Index>(held.size())}, held.data()), block);
}

Ints columns_of(const py::handle& own_layout, const py::handle& own) {
  const Layout layout(own_layout);
  const Rows rows(own);
  Ints out(Shape{rows.size(), rows.width()});
  RowColumns columns(layout, rows, own);
  for (Index i = 0; i < rows.size(); ++i) {
    const std::vector<Index>& at = columns.of(i);
    std::copy(at.begin(), at.end(), out.mutable_data() + i * rows.width());
  }
  return out;
}

Array moved_residual(const py::handle& own_layout, const py::handle& own, const Array& change) {
  const Layout layout(own_layout);
  const Rows rows(own);
  Array out(rows.size());
  RowColumns columns(layout, rows, own);
  for (Index i = 0; i < rows.size(); ++i) {
    const std::vector<Index>& at = columns.known(i);
    const double* J = rows.jacobian.data() + i * rows.width();
    double by_change = 0.0;
    for (Index j = 0; j < rows.width(); ++j) by_change += J[j] * change.data()[at[j]];
    out.mutable_data()[i] = rows.residual.data()[i] - by_change;
  }
  return out;
}

std::vector<bool> owned_by(const Rows& rows, const Ints& owners) {
  std::vector<bool> is(rows.size());
  for (Index i = 0; i < rows.size(); ++i)
    is[i] = std::binary_search(owners.data(), owners.data() + owners.shape(0), rows.owner.data()[i]);
  return is;
}

py::tuple parted(const py::handle& rows, const Ints& gone) {
  const Rows all(rows);
  const std::vector<bool> goes = owned_by(all, gone);
  const Index count = std::count(goes.begin(), goes.end(), true), k = all.keys.shape(1);
  Rows stay(all.size() - count, k, all.width()), leave(count, k, all.width());
  for (Index i = 0, kept = 0; i < all.size(); ++i)
    goes[i] ? leave.set(i - kept, all, i) : stay.set(kept++, all, i);
  return py::make_tuple(stay.parts(), leave.parts());
}

py::tuple replaced(const py::handle& rows, const Ints& gone, const py::handle& fresh, const py::handle& layout,
                   const Array& change) {
  const Rows old(rows), added(fresh);
  const std::vector<bool> goes = owned_by(old, gone);
  const Array residual = moved_residual(layout, fresh, change);
  Index at = old.size() - std::count(goes.begin(), goes.end(), true);
  Rows out(at + added.size(), added.keys.shape(1), added.width());
  for (Index i = 0; i < added.size(); ++i) {
    out.set(at + i, added, i);
    out.residual.mutable_data()[at + i] = residual.data()[i];
  }
  at = 0;
  for (Index i = 0; i < old.size(); ++i)
    if (!goes[i]) out.set(at++, old, i);
  return out.parts();
}

Ints owners_holding(const py::handle& own_rows, const Ints& ascending) {
  const Rows rows(own_rows);
  const Index k = rows.keys.shape(1);
  const Index* first = ascending.data();
  const Index* last = first + ascending.shape(0);
  std::vector<Index> found;
  for (Index i = 0; i < rows.size(); ++i) {
    const Index* own = rows.keys.data() + i * k;
    if (std::any_of(own, own + k, [&](Index one) { return std::binary_search(first, last, one); }))
      found.push_back(rows.owner.data()[i]);
  }
  return Ints(Shape{static_cast<Index>(found.size())}, found.data());
}

Columns relative_block(const Array& root, const Array& right, const Array& local, const Array& values,
                       const Array& change, const py::handle& keys) {
  const Index r = root.shape(0), q = local.shape(0), width = q + 3;
  expect(root.size() == r * q && right.size() == r && values.size() == width && change.size() == width);
  const Ints turning = keys.attr("turning").cast<Ints>(), headings = keys.attr("headings").cast<Ints>();
  const double* frame = values.data() + q;
  const Turn turn(frame[2]);
  std::vector<double> there(values.data(), frame), off(q);
  to_frame(there.data(), turning, headings, frame, turn);
  for (Index j = 0; j < q; ++j) off[j] = there[j] - local.data()[j];
  Columns block(Shape{r, width + 1});
  std::vector<double> row(width);
  double* J = row.data();
  for (Index i = 0; i < r; ++i) {
    const double* A = root.data() + i * q;
    double sum = -right.data()[i], by[3] = {0.0, 0.0, 0.0}, now = 0.0;
    for (Index j = 0; j < q; ++j) sum += A[j] * off[j];
    std::copy_n(A, q, J);
    for (Index k = 0; k < turning.size(); ++k) {
      const Index x = turning.data()[k];
      J[x] = A[x] * turn.c - A[x + 1] * turn.s, J[x + 1] = A[x] * turn.s + A[x + 1] * turn.c;
      by[0] -= J[x], by[1] -= J[x + 1];
      by[2] += A[x] * there[x + 1] - A[x + 1] * there[x];
    }
    for (Index k = 0; k < headings.size(); ++k) by[2] -= A[headings.data()[k]];
    std::copy_n(by, 3, J + q);
    for (Index j = 0; j < width; ++j) {
      now += J[j] * change.data()[j];
      block.mutable_data()[i + j * r] = J[j];
    }
    block.mutable_data()[i + width * r] = now - sum;
  }
  return block;
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

py::tuple laid_out(const Ints& keys, Index sensor_key, Index first_pose, const py::tuple& sizes,
                   const Ints& bounds) {
  const Index count = keys.shape(0);
  const Index point = sizes[0].cast<Index>(), sensor = sizes[1].cast<Index>(), pose = sizes[2].cast<Index>();
  Ints widths(count), starts(count);
  Index total = 0;
  for (Index i = 0; i < count; ++i) {
    const Index key = keys.data()[i];
    starts.mutable_data()[i] = total;
    total += widths.mutable_data()[i] = key >= first_pose ? pose : key == sensor_key ? sensor : point;
  }
  py::list begins(bounds.shape(0));
  for (Index b = 0; b < bounds.shape(0); ++b) {
    const Index place = std::lower_bound(keys.data(), keys.data() + count, bounds.data()[b]) - keys.data();
    begins[b] = place < count ? starts.data()[place] : total;
  }
  return py::make_tuple(widths, starts, total, begins);
}

// --- links of the inactive map ----------------------------------------------------------------------------

struct Part {  // the variables that have left with a link, or those that it depends on: graph.variables:Layout
  Part(const py::handle& layout, const Index*& columns)
      : size(layout.attr("size").cast<Index>()),
        turning(layout.attr("turning").cast<Ints>()),
        headings(layout.attr("headings").cast<Ints>()),
        columns(columns) {
    columns += size;
  }

  Index size;
  Ints turning, headings;
  const Index* columns;
};

struct Link {  // graph.inactive:Link
  Link(const py::handle& link, Index frame, const Index*& leaving, const Index*& others)
      : frame(frame),
        left(link.attr("leaving"), leaving),
        given(link.attr("others"), others),
        gain(link.attr("gain").cast<Array>()),
        offset(link.attr("offset").cast<Array>()),
        noise(link.attr("noise").cast<Array>()) {
    expect(gain.size() == left.size * given.size && offset.size() == left.size);
    expect(noise.size() == left.size * left.size);
  }

  Index frame;
  Part left, given;
  Array gain, offset, noise;
};

std::vector<Link> links_of(const py::list& links, const Ints& frames, const Ints& leaving, const Ints& others) {
  expect(frames.size() == Index(links.size()));
  const Index *y = leaving.data(), *z = others.data();
  std::vector<Link> all;
  all.reserve(links.size());
  for (std::size_t k = 0; k < links.size(); ++k) all.emplace_back(links[k], frames.data()[k], y, z);
  expect(y == leaving.data() + leaving.size() && z == others.data() + others.size());
  return all;
}

Array link_means(const Array& values, const py::list& links, const Ints& frames, const Ints& leaving,
                 const Ints& others) {
  const std::vector<Link> all = links_of(links, frames, leaving, others);
  Array out(values.size(), values.data());
  double* now = out.mutable_data();
  std::vector<double> z, y;
  for (auto link = all.rbegin(); link != all.rend(); ++link) {
    const double* frame = now + link->frame;
    const Turn turn(frame[2]);
    z.resize(link->given.size), y.assign(link->offset.data(), link->offset.data() + link->left.size);
    for (Index j = 0; j < link->given.size; ++j) z[j] = now[link->given.columns[j]];
    to_frame(z.data(), link->given.turning, link->given.headings, frame, turn);
    for (Index i = 0; i < link->left.size; ++i)
      for (Index j = 0; j < link->given.size; ++j) y[i] += link->gain.data()[i * link->given.size + j] * z[j];
    for (Index k = 0; k < link->left.turning.size(); ++k) {
      double* at = &y[link->left.turning.data()[k]];
      const double x = at[0], left = at[1];
      at[0] = frame[0] + turn.c * x - turn.s * left, at[1] = frame[1] + turn.s * x + turn.c * left;
    }
    for (Index k = 0; k < link->left.headings.size(); ++k) y[link->left.headings.data()[k]] += frame[2];
    for (Index i = 0; i < link->left.size; ++i) now[link->left.columns[i]] = y[i];
  }
  return out;
}

// Add sign B D to a matrix (3, 3): D (q, 3) is the derivative of a part's coordinates in a frame by its pose.
void add_by_frame(const Part& part, const double* now, const double* frame, const Turn& turn, const double* B,
                  double sign, double (*sum)[3]) {
  for (int r = 0; r < 3; ++r) {
    const double* b = B + r * part.size;
    double by[3] = {0.0, 0.0, 0.0};
    for (Index k = 0; k < part.turning.size(); ++k) {
      const Index x = part.turning.data()[k];
      const double dx = now[part.columns[x]] - frame[0], dy = now[part.columns[x + 1]] - frame[1];
      by[0] -= turn.c * b[x] - turn.s * b[x + 1], by[1] -= turn.s * b[x] + turn.c * b[x + 1];
      by[2] += b[x] * (turn.c * dy - turn.s * dx) - b[x + 1] * (turn.c * dx + turn.s * dy);
    }
    for (Index k = 0; k < part.headings.size(); ++k) by[2] -= b[part.headings.data()[k]];
    for (int c = 0; c < 3; ++c) sum[r][c] += sign * by[c];
  }
}

py::tuple origin_by_active(const Array& values, const py::list& links, const Ints& frames, const Ints& leaving,
                           const Ints& others, Index origin) {
  const std::vector<Link> all = links_of(links, frames, leaving, others);
  const Index n = values.size();
  Array jacobian(Shape{3, n}), covariance(Shape{3, 3});
  double *A = jacobian.mutable_data(), *C = covariance.mutable_data();
  std::fill_n(A, 3 * n, 0.0), std::fill_n(C, 9, 0.0);
  for (int r = 0; r < 3; ++r) A[r * n + origin + r] = 1.0;
  std::vector<double> by_mean, by_others, by_noise;
  for (const Link& link : all) {
    const double* frame = values.data() + link.frame;
    const Turn turn(frame[2]);
    const Index q = link.left.size, m = link.given.size;
    by_mean.resize(3 * q), by_others.assign(3 * m, 0.0), by_noise.assign(3 * q, 0.0);
    for (int r = 0; r < 3; ++r) {
      double *b = &by_mean[r * q], *g = &by_others[r * m], *e = &by_noise[r * q];
      for (Index i = 0; i < q; ++i) b[i] = A[r * n + link.left.columns[i]], A[r * n + link.left.columns[i]] = 0.0;
      turn_pairs(b, link.left.turning, turn.c, -turn.s);
      for (Index i = 0; i < q; ++i) {
        if (b[i] == 0.0) continue;
        for (Index j = 0; j < m; ++j) g[j] += b[i] * link.gain.data()[i * m + j];
        for (Index j = 0; j < q; ++j) e[j] += b[i] * link.noise.data()[i * q + j];
      }
    }
    double by_frame[3][3] = {};
    add_by_frame(link.given, values.data(), frame, turn, by_others.data(), 1.0, by_frame);
    add_by_frame(link.left, values.data(), frame, turn, by_mean.data(), -1.0, by_frame);
    for (int r = 0; r < 3; ++r) {
      double* g = &by_others[r * m];
      turn_pairs(g, link.given.turning, turn.c, turn.s);
      for (Index j = 0; j < m; ++j) A[r * n + link.given.columns[j]] += g[j];
      for (int c = 0; c < 3; ++c) {
        A[r * n + link.frame + c] += by_frame[r][c];
        for (Index j = 0; j < q; ++j) C[3 * r + c] += by_noise[r * q + j] * by_noise[c * q + j];
      }
    }
  }
  return py::make_tuple(jacobian, covariance);
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

py::tuple station_rows(const Array& points, const Array& covariances, const Array& poses, const Array& value,
                       const Array& slope, const Array& control, const Array& measured, const Array& twists,
                       const Array& sensor, const Array& sigma_station) {
  const Index m = points.shape(0), p = value.shape(1);
  expect(value.size() == p * m && slope.size() == p * m && control.size() == 2 * p * m);
  expect(points.size() == 2 * m && sigma_station.size() == m);
  Array tangents(Shape{m, 2}), along(m), turning(m);
  for (Index i = 0; i < m; ++i) {
    double at[2] = {0.0, 0.0}, velocity[2] = {0.0, 0.0};
    for (Index j = 0; j < p; ++j)
      for (int c = 0; c < 2; ++c) {
        const double own = control.data()[2 * (i * p + j) + c];
        at[c] += value.data()[i * p + j] * own;
        velocity[c] += slope.data()[i * p + j] * own;
      }
    const double speed = std::hypot(velocity[0], velocity[1]), t[2] = {velocity[0] / speed, velocity[1] / speed};
    const double arm[2] = {points.data()[2 * i] - at[0], points.data()[2 * i + 1] - at[1]};
    std::copy_n(t, 2, tangents.mutable_data() + 2 * i);
    along.mutable_data()[i] = arm[0] * t[0] + arm[1] * t[1];
    turning.mutable_data()[i] = (arm[1] * t[0] - arm[0] * t[1]) / speed;
  }
  const py::tuple terms =
      detection_rows(points, covariances, poses, tangents, along, value, measured, twists, sensor, 0.0);
  Array sigma = terms[1].cast<Array>(), jacobian = terms[2].cast<Array>();
  const Index width = jacobian.shape(1);
  for (Index i = 0; i < m; ++i) {
    const double* t = tangents.data() + 2 * i;
    double* J = jacobian.mutable_data() + width * i;
    const double turn = (J[0] * t[0] + J[1] * t[1]) * turning.data()[i];
    double* by_control = J + width - 2 * p;
    for (Index j = 0; j < p; ++j) {
      by_control[2 * j] -= turn * slope.data()[i * p + j] * t[1];
      by_control[2 * j + 1] += turn * slope.data()[i * p + j] * t[0];
    }
    sigma.mutable_data()[i] = std::hypot(sigma.data()[i], sigma_station.data()[i]);
  }
  return py::make_tuple(terms[0], sigma, jacobian);
}

// Detections chosen by row, and the poses at which they were made.
struct Seen {
  Seen(const Ints& rows, const Ints& cycles, const Array& measured, const Array& twists, const Array& poses,
       Index first_cycle, const Array& sensor)
      : cycle(rows.shape(0)), measured(Shape{rows.shape(0), 2}), twist(Shape{rows.shape(0), 3}),
        pose(Shape{rows.shape(0), 3}) {
    const Index all = cycles.shape(0);
    expect(measured.size() == 2 * all && twists.size() == 3 * all);
    for (Index i = 0; i < rows.shape(0); ++i) {
      const Index row = rows.data()[i];
      expect(row >= 0 && row < all);
      const Index slot = cycles.data()[row] - first_cycle;
      expect(slot >= 0 && slot < poses.shape(0));
      cycle.mutable_data()[i] = cycles.data()[row];
      std::copy_n(measured.data() + 2 * row, 2, this->measured.mutable_data() + 2 * i);
      std::copy_n(twists.data() + 3 * row, 3, twist.mutable_data() + 3 * i);
      std::copy_n(poses.data() + 3 * slot, 3, pose.mutable_data() + 3 * i);
    }
    points = to_map(sensor.size() ? shifted(this->measured, twist, sensor) : this->measured, pose);
  }

  Ints cycle;
  Array measured, twist, pose, points;
};

Array placed(const Ints& rows, const Ints& cycles, const Array& measured, const Array& twists,
             const Array& poses, Index first_cycle, const Array& sensor) {
  return rows.size() ? Seen(rows, cycles, measured, twists, poses, first_cycle, sensor).points
                     : Array(Shape{0, 2});
}

Array covariances_of(const Ints& rows, const Array& covariances) {
  Array out(Shape{rows.shape(0), 2, 2});
  for (Index i = 0; i < rows.shape(0); ++i)
    std::copy_n(covariances.data() + 4 * rows.data()[i], 4, out.mutable_data() + 4 * i);
  return out;
}

py::tuple curve_rows(const py::object& spans, const py::tuple& curves, const py::tuple& table, const Ints& cycles,
                     const Array& poses, Index first_cycle, const Array& sensor, const py::tuple& limits,
                     const py::tuple& names, const py::tuple& tolerances) {
  const Array control_points = curves[0].cast<Array>(), trusted = curves[3].cast<Array>();
  const Ints labels = curves[1].cast<Ints>(), control_keys = curves[2].cast<Ints>();
  const Array active_from = curves[4].cast<Array>();
  const Ints cycle = table[0].cast<Ints>(), boundary = table[1].cast<Ints>();
  const py::array_t<bool> used = table[2].cast<py::array_t<bool>>();
  const Array all_u = table[3].cast<Array>();
  const double room = limits[0].cast<double>(), sigma_model = limits[3].cast<double>();
  const double huber = limits[4].cast<double>();
  const Index first_pose = names[0].cast<Index>(), sensor_key = names[1].cast<Index>();
  expect(boundary.size() == cycle.size() && used.size() == cycle.size() && all_u.size() == cycle.size());
  std::vector<Index> chosen;
  for (Index i = 0; i < cycle.shape(0); ++i)
    if (used.data()[i] && std::binary_search(cycles.data(), cycles.data() + cycles.shape(0), cycle.data()[i]))
      chosen.push_back(i);
  const Index m = static_cast<Index>(chosen.size());
  const Ints rows(Shape{m}, chosen.data());
  const Seen seen(rows, cycle, table[4].cast<Array>(), table[5].cast<Array>(), poses, first_cycle, sensor);
  Ints curve(m);
  Array u(m), low(m), high(m);
  for (Index i = 0; i < m; ++i) {
    const Index k = std::lower_bound(labels.data(), labels.data() + labels.shape(0), boundary.data()[chosen[i]]) -
                    labels.data();
    expect(k < labels.shape(0));
    const double at = all_u.data()[chosen[i]];
    curve.mutable_data()[i] = k;
    u.mutable_data()[i] = at;
    low.mutable_data()[i] = at - room;
    high.mutable_data()[i] = std::min(at + room, trusted.data()[k]);
  }
  const py::tuple foot = refined(spans, control_points, seen.points, curve, u, low, high, limits[1].cast<int>(),
                                 limits[2].cast<int>(), tolerances);
  const Array found = foot[0].cast<Array>(), basis = foot[6].cast<Array>();
  const py::array_t<bool> interior = foot[5].cast<py::array_t<bool>>();
  const Ints columns = foot[8].cast<Ints>();
  const py::tuple terms =
      detection_rows(seen.points, covariances_of(rows, table[6].cast<Array>()), seen.pose, foot[3].cast<Array>(),
                     foot[4].cast<Array>(), basis, seen.measured, seen.twist, sensor, sigma_model);
  Array residual = terms[0].cast<Array>(), jacobian = terms[2].cast<Array>();
  const Array sigma = terms[1].cast<Array>();
  const Index p = basis.shape(1), width = jacobian.shape(1), head = sensor.size() ? 2 : 1;
  Ints keys(Shape{m, head + p});
  bool reached = false;
  const bool periodic = spans.attr("periodic").cast<bool>();
  for (Index i = 0; i < m; ++i) {
    const double r = residual.data()[i], s = sigma.data()[i];
    double weight = std::sqrt(1.0 / std::max(std::abs(r / s) / huber, 1.0));
    weight *= (interior.data()[i] ? 1.0 : 0.0) / s;
    residual.mutable_data()[i] = r * weight;
    for (Index j = 0; j < width; ++j) jacobian.mutable_data()[i * width + j] *= weight;
    Index* own = keys.mutable_data() + i * (head + p);
    own[0] = first_pose + seen.cycle.data()[i];
    if (head == 2) own[1] = sensor_key;
    for (Index j = 0; j < p; ++j) own[head + j] = control_keys.data()[columns.data()[i * p + j]];
    reached |= !periodic && found.data()[i] <= active_from.data()[curve.data()[i]];
  }
  return py::make_tuple(rows, found, reached, py::make_tuple(keys, jacobian, residual, seen.cycle));
}

// --- association ------------------------------------------------------------------------------------------

py::tuple open_rows(const Ints& labels, const Ints& since, const Ints& label, const Ints& boundary,
                    const py::array_t<bool>& used, Index unknown) {
  std::vector<Index> rows, curve;
  expect(boundary.size() == label.size() && used.size() == label.size() && since.size() == labels.size());
  for (Index k = 0; k < labels.shape(0); ++k)
    for (Index i = since.data()[k]; i < label.shape(0); ++i) {
      const bool colourless = label.data()[i] == unknown;
      const bool is_open = used.data()[i] ? colourless && boundary.data()[i] != labels.data()[k]
                                          : colourless || label.data()[i] == labels.data()[k];
      if (is_open) rows.push_back(i), curve.push_back(k);
    }
  const Shape shape{static_cast<Index>(rows.size())};
  return py::make_tuple(Ints(shape, rows.data()), Ints(shape, curve.data()));
}

py::tuple in_view(const py::object& spans, const Array& control_points, const Array& trusted, const Array& points,
                  const Ints& curve, const Ints& slot, const py::list& pose_u, const Array& pose,
                  const py::tuple& rooms, double step, int iterations, const py::tuple& tolerances) {
  const Index m = points.shape(0), curves = static_cast<Index>(pose_u.size());
  const double room[4] = {rooms[0].cast<double>(), rooms[1].cast<double>(), rooms[2].cast<double>(),
                          rooms[3].cast<double>()};
  expect(points.size() == 2 * m && curve.size() == m && slot.size() == m && trusted.size() == curves);
  expect(pose.size() == 3);
  std::vector<Array> beside;
  for (const py::handle& own : pose_u) beside.push_back(own.cast<Array>()), expect(beside.back().size() > 0);
  Array all(Shape{m + curves, 2}), low(m + curves), high(m + curves);
  Ints number(m + curves);
  for (Index i = 0; i < m + curves; ++i) {
    const Index k = i < m ? curve.data()[i] : i - m;
    expect(k >= 0 && k < curves);
    const Array& own = beside[k];
    const Index last = own.shape(0) - 1;
    const double u = own.data()[i < m ? std::min(slot.data()[i], last) : last];
    const double* point = i < m ? points.data() + 2 * i : pose.data();
    std::copy_n(point, 2, all.mutable_data() + 2 * i);
    number.mutable_data()[i] = k;
    low.mutable_data()[i] = u - room[i < m ? 0 : 2];
    high.mutable_data()[i] = std::min(u + room[i < m ? 1 : 3], trusted.data()[k]);
  }
  const py::tuple foot = searched(spans, control_points, all, number, low, high, step, iterations, tolerances);
  const Array u = foot[0].cast<Array>(), tangent = foot[2].cast<Array>(), distance = foot[4].cast<Array>();
  py::tuple of_rows(9);
  for (int j = 0; j < 9; ++j) of_rows[j] = foot[j][py::slice(0, m, 1)];
  py::list along;
  const Turn turn(pose.data()[2]);
  for (Index i = m; i < m + curves; ++i) {
    const double* t = tangent.data() + 2 * i;
    along.append(py::make_tuple(u.data()[i], t[0] * turn.c + t[1] * turn.s, distance.data()[i]));
  }
  return py::make_tuple(of_rows, along);
}

double variance_across(const double* n, const double* K, double theta) {
  const Turn turn(theta);
  const double x = turn.c * n[0] + turn.s * n[1], y = -turn.s * n[0] + turn.c * n[1];
  return x * x * K[0] + 2.0 * x * y * K[1] + y * y * K[3];
}

py::tuple gated(const Ints& rows, const Ints& cycle, const Ints& label, const Array& covariances, const Array& poses,
                Index first_cycle, const py::tuple& foot, const py::tuple& limits) {
  const Index m = rows.shape(0);
  const Array normals = foot[0].cast<Array>(), distances = foot[1].cast<Array>();
  const py::array_t<bool> interior = foot[2].cast<py::array_t<bool>>();
  const double sigma_model = limits[0].cast<double>(), floor = limits[1].cast<double>();
  const double rough = limits[2].cast<double>(), chi = limits[3].cast<double>();
  const double chi_unknown = limits[4].cast<double>();
  const Index unknown = limits[5].cast<Index>();
  expect(normals.size() == 2 * m && distances.size() == m && interior.size() == m);
  Array variances(m);
  py::array_t<bool> accepted(m), doubtful(m);
  for (Index i = 0; i < m; ++i) {
    const Index row = rows.data()[i];
    const double theta = poses.data()[3 * (cycle.data()[row] - first_cycle) + 2];
    const double across = std::sqrt(
        variance_across(normals.data() + 2 * i, covariances.data() + 4 * row, theta) + sigma_model * sigma_model);
    const double variance = across * across + floor * floor, d = distances.data()[i];
    const bool colourless = label.data()[row] == unknown, near = interior.data()[i] && std::abs(d) < rough;
    const double limit = colourless ? chi_unknown : chi;
    variances.mutable_data()[i] = variance;
    accepted.mutable_data()[i] = near && d * d < limit * limit * variance;
    doubtful.mutable_data()[i] = near && !accepted.data()[i] && !colourless;
  }
  return py::make_tuple(variances, accepted, doubtful);
}

// --- tentative tracks -------------------------------------------------------------------------------------

void inverse2(const double* A, double* out);

struct MergeGate {  // mapping.tentative: a radius, its multiple for smeared detections, and their sigmas
  explicit MergeGate(const py::tuple& limits)
      : radius(limits[0].cast<double>()), most(limits[1].cast<double>()), chi(limits[2].cast<double>()) {}
  double radius, most, chi;
};

// The track of a detection z with covariance K, of n tracks; -1 if it belongs to none.
Index track_of(const double* z, const double* K, const double* place, const double* inform, Index n,
               const MergeGate& gate) {
  double least = kInfinity;
  Index track = -1;
  for (Index j = 0; j < n; ++j) {
    const double distance = std::hypot(z[0] - place[2 * j], z[1] - place[2 * j + 1]);
    if (distance < least) least = distance, track = j;
  }
  if (least < gate.radius) return track;
  track = -1, least = gate.chi * gate.chi;
  const double farthest = gate.most * gate.radius;
  for (Index j = 0; j < n; ++j) {
    const double dx = z[0] - place[2 * j], dy = z[1] - place[2 * j + 1];
    if (!(dx * dx + dy * dy < farthest * farthest)) continue;
    double joint[4], weight[4];
    inverse2(inform + 4 * j, joint);
    for (int k = 0; k < 4; ++k) joint[k] += K[k];
    inverse2(joint, weight);
    const double square = dx * (weight[0] * dx + weight[1] * dy) + dy * (weight[2] * dx + weight[3] * dy);
    if (square < least) least = square, track = j;
  }
  return track;
}

// Add a detection z with information `weight` to a track.
void add_to(double* at, double* sum, const double* z, const double* weight) {
  double gain[4];
  for (int k = 0; k < 4; ++k) sum[k] += weight[k];
  const double dx = z[0] - at[0], dy = z[1] - at[1];
  const double gx = weight[0] * dx + weight[1] * dy, gy = weight[2] * dx + weight[3] * dy;
  inverse2(sum, gain);
  at[0] += gain[0] * gx + gain[1] * gy, at[1] += gain[2] * gx + gain[3] * gy;
}

// The tracks with detections merged into them; the new ones come last.
py::tuple merged(const py::tuple& known, const Array& points, const Array& covariances, double t,
                 const py::tuple& limits) {
  const Array place = known[0].cast<Array>(), inform = known[1].cast<Array>(), stamps = known[3].cast<Array>();
  const Ints number = known[2].cast<Ints>();
  const MergeGate gate(limits);
  const Index n = place.shape(0), m = points.shape(0);
  expect(inform.size() == 4 * n && number.size() == n && stamps.size() == n);
  expect(points.size() == 2 * m && covariances.size() == 4 * m);
  std::vector<Index> track(m, -1);
  Index count = n;
  for (Index i = 0; i < m; ++i) {
    track[i] = track_of(points.data() + 2 * i, covariances.data() + 4 * i, place.data(), inform.data(), n, gate);
    if (track[i] < 0) ++count;
  }
  Array place_out(Shape{count, 2}), inform_out(Shape{count, 2, 2}), stamps_out(count);
  Ints number_out(count);
  std::copy_n(place.data(), 2 * n, place_out.mutable_data());
  std::copy_n(inform.data(), 4 * n, inform_out.mutable_data());
  std::copy_n(stamps.data(), n, stamps_out.mutable_data());
  std::copy_n(number.data(), n, number_out.mutable_data());
  for (Index i = 0, next = n; i < m; ++i) {
    const double* z = points.data() + 2 * i;
    double weight[4];
    inverse2(covariances.data() + 4 * i, weight);
    if (track[i] < 0) {
      std::copy_n(z, 2, place_out.mutable_data() + 2 * next);
      std::copy_n(weight, 4, inform_out.mutable_data() + 4 * next);
      number_out.mutable_data()[next] = 1, stamps_out.mutable_data()[next++] = t;
      continue;
    }
    add_to(place_out.mutable_data() + 2 * track[i], inform_out.mutable_data() + 4 * track[i], z, weight);
    ++number_out.mutable_data()[track[i]];
    double& last = stamps_out.mutable_data()[track[i]];
    last = std::max(last, t);  // a late detection makes no track older
  }
  return py::make_tuple(place_out, inform_out, number_out, stamps_out);
}

// The tracks of detections that are added one after another.
py::tuple merged_in_turn(const Array& points, const Array& covariances, const py::tuple& limits) {
  const Index m = points.shape(0);
  expect(points.size() == 2 * m && covariances.size() == 4 * m);
  const MergeGate gate(limits);
  std::vector<double> place, inform;
  std::vector<Index> number;
  for (Index i = 0; i < m; ++i) {
    const double *z = points.data() + 2 * i, *K = covariances.data() + 4 * i;
    const Index n = static_cast<Index>(number.size()), track = track_of(z, K, place.data(), inform.data(), n, gate);
    double weight[4];
    inverse2(K, weight);
    if (track < 0) {
      place.insert(place.end(), z, z + 2);
      inform.insert(inform.end(), weight, weight + 4);
      number.push_back(1);
    } else {
      add_to(place.data() + 2 * track, inform.data() + 4 * track, z, weight);
      ++number[track];
    }
  }
  const Index n = static_cast<Index>(number.size());
  Array stamps(n);
  std::fill_n(stamps.mutable_data(), n, 0.0);
  return py::make_tuple(Array(Shape{n, 2}, place.data()), Array(Shape{n, 2, 2}, inform.data()),
                        Ints(n, number.data()), stamps);
}

// --- constellations ---------------------------------------------------------------------------------------

struct ConePoints {  // mapping.constellation:Cones
  explicit ConePoints(const py::tuple& columns)
      : point(columns[0].cast<Array>()), covariance(columns[1].cast<Array>()), label(columns[2].cast<Ints>()) {
    n = label.size();
    expect(point.size() == 2 * n && covariance.size() == 4 * n);
  }
  Array point, covariance;
  Ints label;
  Index n;
};

struct LayLimits {  // mapping.constellation:LIMITS
  explicit LayLimits(const py::tuple& limits)
      : sigma(limits[0].cast<double>()), gate(limits[1].cast<double>()), cell(limits[2].cast<double>()),
        turn(limits[3].cast<double>()), apart(limits[4].cast<double>()),
        places(static_cast<Index>(limits[5].cast<double>())), gain(limits[6].cast<double>()),
        failed(limits[7].cast<double>()) {}
  double sigma, gate, cell, turn, apart;
  Index places;
  double gain, failed;
};

double square3(const double* off, const double* information) {
  double sum = 0.0;
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < 3; ++b) sum += off[a] * information[3 * a + b] * off[b];
  return sum;
}

struct LaidPose {
  double pose[3], information[9], square, count, away;
};

struct LayStart {
  double score, pose[3];
};

// The mean and the poses that may cost least: each pair of cones votes for a cell and the eight around it.
std::vector<LayStart> lay_starts(const ConePoints& seen, const ConePoints& known, const double* mean,
                                 const double* prior, const double* reach, const LayLimits& limits) {
  const Index half = static_cast<Index>(std::ceil(reach[0] / limits.cell)) + 1, width = 2 * half + 1;
  const Index turns = static_cast<Index>(std::ceil(reach[1] / limits.turn));
  std::vector<Index> votes(width * width);
  std::vector<LayStart> starts, best;
  const auto more = [](const LayStart& a, const LayStart& b) { return a.score > b.score; };
  for (Index turn = -turns; turn <= turns; ++turn) {
    const double heading = mean[2] + turn * limits.turn, c = std::cos(heading), s = std::sin(heading);
    std::fill(votes.begin(), votes.end(), 0);
    for (Index i = 0; i < seen.n; ++i) {
      const double x = seen.point.data()[2 * i], y = seen.point.data()[2 * i + 1];
      const double to[2] = {c * x - s * y, s * x + c * y};
      for (Index j = 0; j < known.n; ++j) {
        if (seen.label.data()[i] != known.label.data()[j]) continue;
        Index at[2];
        for (int k = 0; k < 2; ++k) {
          const double move = known.point.data()[2 * j + k] - to[k] - mean[k];
          at[k] = static_cast<Index>(std::floor(clipped(move / limits.cell + 0.5, -1e9, 1e9))) + half;
        }
        if (at[0] <= 0 || at[0] >= 2 * half || at[1] <= 0 || at[1] >= 2 * half) continue;
        for (Index a = at[0] - 1; a <= at[0] + 1; ++a)
          for (Index b = at[1] - 1; b <= at[1] + 1; ++b) ++votes[a * width + b];
      }
    }
    best.clear();
    for (Index k = 0; k < width * width; ++k) {
      if (votes[k] == 0) continue;
      const double off[3] = {(k / width - half) * limits.cell, (k % width - half) * limits.cell, turn * limits.turn};
      const double score = limits.gain * votes[k] - std::min(square3(off, prior), limits.failed);
      best.push_back({score, {mean[0] + off[0], mean[1] + off[1], mean[2] + off[2]}});
    }
    std::stable_sort(best.begin(), best.end(), more);
    starts.insert(starts.end(), best.begin(), best.begin() + std::min<std::size_t>(best.size(), limits.places));
  }
  std::stable_sort(starts.begin(), starts.end(), more);
  starts.insert(starts.begin(), {0.0, {mean[0], mean[1], mean[2]}});
  return starts;
}

constexpr double kLayGates[] = {4.0, 4.0, 2.0, 1.0, 1.0, 1.0};
constexpr double kLayRegular[] = {1e-2, 1e-2, 1.0};

bool lay_in_view(double x, double y, const Array& views) {
  const double* view = views.data();
  for (Index k = 0; k < views.shape(0); ++k, view += 5) {
    const double dx = x - view[0], dy = y - view[1];
    if (!(dx * dx + dy * dy < view[3] * view[3])) continue;
    if (std::abs(std::remainder(std::atan2(dy, dx) - view[2], kTurn)) < view[4]) return true;
  }
  return false;
}

// The pose after Gauss-Newton steps on the sum of capped squares, and what the cones say of it there.
LaidPose lay_refined(const ConePoints& seen, const ConePoints& known, const Array& views, const double* start,
                     const double* mean, const double* prior, const LayLimits& limits) {
  LaidPose out = {};
  std::copy_n(start, 3, out.pose);
  const double floor = limits.sigma * limits.sigma;
  for (int step = 0; step <= 6; ++step) {
    const double limit = limits.gate * (step < 6 ? kLayGates[step] : 1.0);
    const Turn turn(out.pose[2]);
    double A[3][3] = {}, g[3] = {};
    for (Index i = 0; i < seen.n; ++i) {
      const double *p = seen.point.data() + 2 * i, *K = seen.covariance.data() + 4 * i;
      const double arm[2] = {turn.c * p[0] - turn.s * p[1], turn.s * p[0] + turn.c * p[1]};
      const double cc = turn.c * turn.c, ss = turn.s * turn.s, cs = turn.c * turn.s;
      const double both = 0.5 * (K[1] + K[2]);
      const double xx = cc * K[0] - 2.0 * cs * both + ss * K[3], yy = ss * K[0] + 2.0 * cs * both + cc * K[3];
      const double xy = cs * (K[0] - K[3]) + (cc - ss) * both;
      double least = kInfinity, weight[4] = {}, off[2] = {};
      for (Index j = 0; j < known.n; ++j) {
        if (seen.label.data()[i] != known.label.data()[j]) continue;
        const double* q = known.covariance.data() + 4 * j;
        const double total[4] = {xx + q[0] + floor, xy + q[1], xy + q[2], yy + q[3] + floor};
        const double dx = arm[0] + out.pose[0] - known.point.data()[2 * j];
        const double dy = arm[1] + out.pose[1] - known.point.data()[2 * j + 1];
        // the square is at least this, since no eigenvalue exceeds the trace
        if (!(dx * dx + dy * dy < std::min(least, limit) * (total[0] + total[3]))) continue;
        double inverse[4];
        inverse2(total, inverse);
        const double square = dx * (inverse[0] * dx + inverse[1] * dy) + dy * (inverse[2] * dx + inverse[3] * dy);
        if (square < least) {
          least = square, off[0] = dx, off[1] = dy;
          std::copy_n(inverse, 4, weight);
        }
      }
      if (step == 6 && (least < limit || lay_in_view(arm[0] + out.pose[0], arm[1] + out.pose[1], views)))
        ++out.count, out.square += std::min(least, limits.gate);
      if (!(least < limit)) continue;
      const double share = 1.0 - least / limit, w = step < 6 ? share * share : 1.0;
      const double by[2][3] = {{1.0, 0.0, -arm[1]}, {0.0, 1.0, arm[0]}};
      for (int a = 0; a < 3; ++a)
        for (int r = 0; r < 2; ++r)
          for (int k = 0; k < 2; ++k) {
            const double value = w * by[r][a] * weight[2 * r + k];
            g[a] += value * off[k];
            for (int b = 0; b < 3; ++b) A[a][b] += value * by[k][b];
          }
    }
    if (step < 6) {
      for (int a = 0; a < 3; ++a) A[a][a] += kLayRegular[a];
      solve3(A, g);
      for (int a = 0; a < 3; ++a) out.pose[a] -= g[a];
      continue;
    }
    std::copy_n(&A[0][0], 9, out.information);
    double away[3];
    for (int k = 0; k < 3; ++k) away[k] = out.pose[k] - mean[k];
    away[2] = std::remainder(away[2], kTurn);
    out.away = square3(away, prior);
  }
  return out;
}

py::tuple laid(const py::tuple& seen_columns, const py::tuple& known_columns, const Array& views, const Array& mean,
               const Array& prior, const py::tuple& reach, const py::tuple& tuple) {
  const ConePoints seen(seen_columns), known(known_columns);
  const LayLimits limits(tuple);
  expect(mean.size() == 3 && prior.size() == 9 && views.size() == 5 * views.shape(0));
  const double within[2] = {reach[0].cast<double>(), reach[1].cast<double>()};
  std::vector<LayStart> tried;
  std::vector<LaidPose> found;
  for (const LayStart& start : lay_starts(seen, known, mean.data(), prior.data(), within, limits)) {
    const bool is_near = std::any_of(tried.begin(), tried.end(), [&](const LayStart& other) {
      return std::hypot(start.pose[0] - other.pose[0], start.pose[1] - other.pose[1]) < limits.apart &&
             std::abs(start.pose[2] - other.pose[2]) < 1.5 * limits.turn;
    });
    if (is_near) continue;
    tried.push_back(start);
    found.push_back(lay_refined(seen, known, views, start.pose, mean.data(), prior.data(), limits));
    if (static_cast<Index>(tried.size()) == 3 * limits.places) break;
  }
  const Index m = static_cast<Index>(found.size());
  Array poses({m, Index{3}}), information({m, Index{3}, Index{3}}), squares(m), counts(m), away(m);
  for (Index k = 0; k < m; ++k) {
    std::copy_n(found[k].pose, 3, poses.mutable_data() + 3 * k);
    std::copy_n(found[k].information, 9, information.mutable_data() + 9 * k);
    squares.mutable_data()[k] = found[k].square;
    counts.mutable_data()[k] = found[k].count;
    away.mutable_data()[k] = found[k].away;
  }
  return py::make_tuple(poses, information, squares, counts, away);
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

Array whitener(const Array& covariance, double least) {
  expect(covariance.size() == 9);
  const double* K = covariance.data();
  double L[3][3] = {}, values[9] = {};
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
  return Array(Shape{3, 3}, values);
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

py::tuple whitened_odometry(const Array& starts, const Array& ends, const Array& deltas, const Array& whiteners,
                            const Array& by_calibration, const Array& calibration) {
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
      D[r][8] = plain.data()[3 * i + r] + (G[2 * r] * calibration.data()[0] + G[2 * r + 1] * calibration.data()[1]);
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

// A step of `match`: how many are matched, the information and the gradient at a pose, and the cost there.
Index match_step(const Array& recent, const Array& points_vehicle, const Array& variances, const double* pose,
                 double reach, const py::tuple& limits, double* information, double* gradient, bool* is_matched,
                 double* total) {
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

py::tuple matched(const Array& recent, const Array& points_vehicle, const Array& variances, const Array& start,
                  const Array& reaches, const py::tuple& limits) {
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

void inverse2(const double* A, double* out) {
  const double det = A[0] * A[3] - A[1] * A[2];
  out[0] = A[3] / det, out[1] = -A[1] / det, out[2] = -A[2] / det, out[3] = A[0] / det;
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

// --- gate -------------------------------------------------------------------------------------------------

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

// --- sightings --------------------------------------------------------------------------------------------

// Cones that are followed, column by column.
struct Cones {
  explicit Cones(const py::tuple& columns) {
    const auto places = columns[0].cast<Array>(), ranges = columns[2].cast<Array>(), stamps = columns[3].cast<Array>();
    const auto labels = columns[1].cast<Ints>(), numbers = columns[4].cast<Ints>();
    const Index n = labels.size();
    expect(places.size() == 2 * n && ranges.size() == n && stamps.size() == n && numbers.size() == n);
    for (Index j = 0; j < n; ++j)
      all.push_back({{places.data()[2 * j], places.data()[2 * j + 1]}, labels.data()[j], ranges.data()[j],
                     stamps.data()[j], numbers.data()[j]});
  }

  py::tuple columns() const {
    const Index n = static_cast<Index>(all.size());
    Array places(Shape{n, 2}), ranges(n), stamps(n);
    Ints labels(n), numbers(n);
    for (Index j = 0; j < n; ++j) {
      std::copy_n(all[j].at, 2, places.mutable_data() + 2 * j);
      labels.mutable_data()[j] = all[j].label, ranges.mutable_data()[j] = all[j].nearest;
      stamps.mutable_data()[j] = all[j].last, numbers.mutable_data()[j] = all[j].number;
    }
    return py::make_tuple(places, labels, ranges, stamps, numbers);
  }

  struct Cone {
    double at[2];
    Index label;
    double nearest, last;
    Index number;
  };
  std::vector<Cone> all;
};

py::tuple followed(const Ints& begins, const Array& stamps, const Array& places, const Array& points, const Ints& labels,
                   const Array& ranges, const Array& along, const Array& across, const py::tuple& known, Index count,
                   const py::tuple& limits) {
  const Index m = points.shape(0), cycles = stamps.size();
  expect(begins.size() == cycles + 1 && places.size() == 2 * cycles && points.size() == 2 * m);
  expect(labels.size() == m && ranges.size() == m && along.size() == m && across.size() == m);
  for (Index k = 0; k < cycles; ++k) expect(begins.data()[k] >= 0 && begins.data()[k] <= begins.data()[k + 1]);
  expect(begins.data()[cycles] <= m);
  const double max_age = limits[0].cast<double>(), nearer = limits[1].cast<double>(), farther = limits[2].cast<double>();
  Cones cones(known);
  auto& all = cones.all;
  Ints numbers(m);
  Index* number = numbers.mutable_data();
  std::fill_n(number, m, -1);
  std::vector<Index> lone;
  std::vector<double> sums, closest;
  for (Index k = 0; k < cycles; ++k) {
    const double t = stamps.data()[k], *place = places.data() + 2 * k;
    // The squared offset of a point from a detection on the detection's ray, in its gates.
    const auto square = [&](Index i, const double* other) {
      const double* p = points.data() + 2 * i;
      double rx = p[0] - place[0], ry = p[1] - place[1];
      const double range = std::max(std::hypot(rx, ry), std::numeric_limits<double>::min());
      rx /= range, ry /= range;
      const double dx = other[0] - p[0], dy = other[1] - p[1];
      const double a = (dx * rx + dy * ry) / along.data()[i], c = (dy * rx - dx * ry) / across.data()[i];
      return a * a + c * c;
    };
    all.erase(std::remove_if(all.begin(), all.end(), [&](const Cones::Cone& one) { return !(one.last > t - max_age); }),
              all.end());
    const Index n = static_cast<Index>(all.size()), first = begins.data()[k], end = begins.data()[k + 1];
    std::vector<Index> cone(end - first, -1), counts(n, 0);
    sums.assign(2 * n, 0.0), closest.assign(n, kInfinity), lone.clear();
    for (Index i = first; i < end; ++i) {
      double best = 1.0;
      for (Index j = 0; j < n; ++j) {
        if (all[j].label != labels.data()[i]) continue;
        const double off = square(i, all[j].at);
        if (off < best) best = off, cone[i - first] = j;
      }
      if (cone[i - first] >= 0) ++counts[cone[i - first]], number[i] = all[cone[i - first]].number;
      else lone.push_back(i);
    }
    for (Index i = first; i < end; ++i) {
      const Index j = cone[i - first];
      if (j < 0) continue;
      for (int c = 0; c < 2; ++c) sums[2 * j + c] += points.data()[2 * i + c] / static_cast<double>(counts[j]);
      closest[j] = std::min(closest[j], ranges.data()[i]);
    }
    for (Index j = 0; j < n; ++j) {
      if (counts[j] == 0) continue;
      const double weight = closest[j] <= all[j].nearest ? nearer : farther;
      for (int c = 0; c < 2; ++c) all[j].at[c] += weight * (sums[2 * j + c] - all[j].at[c]);
      all[j].nearest = std::min(all[j].nearest, closest[j]), all[j].last = t;
    }
    // Each of the others is a cone of its own, unless it lies beside an earlier one: then it is of that one's cone.
    for (std::size_t a = 0; a < lone.size(); ++a) {
      const Index i = lone[a];
      std::size_t b = 0;
      while (b < a && !(labels.data()[i] == labels.data()[lone[b]] && square(i, points.data() + 2 * lone[b]) < 1.0)) ++b;
      if (b < a) {
        if (cone[lone[b] - first] == kOwn) number[i] = number[lone[b]];
        continue;
      }
      const double* p = points.data() + 2 * i;
      cone[i - first] = kOwn, number[i] = count;
      all.push_back({{p[0], p[1]}, labels.data()[i], ranges.data()[i], t, count++});
    }
  }
  return py::make_tuple(numbers, cones.columns(), count);
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
          both[a][j] = moved.mutable_data()[kErrors * row + j] = columns.data()[kErrors * row + j] - mean[a][j];
        both[a][kErrors] = off.mutable_data()[row] = points.data()[row] - mean[a][kErrors];
      }
      for (int a = 0; a < 2; ++a)
        for (Index j = 0; j < kBoth; ++j)
          weighted[a][j] = w[2 * a] * both[0][j] + w[2 * a + 1] * both[1][j];
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
    const double x = turn.c * z[0] - turn.s * z[1], y = turn.s * z[0] + turn.c * z[1], turned = bias[2] - then[2];
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
  return py::make_tuple(Ints(k, rows.data()), Ints(k, counts.data()), Array(Shape{k, 1 + width}, means.data()));
}

}  // namespace

PYBIND11_MODULE(_kernels, module) {
  module.doc() = "Compiled functions of arrays, which _kernels.pyi describes.";
  module.attr("COMPILER") = COMPILER;
  module.def("searched", &searched);
  module.def("refined", &refined);
  module.def("summed", &summed);
  module.def("block_of", &block_of);
  module.def("moved_residual", &moved_residual);
  module.def("parted", &parted);
  module.def("relative_block", &relative_block);
  module.def("link_means", &link_means);
  module.def("origin_by_active", &origin_by_active);
  module.def("replaced", &replaced);
  module.def("owners_holding", &owners_holding);
  module.def("laid_out", &laid_out);
  module.def("columns_of", &columns_of);
  module.def("shifted", &shifted);
  module.def("to_map", &to_map);
  module.def("detection_rows", &detection_rows);
  module.def("station_rows", &station_rows);
  module.def("placed", &placed);
  module.def("curve_rows", &curve_rows);
  module.def("open_rows", &open_rows);
  module.def("in_view", &in_view);
  module.def("gated", &gated);
  module.def("merged", &merged);
  module.def("merged_in_turn", &merged_in_turn);
  module.def("laid", &laid);
  module.def("whitened_odometry", &whitened_odometry);
  module.def("along_and_across", &along_and_across);
  module.def("odometry_residuals", &odometry_residuals);
  module.def("integrated", &integrated);
  module.def("weighted_means", &weighted_means);
  module.def("matched", &matched);
  module.def("followed", &followed);
  module.def("centred", &centred);
  module.def("by_constants", &by_constants);
  module.def("references", &references);
  module.def("off_prediction", &off_prediction);
  module.def("squared", &squared);
  module.def("learned", &learned);
  module.def("usable", &usable);
  module.def("whitener", &whitener);
  module.def("spread", &spread);
}
