// Rows of a window: replaced, dropped, and summed into the system of a step (`graph/rows.py`).

#include "common.hpp"

namespace kernels {
namespace {

struct Layout {  // graph.variables:Layout
  explicit Layout(const py::handle& layout)
      : keys(layout.attr("keys").cast<Ints>()),
        starts(layout.attr("starts").cast<Ints>()),
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
      : keys(rows.attr("keys").cast<Ints>()),
        jacobian(rows.attr("jacobian").cast<Array>()),
        residual(rows.attr("residual").cast<Array>()),
        owner(rows.attr("owner").cast<Ints>()) {
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
      : layout_(layout),
        rows_(rows),
        k_(rows.keys.shape(1)),
        wanted_(k_),
        begin_(k_),
        columns_(rows.width()) {
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

void add_rows(double* H, double* g, Index n, const py::handle& own, const Layout& layout,
              const double* change) {
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

py::tuple replaced(const py::handle& rows, const Ints& gone, const py::handle& fresh,
                   const py::handle& layout, const Array& change) {
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

}  // namespace

void add_rows(py::module_& module) {
  module.def("summed", &summed);
  module.def("block_of", &block_of);
  module.def("moved_residual", &moved_residual);
  module.def("parted", &parted);
  module.def("relative_block", &relative_block);
  module.def("replaced", &replaced);
  module.def("owners_holding", &owners_holding);
  module.def("laid_out", &laid_out);
  module.def("columns_of", &columns_of);
  module.def("spread", &spread);
}

}  // namespace kernels
