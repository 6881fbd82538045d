// Whitened rows on variables, and those that a window keeps (`graph/rows.py`).

#pragma once

#include "common.hpp"

namespace kernels {

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
  explicit Pattern(const py::handle& rows);         // graph.rows:Rows
  Pattern(const Layout& layout, const Rows& rows);  // on known variables
  void add(Index width);

  std::vector<Index> widths, key, entry;
};

struct Group {
  Rows rows;
  Pattern pattern;
};

// Rows `J d + r` with d = value - reference, which are kept until those of their owner are replaced. Rows on
// variables of the same widths are one group, which no call changes: copies of a store share it.
class RowStore {
 public:
  const std::vector<Group>& groups() const { return groups_; }
  py::list parts() const;
  Ints holding(const Ints& keys) const;
  py::array_t<bool> stale(const Ints& owners, const Ints& keys) const;
  void replace(const Ints& owners, const py::sequence& fresh, const py::handle& layout, const Array& change);
  void drop(const Ints& owners);
  py::tuple pop(Index owner, const py::handle& layout);

 private:
  std::vector<Group> groups_;  // never empty ones
};

}  // namespace kernels
