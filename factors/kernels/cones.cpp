// Detections merged to tracks of cones (`mapping/tracks.py`).

#include <numeric>

#include "common.hpp"

namespace kernels {
namespace {

constexpr Index kLabels = 5;  // of labels.NAMES

struct Track {
  double at[2], inform[4], last;
  Index number, votes[kLabels];
};

struct Gate {  // mapping.tracks: radius, its multiple for smeared detections, their sigmas, memory, by label
  explicit Gate(const py::tuple& limits)
      : radius(limits[0].cast<double>()),
        most(limits[1].cast<double>()),
        chi(limits[2].cast<double>()),
        memory(limits[3].cast<double>()),
        by_label(limits[4].cast<bool>()) {}
  double radius, most, chi, memory;
  bool by_label;
};

std::vector<Track> from_columns(const py::tuple& columns) {
  const auto places = columns[0].cast<Array>(), inform = columns[1].cast<Array>(),
             stamps = columns[3].cast<Array>();
  const auto votes = columns[2].cast<Ints>(), numbers = columns[4].cast<Ints>();
  const Index n = numbers.size();
  expect(places.size() == 2 * n && inform.size() == 4 * n && stamps.size() == n);
  expect(votes.size() == kLabels * n);
  std::vector<Track> tracks(n);
  for (Index j = 0; j < n; ++j) {
    std::copy_n(places.data() + 2 * j, 2, tracks[j].at);
    std::copy_n(inform.data() + 4 * j, 4, tracks[j].inform);
    std::copy_n(votes.data() + kLabels * j, kLabels, tracks[j].votes);
    tracks[j].last = stamps.data()[j], tracks[j].number = numbers.data()[j];
  }
  return tracks;
}

py::tuple to_columns(const std::vector<Track>& tracks) {
  const Index n = static_cast<Index>(tracks.size());
  Array places(Shape{n, 2}), inform(Shape{n, 2, 2}), stamps(n);
  Ints votes(Shape{n, kLabels}), numbers(n);
  for (Index j = 0; j < n; ++j) {
    std::copy_n(tracks[j].at, 2, places.mutable_data() + 2 * j);
    std::copy_n(tracks[j].inform, 4, inform.mutable_data() + 4 * j);
    std::copy_n(tracks[j].votes, kLabels, votes.mutable_data() + kLabels * j);
    stamps.mutable_data()[j] = tracks[j].last, numbers.mutable_data()[j] = tracks[j].number;
  }
  return py::make_tuple(places, inform, votes, stamps, numbers);
}

// The track of a detection z with covariance K among the possible ones; -1 if it belongs to none.
Index track_of(const double* z, const double* K, Index label, const std::vector<Track>& tracks,
               const std::vector<Index>& possible, const Gate& gate) {
  double least = kInfinity;
  Index track = -1;
  const auto differs = [&](const Track& one) { return gate.by_label && one.votes[label] == 0; };
  for (const Index j : possible) {
    if (std::abs(z[0] - tracks[j].at[0]) > gate.radius || differs(tracks[j])) continue;
    const double distance = std::hypot(z[0] - tracks[j].at[0], z[1] - tracks[j].at[1]);
    if (distance < least) least = distance, track = j;
  }
  if (least < gate.radius) return track;
  track = -1, least = gate.chi * gate.chi;
  const double farthest = gate.most * gate.radius;
  for (const Index j : possible) {
    const double dx = z[0] - tracks[j].at[0], dy = z[1] - tracks[j].at[1];
    if (!(dx * dx + dy * dy < farthest * farthest) || differs(tracks[j])) continue;
    double joint[4], weight[4];
    inverse2(tracks[j].inform, joint);
    for (int k = 0; k < 4; ++k) joint[k] += K[k];
    inverse2(joint, weight);
    const double square = dx * (weight[0] * dx + weight[1] * dy) + dy * (weight[2] * dx + weight[3] * dy);
    if (square < least) least = square, track = j;
  }
  return track;
}

// The tracks after detections were added, those of a stamp together, and the number of the track of each.
py::tuple merged(const py::tuple& known, const Array& points, const Array& covariances, const Ints& labels,
                 const Array& stamps, Index next, const py::tuple& limits) {
  const Index m = labels.size();
  expect(points.size() == 2 * m && covariances.size() == 4 * m && stamps.size() == m);
  const double *z = points.data(), *K = covariances.data(), *t = stamps.data();
  const Gate gate(limits);
  std::vector<Track> tracks = from_columns(known);
  Ints numbers(m);
  std::vector<Index> track(m), possible(tracks.size());
  std::iota(possible.begin(), possible.end(), 0);
  for (Index begin = 0, end = 0; begin < m; begin = end) {
    const auto is_old = [&](Index j) { return !(tracks[j].last > t[begin] - gate.memory); };
    possible.erase(std::remove_if(possible.begin(), possible.end(), is_old), possible.end());
    for (; end < m && t[end] == t[begin]; ++end) {
      const Index label = labels.data()[end];
      expect(label >= 0 && label < kLabels);
      track[end] = track_of(z + 2 * end, K + 4 * end, label, tracks, possible, gate);
    }
    for (Index i = begin; i < end; ++i) {
      double weight[4], gain[4];
      inverse2(K + 4 * i, weight);
      if (track[i] < 0) {
        track[i] = static_cast<Index>(tracks.size());
        possible.push_back(track[i]);
        tracks.push_back({{z[2 * i], z[2 * i + 1]}, {}, t[i], next++, {}});
        std::copy_n(weight, 4, tracks.back().inform);
      } else {
        Track& one = tracks[track[i]];
        for (int k = 0; k < 4; ++k) one.inform[k] += weight[k];
        const double dx = z[2 * i] - one.at[0], dy = z[2 * i + 1] - one.at[1];
        const double gx = weight[0] * dx + weight[1] * dy, gy = weight[2] * dx + weight[3] * dy;
        inverse2(one.inform, gain);
        one.at[0] += gain[0] * gx + gain[1] * gy, one.at[1] += gain[2] * gx + gain[3] * gy;
        one.last = std::max(one.last, t[i]);  // a late detection makes no track older
      }
      ++tracks[track[i]].votes[labels.data()[i]], numbers.mutable_data()[i] = tracks[track[i]].number;
    }
  }
  return py::make_tuple(to_columns(tracks), numbers);
}

}  // namespace

void add_cones(py::module_& module) { module.def("merged", &merged); }

}  // namespace kernels
