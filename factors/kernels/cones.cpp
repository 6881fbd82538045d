// Detections merged to cones (`mapping/tentative.py`) or followed from cycle to cycle
// (`front_end/sightings.py`).

#include "common.hpp"

namespace kernels {
namespace {

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
  const Array place = known[0].cast<Array>(), inform = known[1].cast<Array>(),
              stamps = known[3].cast<Array>();
  const Ints number = known[2].cast<Ints>();
  const MergeGate gate(limits);
  const Index n = place.shape(0), m = points.shape(0);
  expect(inform.size() == 4 * n && number.size() == n && stamps.size() == n);
  expect(points.size() == 2 * m && covariances.size() == 4 * m);
  std::vector<Index> track(m, -1);
  Index count = n;
  for (Index i = 0; i < m; ++i) {
    track[i] =
        track_of(points.data() + 2 * i, covariances.data() + 4 * i, place.data(), inform.data(), n, gate);
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
    const Index n = static_cast<Index>(number.size()),
                track = track_of(z, K, place.data(), inform.data(), n, gate);
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

// --- sightings --------------------------------------------------------------------------------------------

// Cones that are followed, column by column.
struct Cones {
  explicit Cones(const py::tuple& columns) {
    const auto places = columns[0].cast<Array>(), ranges = columns[2].cast<Array>(),
               stamps = columns[3].cast<Array>();
    const auto labels = columns[1].cast<Ints>(), numbers = columns[4].cast<Ints>();
    const Index n = labels.size();
    expect(places.size() == 2 * n && ranges.size() == n && stamps.size() == n && numbers.size() == n);
    for (Index j = 0; j < n; ++j)
      all.push_back({{places.data()[2 * j], places.data()[2 * j + 1]},
                     labels.data()[j],
                     ranges.data()[j],
                     stamps.data()[j],
                     numbers.data()[j]});
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

py::tuple followed(const Ints& begins, const Array& stamps, const Array& places, const Array& points,
                   const Ints& labels, const Array& ranges, const Array& along, const Array& across,
                   const py::tuple& known, Index count, const py::tuple& limits) {
  const Index m = points.shape(0), cycles = stamps.size();
  expect(begins.size() == cycles + 1 && places.size() == 2 * cycles && points.size() == 2 * m);
  expect(labels.size() == m && ranges.size() == m && along.size() == m && across.size() == m);
  for (Index k = 0; k < cycles; ++k)
    expect(begins.data()[k] >= 0 && begins.data()[k] <= begins.data()[k + 1]);
  expect(begins.data()[cycles] <= m);
  const double max_age = limits[0].cast<double>(), nearer = limits[1].cast<double>(),
               farther = limits[2].cast<double>();
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
    all.erase(std::remove_if(all.begin(), all.end(),
                             [&](const Cones::Cone& one) { return !(one.last > t - max_age); }),
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
      if (cone[i - first] >= 0)
        ++counts[cone[i - first]], number[i] = all[cone[i - first]].number;
      else
        lone.push_back(i);
    }
    for (Index i = first; i < end; ++i) {
      const Index j = cone[i - first];
      if (j < 0) continue;
      for (int c = 0; c < 2; ++c)
        sums[2 * j + c] += points.data()[2 * i + c] / static_cast<double>(counts[j]);
      closest[j] = std::min(closest[j], ranges.data()[i]);
    }
    for (Index j = 0; j < n; ++j) {
      if (counts[j] == 0) continue;
      const double weight = closest[j] <= all[j].nearest ? nearer : farther;
      for (int c = 0; c < 2; ++c) all[j].at[c] += weight * (sums[2 * j + c] - all[j].at[c]);
      all[j].nearest = std::min(all[j].nearest, closest[j]), all[j].last = t;
    }
    // Each of the others is a cone of its own, unless it lies beside an earlier one: then it is of that one's
    // cone.
    for (std::size_t a = 0; a < lone.size(); ++a) {
      const Index i = lone[a];
      std::size_t b = 0;
      while (b < a &&
             !(labels.data()[i] == labels.data()[lone[b]] && square(i, points.data() + 2 * lone[b]) < 1.0))
        ++b;
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

}  // namespace

void add_cones(py::module_& module) {
  module.def("merged", &merged);
  module.def("merged_in_turn", &merged_in_turn);
  module.def("followed", &followed);
}

}  // namespace kernels
