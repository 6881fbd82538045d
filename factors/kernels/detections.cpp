// Detections: placed, associated, and their rows on curves (`mapping/`).

#include "detections.hpp"

#include "foot_points.hpp"

namespace kernels {
void sensor_columns(const double* z, const double* twist, double (*C)[kSensor]) {
  const double distance = std::max(std::hypot(z[0], z[1]), std::numeric_limits<double>::min());
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
  expect(points.size() == 2 * m && sensor.size() == kSensor);
  expect(twists.size() == 3 * m || twists.size() == 3);
  const Index next = twists.size() == 3 ? 0 : 3;  // one twist for all
  Array out(Shape{m, 2});
  double C[2][kSensor];
  for (Index i = 0; i < m; ++i) {
    sensor_columns(points.data() + 2 * i, twists.data() + next * i, C);
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

namespace {

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
    const double variance = own[0] * own[0] * K[0] + 2.0 * own[0] * own[1] * K[1] + own[1] * own[1] * K[3];
    sigma.mutable_data()[i] = std::sqrt(variance + sigma_model * sigma_model);
    const double r = distances.data()[i];
    double factor = 1.0;
    if (sensed) {
      const double distance = std::max(std::hypot(z[0], z[1]), std::numeric_limits<double>::min());
      const double along = (own[0] * z[0] + own[1] * z[1]) / distance;
      const double square = own[0] * own[0] + own[1] * own[1];
      const double rates[2] = {square, (square - along * along) / distance};
      factor = 1.0 / (1.0 - rates[0] * sensor.data()[3] - rates[1] * sensor.data()[4]);
      sensor_columns(z, twists.data() + 3 * i, C);
      for (Index k = 0; k < kSensor; ++k) J[3 + k] = factor * (own[0] * C[0][k] + own[1] * C[1][k]);
      J[6] += r * factor * factor * rates[0];
      J[7] += r * factor * factor * rates[1];
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
    const double speed = std::hypot(velocity[0], velocity[1]),
                 t[2] = {velocity[0] / speed, velocity[1] / speed};
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

// The rows of an array, chosen by index.
template <typename T>
T taken(const T& from, const std::vector<Index>& rows) {
  Shape shape(from.shape(), from.shape() + from.ndim());
  const Index all = shape[0], width = from.size() / std::max<Index>(all, 1);
  shape[0] = Index(rows.size());
  T out(shape);
  for (Index i = 0; i < shape[0]; ++i) {
    expect(rows[i] >= 0 && rows[i] < all);
    std::copy_n(from.data() + width * rows[i], width, out.mutable_data() + width * i);
  }
  return out;
}

// Detections chosen by row, and the poses at which they were made.
struct Seen {
  Seen(const std::vector<Index>& rows, const Ints& cycles, const Array& measured, const Array& twists,
       const Array& poses, Index first_cycle, const Array& sensor)
      : cycle(taken(cycles, rows)), measured(taken(measured, rows)), twist(taken(twists, rows)) {
    std::vector<Index> slots(cycle.data(), cycle.data() + cycle.size());
    for (Index& slot : slots) slot -= first_cycle;
    pose = taken(poses, slots);
    points = to_map(sensor.size() ? shifted(this->measured, twist, sensor) : this->measured, pose);
  }

  Ints cycle;
  Array measured, twist, pose, points;
};

Array placed(const Ints& rows, const Ints& cycles, const Array& measured, const Array& twists,
             const Array& poses, Index first_cycle, const Array& sensor) {
  const std::vector<Index> chosen(rows.data(), rows.data() + rows.size());
  return Seen(chosen, cycles, measured, twists, poses, first_cycle, sensor).points;
}

// Whiten rows, weight them by Huber's loss (0 where `counts` is false), and return the parts of `Rows`.
py::tuple weighted(const py::tuple& terms, const Ints& cycle, const Ints& columns, const bool* counts,
                   const Ints& control_keys, double huber, Index first_pose, const Ints& sensor_key) {
  Array residual = terms[0].cast<Array>(), jacobian = terms[2].cast<Array>();
  const Array sigma = terms[1].cast<Array>();
  const Index m = cycle.size(), p = columns.shape(1), width = jacobian.shape(1), head = 1 + sensor_key.size();
  Ints keys(Shape{m, head + p});
  for (Index i = 0; i < m; ++i) {
    const double s = sigma.data()[i];
    double weight = std::sqrt(1.0 / std::max(std::abs(residual.data()[i] / s) / huber, 1.0));
    weight *= (counts == nullptr || counts[i] ? 1.0 : 0.0) / s;
    residual.mutable_data()[i] *= weight;
    for (Index j = 0; j < width; ++j) jacobian.mutable_data()[i * width + j] *= weight;
    Index* own = keys.mutable_data() + i * (head + p);
    own[0] = first_pose + cycle.data()[i];
    if (head == 2) own[1] = sensor_key.data()[0];
    for (Index j = 0; j < p; ++j) own[head + j] = control_keys.data()[columns.data()[i * p + j]];
  }
  return py::make_tuple(keys, jacobian, residual, cycle);
}

py::tuple curve_rows(const Curves& curves, const py::tuple& on_curves, const py::tuple& table,
                     const Ints& cycles, const Array& poses, Index first_cycle, const Array& sensor,
                     const py::tuple& limits, const py::tuple& names, const py::object& stations) {
  const Array control_points = on_curves[0].cast<Array>(), trusted = on_curves[3].cast<Array>();
  const Ints labels = on_curves[1].cast<Ints>(), control_keys = on_curves[2].cast<Ints>();
  const Array active_from = on_curves[4].cast<Array>();
  const Ints cycle = table[0].cast<Ints>(), boundary = table[1].cast<Ints>();
  const py::array_t<bool> used = table[2].cast<py::array_t<bool>>();
  const Array all_u = table[3].cast<Array>(), covariances = table[6].cast<Array>();
  const double room = limits[0].cast<double>(), huber = limits[3].cast<double>();
  const Index first_pose = names[0].cast<Index>();
  const Ints sensor_key(Shape{sensor.size() ? 1 : 0}, std::array{names[1].cast<Index>()}.data());
  expect(boundary.size() == cycle.size() && used.size() == cycle.size() && all_u.size() == cycle.size());
  std::vector<Index> chosen;
  for (Index i = 0; i < cycle.shape(0); ++i)
    if (used.data()[i] && std::binary_search(cycles.data(), cycles.data() + cycles.shape(0), cycle.data()[i]))
      chosen.push_back(i);
  const Index m = Index(chosen.size());
  const Seen seen(chosen, cycle, table[4].cast<Array>(), table[5].cast<Array>(), poses, first_cycle, sensor);
  Ints curve(m);
  Array u(m), low(m), high(m);
  for (Index i = 0; i < m; ++i) {
    const Index k =
        std::lower_bound(labels.data(), labels.data() + labels.shape(0), boundary.data()[chosen[i]]) -
        labels.data();
    expect(k < labels.shape(0));
    const double at = all_u.data()[chosen[i]];
    curve.mutable_data()[i] = k;
    u.mutable_data()[i] = at;
    low.mutable_data()[i] = at - room;
    high.mutable_data()[i] = std::min(at + room, trusted.data()[k]);
  }
  const py::tuple foot =
      curves.refine(control_points, seen.points, curve, u, low, high, limits[1].cast<int>());
  const Array found = foot[0].cast<Array>();
  bool reached = false;
  for (Index i = 0; i < m; ++i)
    reached |= !curves.periodic && found.data()[i] <= active_from.data()[curve.data()[i]];
  const py::array_t<bool> interior = foot[5].cast<py::array_t<bool>>();
  const auto parts = [&](const py::tuple& terms, const Ints& own, const Ints& columns, const bool* counts) {
    return weighted(terms, own, columns, counts, control_keys, huber, first_pose, sensor_key);
  };
  const py::tuple across = detection_rows(seen.points, taken(covariances, chosen), seen.pose,
                                          foot[3].cast<Array>(), foot[4].cast<Array>(), foot[6].cast<Array>(),
                                          seen.measured, seen.twist, sensor, limits[2].cast<double>());
  py::list groups;
  groups.append(parts(across, seen.cycle, foot[8].cast<Ints>(), interior.data()));
  if (!stations.is_none()) {
    const py::tuple laid = stations.cast<py::tuple>();
    const Ints station = table[7].cast<Ints>(), columns = laid[2].cast<Ints>();
    std::vector<Index> rows, at, controls;
    for (const Index row : chosen)
      if (station.data()[row] >= 0) rows.push_back(row), at.push_back(station.data()[row]);
    const Ints own = taken(columns, at);
    controls.assign(own.data(), own.data() + own.size());
    const Seen there(rows, cycle, table[4].cast<Array>(), table[5].cast<Array>(), poses, first_cycle, sensor);
    const py::tuple along =
        station_rows(there.points, taken(covariances, rows), there.pose, taken(laid[0].cast<Array>(), at),
                     taken(laid[1].cast<Array>(), at), taken(control_points, controls), there.measured,
                     there.twist, sensor, taken(laid[3].cast<Array>(), at));
    groups.append(parts(along, there.cycle, own, nullptr));
  }
  return py::make_tuple(Ints(Shape{m}, chosen.data()), found, reached, groups);
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

py::tuple in_view(const Curves& laid, const Array& control_points, const Array& trusted, const Array& points,
                  const Ints& curve, const Ints& slot, const py::list& pose_u, const Array& pose,
                  const py::tuple& rooms, double step, int iterations) {
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
  const py::tuple foot = laid.search(control_points, all, number, low, high, step, iterations);
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

py::tuple gated(const Ints& rows, const Ints& cycle, const Ints& label, const Array& covariances,
                const Array& poses, Index first_cycle, const py::tuple& foot, const py::tuple& limits) {
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
    const double across =
        std::sqrt(variance_across(normals.data() + 2 * i, covariances.data() + 4 * row, theta) +
                  sigma_model * sigma_model);
    const double variance = across * across + floor * floor, d = distances.data()[i];
    const bool colourless = label.data()[row] == unknown, near = interior.data()[i] && std::abs(d) < rough;
    const double limit = colourless ? chi_unknown : chi;
    variances.mutable_data()[i] = variance;
    accepted.mutable_data()[i] = near && d * d < limit * limit * variance;
    doubtful.mutable_data()[i] = near && !accepted.data()[i] && !colourless;
  }
  return py::make_tuple(variances, accepted, doubtful);
}

}  // namespace

void add_detections(py::module_& module) {
  module.def("shifted", &shifted);
  module.def("to_map", &to_map);
  module.def("detection_rows", &detection_rows);
  module.def("station_rows", &station_rows);
  module.def("placed", &placed);
  module.def("curve_rows", &curve_rows);
  module.def("open_rows", &open_rows);
  module.def("in_view", &in_view);
  module.def("gated", &gated);
}

}  // namespace kernels
