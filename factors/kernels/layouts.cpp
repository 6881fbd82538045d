// Layouts of a flat vector by keys (`graph/variables.py`).

#include "common.hpp"

namespace kernels {
namespace {

constexpr Index kIndices = Index{1} << 56;  // keys of one letter

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
    const bool senses = key >= sensor_key && key - sensor_key < kIndices;  // of any sensor
    total += widths.mutable_data()[i] = key >= first_pose ? pose : senses ? sensor : point;
  }
  py::list begins(bounds.shape(0));
  for (Index b = 0; b < bounds.shape(0); ++b) {
    const Index place = std::lower_bound(keys.data(), keys.data() + count, bounds.data()[b]) - keys.data();
    begins[b] = place < count ? starts.data()[place] : total;
  }
  return py::make_tuple(widths, starts, total, begins);
}

}  // namespace

void add_layouts(py::module_& module) {
  module.def("laid_out", &laid_out);
  module.def("spread", &spread);
}

}  // namespace kernels
