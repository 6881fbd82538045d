// Detections of a cycle registered to earlier ones (`front_end/motion.py`).

#include "scan_matching.hpp"

namespace kernels {

Matching::Matching(const py::handle& of)
    : of_lines(of.attr("of_lines").cast<bool>()),
      min_matched(of.attr("min_matched").cast<Index>()),
      min_doubting(of.attr("min_doubting").cast<Index>()),
      farthest(of.attr("farthest").cast<double>()),
      min_weight(of.attr("min_weight").cast<double>()),
      huber(of.attr("huber").cast<double>()),
      sigma_cone(of.attr("sigma_cone").cast<double>()),
      least_share(of.attr("least_share").cast<double>()),
      most_misfit(of.attr("most_misfit").cast<double>()),
      misfit_gain(of.attr("misfit_gain").cast<double>()),
      large_misfit(of.attr("large_misfit").cast<double>()),
      line_reach(of.attr("line_reach").cast<double>()),
      least_points(of.attr("least_points").cast<double>()),
      least_spread(of.attr("least_spread").cast<double>()),
      least_shape(of.attr("least_shape").cast<double>()),
      least_inside(of.attr("least_inside").cast<double>()),
      line_held(pose_of(of.attr("line_held").cast<Array>())),
      lines_alike(pose_of(of.attr("lines_alike").cast<Array>())) {}

Nearby::Nearby(const double* place, const Doubles& earlier, double reach, double farthest) {
  for (size_t j = 0; j < earlier.size(); j += 2) {
    const double dx = earlier[j] - place[0], dy = earlier[j + 1] - place[1];
    const double square = (dx * dx + dy * dy) / (reach * reach);
    if (!(square < farthest * farthest)) continue;
    const double own = std::exp(-0.5 * square);
    weight += own, x += own * dx, y += own * dy;
    xx += own * dx * dx, xy += own * dx * dy, yy += own * dy * dy;
  }
}

namespace {

// A detection beside earlier ones: its offset from their mean, or along the normal of their line.
struct Beside {
  bool matched;
  double weight, off[2], normal[2];
};

Beside beside(const double* place, const Doubles& earlier, double reach, const Matching& by) {
  if (by.of_lines) reach *= by.line_reach;
  const Nearby sums(place, earlier, reach, by.farthest);
  const double total = std::max(sums.weight, std::numeric_limits<double>::min());
  const double x = sums.x / total, y = sums.y / total;
  if (!by.of_lines) return {total > by.min_weight, total, {-x, -y}, {}};
  const double xx = sums.xx / total - x * x, xy = sums.xy / total - x * y, yy = sums.yy / total - y * y;
  const double middle = 0.5 * (xx + yy), half = std::hypot(0.5 * (xx - yy), xy);
  const double along = middle + half, across = std::max(middle - half, 0.0);
  const Turn tangent(0.5 * std::atan2(2.0 * xy, xx - yy));
  const double spread = by.least_spread * reach;
  const bool matched = total > by.least_points && along > spread * spread &&
                       along > by.least_shape * across &&
                       std::abs(x * tangent.c + y * tangent.s) < by.least_inside * reach;
  const double off = x * tangent.s - y * tangent.c;
  return {matched, total, {-off * tangent.s, off * tangent.c}, {-tangent.s, tangent.c}};
}

double precision_of(const Beside& one, double variance, const Matching& by) {
  return 1.0 / (variance * (1.0 + 1.0 / one.weight) + by.sigma_cone * by.sigma_cone);
}

// What the detections say at the pose of a match; returns the gradient.
Pose linearize(const Doubles& earlier, const Seen& seen, double reach, const Matching& by, Match& match) {
  const Turn turn(match.pose[2]);
  Pose gradient{};
  double cost = 0.0, w = 0.0, wx = 0.0, wy = 0.0, turning = 0.0, point[2];
  Matrix3 across{};
  match.count = 0;
  for (size_t i = 0; i < seen.variances.size(); ++i) {
    point_in_map(match.pose, turn, &seen.points[2 * i], point);
    const Beside one = beside(point, earlier, reach, by);
    match.is_matched[i] = one.matched;
    if (!one.matched) continue;
    ++match.count;
    const double ex = one.off[0], ey = one.off[1], square = ex * ex + ey * ey;
    const double ax = point[0] - match.pose[0], ay = point[1] - match.pose[1];
    const double stated = precision_of(one, seen.variances[i], by);
    const double precision = stated / std::max(std::sqrt(square * stated) / by.huber, 1.0);
    gradient[0] += precision * ex, gradient[1] += precision * ey;
    gradient[2] += precision * (ax * ey - ay * ex);
    cost += square * (by.of_lines ? stated : precision);
    const double of[3] = {one.normal[0], one.normal[1], ax * one.normal[1] - ay * one.normal[0]};
    for (int k = 0; k < 9; ++k) across[k] += precision * of[k / 3] * of[k % 3];
    w += precision, wx += precision * ax, wy -= precision * ay;
    turning += precision * (ax * ax + ay * ay);
  }
  match.information = by.of_lines ? across : Matrix3{w, 0.0, wy, 0.0, w, wx, wy, wx, turning};
  match.misfit = cost / std::max<Index>(match.count, 1);
  return gradient;
}

}  // namespace

Match match(const Doubles& earlier, const Seen& seen, const Pose& start, const Doubles& reaches,
            const Matching& by) {
  Match found;
  found.pose = start;
  found.is_matched.resize(seen.variances.size());
  const Pose& held = by.line_held;
  Matrix3 known{};  // information about a line's start
  if (by.of_lines) known = turned(squares_of({1.0 / held[0], 1.0 / held[1], 1.0 / held[2]}), start[2]);
  for (const double reach : reaches) {
    Pose gradient = linearize(earlier, seen, reach, by, found);
    if (!by.of_lines && found.count < by.min_matched) return found;  // a line's start is held
    Matrix3 hessian = found.information;
    for (int i = 0; i < 9; ++i) {
      if (i % 4 == 0 && !by.of_lines) hessian[i] *= 1.0 + by.least_share;
      hessian[i] += known[i];
      gradient[i / 3] += known[i] * (found.pose[i % 3] - start[i % 3]);
    }
    const Pose step = solved(hessian, gradient);
    for (int i = 0; i < 3; ++i) found.pose[i] -= step[i];
  }
  if (by.of_lines) {  // what a line's points show depends on the pose more than what cones show
    linearize(earlier, seen, reaches.back(), by, found);
    Matrix3 both = found.information;
    for (int i = 0; i < 9; ++i) both[i] += known[i];
    Matrix3 covariance = inverse3(both);
    const Matrix3 shared = turned(squares_of(by.lines_alike), start[2]);
    for (int i = 0; i < 9; ++i) covariance[i] += shared[i];
    found.information = inverse3(covariance);
    // 0.05 rad of the heading: then lines hold the pose
    found.is_certain = found.count >= by.min_matched && covariance[8] < 0.05 * 0.05;
  } else {
    const Matrix3& I = found.information;  // of x and y: I[0] times the identity
    const double determinant = I[0] * (I[0] * I[8] - I[2] * I[2] - I[5] * I[5]);
    const double product = std::max(I[0] * I[0] * I[8], std::numeric_limits<double>::min());
    found.is_certain = determinant / product > by.least_share;
  }
  return found;
}

double misfit(const Doubles& earlier, const Seen& seen, const Pose& pose, double reach, const Matching& by) {
  const Turn turn(pose[2]);
  const Index m = seen.variances.size();
  double sum = 0.0, point[2];
  for (Index i = 0; i < m; ++i) {
    point_in_map(pose, turn, &seen.points[2 * i], point);
    const Beside one = beside(point, earlier, reach, by);
    const double square = one.off[0] * one.off[0] + one.off[1] * one.off[1];
    sum += one.matched ? std::min(square * precision_of(one, seen.variances[i], by), by.most_misfit)
                       : by.most_misfit;
  }
  return m ? sum / m : 0.0;
}

// --- for Python -------------------------------------------------------------------------------------------

namespace {

Doubles doubles(const Array& values) { return Doubles(values.data(), values.data() + values.size()); }

Seen seen_of(const Array& points, const Array& variances) {
  expect(points.size() == 2 * variances.size());
  return {doubles(points), doubles(variances)};
}

py::tuple matched(const Array& earlier, const Array& points, const Array& variances, const Array& start,
                  const Array& reaches, const py::object& by) {
  expect(earlier.size() % 2 == 0 && reaches.size() > 0);
  const Match found =
      match(doubles(earlier), seen_of(points, variances), pose_of(start), doubles(reaches), Matching(by));
  py::array_t<bool> is_matched(found.is_matched.size());
  std::copy(found.is_matched.begin(), found.is_matched.end(), is_matched.mutable_data());
  return py::make_tuple(array_of({3}, found.pose), array_of({3, 3}, found.information), is_matched,
                        found.misfit, found.is_certain);
}

double misfit_at(const Array& earlier, const Array& points, const Array& variances, const Array& pose,
                 double reach, const py::object& by) {
  expect(earlier.size() % 2 == 0);
  return misfit(doubles(earlier), seen_of(points, variances), pose_of(pose), reach, Matching(by));
}

}  // namespace

void add_scan_matching(py::module_& module) {
  module.def("matched", &matched);
  module.def("misfit", &misfit_at);
}

}  // namespace kernels
