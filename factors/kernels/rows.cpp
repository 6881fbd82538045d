// Rows of a window: kept, replaced, dropped, and summed into the system of a step (`graph/rows.py`).

#include "rows.hpp"

#include <map>

namespace kernels {
namespace {

// The columns of one row after another; the keys of neighbouring rows are mostly the same.
class RowColumns {
 public:
  RowColumns(const Layout& layout, const Rows& rows, const Pattern& pattern)
      : layout_(layout),
        rows_(rows),
        pattern_(pattern),
        k_(rows.keys.shape(1)),
        wanted_(k_),
        begin_(k_),
        columns_(rows.width()) {
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
  const Pattern& pattern_;
  Index k_;
  std::vector<Index> wanted_, begin_, columns_;
};

void add_group(double* H, double* g, Index n, const Group& group, const Layout& layout,
               const double* change) {
  const Rows& rows = group.rows;
  RowColumns columns(layout, rows, group.pattern);
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

py::tuple summed(const py::handle& own_layout, const py::list& factors, const RowStore& rows,
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
  for (const Group& group : rows.groups()) add_group(H, g, n, group, layout, change.data());
  return py::make_tuple(hessian, gradient);
}

struct RowIn {
  const Group* group;
  Index row;
  const Index* keys() const { return group->rows.keys.data() + row * group->rows.keys.shape(1); }
};

// Rows `[J -r]` on the variables that they hold, and the places of these variables.
py::tuple block_on(const Layout& layout, const std::vector<RowIn>& rows) {
  Index width = 0;
  std::vector<Index> first(layout.size(), -1), held;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const Index k = rows[i].group->rows.keys.shape(1);
    const bool follows = i > 0 && rows[i].group == rows[i - 1].group;
    for (Index c = 0; c < k; ++c)  // neighbouring rows mostly hold the same variables
      if (!follows || rows[i].keys()[c] != rows[i - 1].keys()[c]) first[layout.place(rows[i].keys()[c])] = 0;
  }
  for (Index k = 0; k < layout.size(); ++k)
    if (first[k] == 0) held.push_back(k), first[k] = width, width += layout.widths.data()[k];
  const Index height = static_cast<Index>(rows.size());
  Columns block(Shape{height, width + 1});
  double* at = block.mutable_data();
  std::fill_n(at, height * (width + 1), 0.0);
  std::vector<Index> begin;
  for (Index i = 0; i < height; ++i, ++at) {
    const Rows& own = rows[i].group->rows;
    const Pattern& pattern = rows[i].group->pattern;
    const bool follows = i > 0 && rows[i].group == rows[i - 1].group;
    begin.resize(own.keys.shape(1));
    for (std::size_t c = 0; c < begin.size(); ++c)
      if (!follows || rows[i].keys()[c] != rows[i - 1].keys()[c])
        begin[c] = first[layout.place(rows[i].keys()[c])];
    const double* jacobian = own.jacobian.data() + rows[i].row * own.width();
    for (Index j = 0; j < own.width(); ++j)
      at[(begin[pattern.key[j]] + pattern.entry[j]) * height] = jacobian[j];
    at[width * height] = -own.residual.data()[rows[i].row];
  }
  return py::make_tuple(Ints(Shape{static_cast<Index>(held.size())}, held.data()), block);
}

py::list blocks_of(const py::handle& own_layout, const py::sequence& groups) {
  const Layout layout(own_layout);
  std::vector<Group> all;
  for (const py::handle& own : groups) {
    const Rows rows(own);
    if (rows.size() == 0) continue;
    all.push_back({rows, Pattern(own)});
    expect(Index(all.back().pattern.key.size()) == rows.width());
  }
  std::map<Index, std::vector<RowIn>> owned;
  for (const Group& group : all)
    for (Index i = 0; i < group.rows.size(); ++i) owned[group.rows.owner.data()[i]].push_back({&group, i});
  py::list blocks;
  for (const auto& [owner, rows] : owned) {
    const py::tuple block = block_on(layout, rows);
    blocks.append(py::make_tuple(owner, block[0], block[1]));
  }
  return blocks;
}

Ints columns_of(const py::handle& own_layout, const py::handle& own) {
  const Layout layout(own_layout);
  const Rows rows(own);
  Ints out(Shape{rows.size(), rows.width()});
  const Pattern pattern = rows.size() ? Pattern(own) : Pattern();
  RowColumns columns(layout, rows, pattern);
  for (Index i = 0; i < rows.size(); ++i) {
    const std::vector<Index>& at = columns.of(i);
    std::copy(at.begin(), at.end(), out.mutable_data() + i * rows.width());
  }
  return out;
}

Array residual_after(const Layout& layout, const Rows& rows, const Pattern& pattern, const Array& change) {
  Array out(rows.size());
  RowColumns columns(layout, rows, pattern);
  for (Index i = 0; i < rows.size(); ++i) {
    const std::vector<Index>& at = columns.known(i);
    const double* J = rows.jacobian.data() + i * rows.width();
    double by_change = 0.0;
    for (Index j = 0; j < rows.width(); ++j) by_change += J[j] * change.data()[at[j]];
    out.mutable_data()[i] = rows.residual.data()[i] - by_change;
  }
  return out;
}

Array moved_residual(const py::handle& own_layout, const py::handle& own, const Array& change) {
  const Rows rows(own);
  return residual_after(Layout(own_layout), rows, rows.size() ? Pattern(own) : Pattern(), change);
}

std::vector<bool> owned_by(const Rows& rows, const Ints& owners) {
  std::vector<bool> is(rows.size());
  for (Index i = 0; i < rows.size(); ++i)
    is[i] = std::binary_search(owners.data(), owners.data() + owners.shape(0), rows.owner.data()[i]);
  return is;
}

bool holds(const Rows& rows, Index row, const Ints& ascending) {
  const Index k = rows.keys.shape(1);
  const Index* own = rows.keys.data() + row * k;
  const Index* first = ascending.data();
  return std::any_of(own, own + k,
                     [&](Index one) { return std::binary_search(first, first + ascending.size(), one); });
}

Ints as_array(const std::vector<Index>& values) { return Ints(Shape{Index(values.size())}, values.data()); }

Rows staying(const Rows& all, const std::vector<bool>& goes) {
  Rows stay(std::count(goes.begin(), goes.end(), false), all.keys.shape(1), all.width());
  for (Index i = 0, kept = 0; i < all.size(); ++i)
    if (!goes[i]) stay.set(kept++, all, i);
  return stay;
}

}  // namespace

Pattern::Pattern(const py::handle& rows) {
  for (const py::handle& width : rows.attr("widths")) add(width.cast<Index>());
}

Pattern::Pattern(const Layout& layout, const Rows& rows) {
  for (Index j = 0; j < rows.keys.shape(1); ++j) add(layout.widths.data()[layout.place(rows.keys.data()[j])]);
  expect(Index(key.size()) == rows.width());
}

void Pattern::add(Index width) {
  for (Index j = 0; j < width; ++j) key.push_back(Index(widths.size())), entry.push_back(j);
  widths.push_back(width);
}

py::list RowStore::parts() const {
  py::list parts;
  for (const Group& group : groups_) parts.append(group.rows.parts());
  return parts;
}

Ints RowStore::holding(const Ints& keys) const {
  std::vector<Index> found;
  for (const Group& group : groups_)
    for (Index i = 0; i < group.rows.size(); ++i)
      if (holds(group.rows, i, keys)) found.push_back(group.rows.owner.data()[i]);
  return as_array(found);
}

py::array_t<bool> RowStore::stale(const Ints& owners, const Ints& keys) const {
  const Index* first = owners.data();
  const Index* last = first + owners.size();
  py::array_t<bool> out(owners.size());
  std::vector<char> has(owners.size(), 0), moved(owners.size(), 0);
  for (const Group& group : groups_) {
    for (Index i = 0; i < group.rows.size(); ++i) {
      const Index* place = std::lower_bound(first, last, group.rows.owner.data()[i]);
      if (place == last || *place != group.rows.owner.data()[i]) continue;
      has[place - first] = 1;
      if (!moved[place - first]) moved[place - first] = holds(group.rows, i, keys);
    }
  }
  for (Index k = 0; k < owners.size(); ++k) out.mutable_data()[k] = !has[k] || moved[k];
  return out;
}

void RowStore::replace(const Ints& owners, const py::sequence& fresh, const py::handle& own_layout,
                       const Array& change) {
  const Layout layout(own_layout);
  std::vector<std::pair<Pattern, std::vector<Rows>>> added;
  for (const py::handle& own : fresh) {
    const Rows rows(own);
    if (rows.size() == 0) continue;
    const Pattern pattern(layout, rows);
    auto same = std::find_if(added.begin(), added.end(),
                             [&](const auto& one) { return one.first.widths == pattern.widths; });
    if (same == added.end()) same = added.insert(added.end(), {pattern, {}});
    same->second.push_back(rows);
  }
  for (const Group& group : groups_)
    if (std::none_of(added.begin(), added.end(),
                     [&](const auto& one) { return one.first.widths == group.pattern.widths; }))
      added.push_back({group.pattern, {}});
  std::vector<Group> groups;
  for (const auto& [pattern, parts] : added) {
    const auto old = std::find_if(groups_.begin(), groups_.end(), [&, &own = pattern](const Group& one) {
      return one.pattern.widths == own.widths;
    });
    const std::vector<bool> goes = old == groups_.end() ? std::vector<bool>() : owned_by(old->rows, owners);
    Index at = 0, size = std::count(goes.begin(), goes.end(), false);
    for (const Rows& rows : parts) size += rows.size();
    if (size == 0) continue;
    Rows out(size, Index(pattern.widths.size()), Index(pattern.key.size()));
    for (Index i = 0; i < Index(goes.size()); ++i)
      if (!goes[i]) out.set(at++, old->rows, i);
    for (const Rows& rows : parts) {
      const Array residual = residual_after(layout, rows, pattern, change);
      for (Index i = 0; i < rows.size(); ++i, ++at) {
        out.set(at, rows, i);
        out.residual.mutable_data()[at] = residual.data()[i];
      }
    }
    groups.push_back({out, pattern});
  }
  groups_ = groups;
}

void RowStore::drop(const Ints& owners) {
  std::vector<Group> groups;
  for (const Group& group : groups_) {
    const Rows stay = staying(group.rows, owned_by(group.rows, owners));
    if (stay.size()) groups.push_back({stay, group.pattern});
  }
  groups_ = groups;
}

py::tuple RowStore::pop(Index owner, const py::handle& layout) {
  std::vector<RowIn> popped;
  for (const Group& group : groups_)
    for (Index i = 0; i < group.rows.size(); ++i)
      if (group.rows.owner.data()[i] == owner) popped.push_back({&group, i});
  const py::tuple block = block_on(Layout(layout), popped);
  drop(Ints(Shape{1}, &owner));
  return block;
}

void add_rows(py::module_& module) {
  module.def("summed", &summed);
  module.def("blocks_of", &blocks_of);
  module.def("moved_residual", &moved_residual);
  module.def("columns_of", &columns_of);
  py::class_<RowStore>(module, "RowStore")
      .def(py::init<>())
      .def("copy", [](const RowStore& store) { return RowStore(store); })
      .def("parts", &RowStore::parts)
      .def("holding", &RowStore::holding)
      .def("stale", &RowStore::stale)
      .def("replace", &RowStore::replace)
      .def("drop", &RowStore::drop)
      .def("pop", &RowStore::pop);
}

}  // namespace kernels
