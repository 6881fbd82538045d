// The module of all kernels. _kernels.pyi says what each computes, and tests hold each against one in numpy.

#include "common.hpp"

#define QUOTED_(x) #x
#define QUOTED(x) QUOTED_(x)
#if defined(__clang__)
#define COMPILER "clang " QUOTED(__clang_major__) "." QUOTED(__clang_minor__)
#elif defined(__GNUC__)
#define COMPILER "gcc " QUOTED(__GNUC__) "." QUOTED(__GNUC_MINOR__)
#else
#define COMPILER "MSVC " QUOTED(_MSC_VER)
#endif

namespace kernels {

void add_foot_points(py::module_& module);
void add_layouts(py::module_& module);
void add_rows(py::module_& module);
void add_links(py::module_& module);
void add_detections(py::module_& module);
void add_cones(py::module_& module);
void add_constellations(py::module_& module);
void add_odometry(py::module_& module);
void add_motion_check(py::module_& module);
void add_scan_matching(py::module_& module);
void add_noise(py::module_& module);

}  // namespace kernels

PYBIND11_MODULE(_kernels, module) {
  module.doc() = "Compiled functions of arrays, which _kernels.pyi describes.";
  module.attr("COMPILER") = COMPILER;
  kernels::add_foot_points(module);
  kernels::add_layouts(module);
  kernels::add_rows(module);
  kernels::add_links(module);
  kernels::add_detections(module);
  kernels::add_cones(module);
  kernels::add_constellations(module);
  kernels::add_odometry(module);
  kernels::add_motion_check(module);
  kernels::add_scan_matching(module);
  kernels::add_noise(module);
}
