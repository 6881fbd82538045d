// Relative factors and the links of the inactive map (`graph/relative.py`, `graph/inactive.py`).

#include "common.hpp"

namespace kernels {
namespace {

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

struct Part {  // the variables that have left with a link, or those that it depends on:
               // graph.variables:Layout
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

std::vector<Link> links_of(const py::list& links, const Ints& frames, const Ints& leaving,
                           const Ints& others) {
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

py::tuple origin_by_active(const Array& values, const py::list& links, const Ints& frames,
                           const Ints& leaving, const Ints& others, Index origin) {
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
      for (Index i = 0; i < q; ++i)
        b[i] = A[r * n + link.left.columns[i]], A[r * n + link.left.columns[i]] = 0.0;
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

}  // namespace

void add_links(py::module_& module) {
  module.def("relative_block", &relative_block);
  module.def("link_means", &link_means);
  module.def("origin_by_active", &origin_by_active);
}

}  // namespace kernels
