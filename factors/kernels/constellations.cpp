// Seen cones laid on known ones (`places/find.py`).

#include "common.hpp"

namespace kernels {
namespace {

struct ConePoints {  // places.find:Constellation.cones
  ConePoints() = default;
  explicit ConePoints(const py::tuple& columns) {
    const auto points = columns[0].cast<Array>(), covariances = columns[1].cast<Array>();
    const auto labels = columns[2].cast<Ints>();
    n = labels.size();
    expect(points.size() == 2 * n && covariances.size() == 4 * n);
    point.assign(points.data(), points.data() + 2 * n);
    covariance.assign(covariances.data(), covariances.data() + 4 * n);
    label.assign(labels.data(), labels.data() + n);
  }

  // Those within a radius of a position.
  ConePoints near(const double* at, double radius) const {
    ConePoints found;
    for (Index i = 0; i < n; ++i) {
      const double dx = point[2 * i] - at[0], dy = point[2 * i + 1] - at[1];
      if (!(dx * dx + dy * dy < radius * radius)) continue;
      found.point.insert(found.point.end(), &point[2 * i], &point[2 * i] + 2);
      found.covariance.insert(found.covariance.end(), &covariance[4 * i], &covariance[4 * i] + 4);
      found.label.push_back(label[i]);
    }
    found.n = static_cast<Index>(found.label.size());
    return found;
  }

  double extent() const {
    double most = 0.0;
    for (Index i = 0; i < n; ++i) most = std::max(most, std::hypot(point[2 * i], point[2 * i + 1]));
    return most;
  }

  std::vector<double> point, covariance;
  std::vector<Index> label;
  Index n = 0;
};

struct LayLimits {  // places.find:FIT_LIMITS
  explicit LayLimits(const py::tuple& limits)
      : sigma(limits[0].cast<double>()),
        gate(limits[1].cast<double>()),
        cell(limits[2].cast<double>()),
        turn(limits[3].cast<double>()),
        apart(limits[4].cast<double>()),
        places(static_cast<Index>(limits[5].cast<double>())),
        gain(limits[6].cast<double>()),
        failed(limits[7].cast<double>()) {}
  double sigma, gate, cell, turn, apart;
  Index places;
  double gain, failed;
};

double square3(const double* off, const double* information) {
  double sum = 0.0;
  for (int a = 0; a < 3; ++a)
    for (int b = 0; b < 3; ++b) sum += off[a] * information[3 * a + b] * off[b];
  return sum;
}

// The squared Mahalanobis distance of a pose from a mean.
double lay_away(const double* pose, const double* mean, const double* information) {
  const double off[3] = {pose[0] - mean[0], pose[1] - mean[1], std::remainder(pose[2] - mean[2], kTurn)};
  return square3(off, information);
}

struct LaidPose {
  double pose[3], information[9], square, count, away;
};

struct LayStart {
  double score, pose[3];
  Index hypothesis;
};

// The poses about a centre that may cost least: each pair of cones votes for a cell and the eight around it.
std::vector<LayStart> lay_starts(const ConePoints& seen, const ConePoints& known, const double* centre,
                                 const double* mean, const double* prior, const double* reach,
                                 const LayLimits& limits, Index hypothesis) {
  const Index half = static_cast<Index>(std::ceil(reach[0] / limits.cell)) + 1, width = 2 * half + 1;
  const Index turns = static_cast<Index>(std::ceil(reach[1] / limits.turn));
  std::vector<Index> votes(width * width);
  std::vector<LayStart> starts, best;
  const auto more = [](const LayStart& a, const LayStart& b) { return a.score > b.score; };
  for (Index turn = -turns; turn <= turns; ++turn) {
    const double heading = centre[2] + turn * limits.turn, c = std::cos(heading), s = std::sin(heading);
    std::fill(votes.begin(), votes.end(), 0);
    for (Index i = 0; i < seen.n; ++i) {
      const double x = seen.point[2 * i], y = seen.point[2 * i + 1];
      const double to[2] = {c * x - s * y, s * x + c * y};
      for (Index j = 0; j < known.n; ++j) {
        if (seen.label[i] != known.label[j]) continue;
        Index at[2];
        for (int k = 0; k < 2; ++k) {
          const double move = known.point[2 * j + k] - to[k] - centre[k];
          at[k] = static_cast<Index>(std::floor(clipped(move / limits.cell + 0.5, -1e9, 1e9))) + half;
        }
        if (at[0] <= 0 || at[0] >= 2 * half || at[1] <= 0 || at[1] >= 2 * half) continue;
        for (Index a = at[0] - 1; a <= at[0] + 1; ++a)
          for (Index b = at[1] - 1; b <= at[1] + 1; ++b) ++votes[a * width + b];
      }
    }
    best.clear();
    for (Index k = 0; k < width * width; ++k) {
      if (votes[k] == 0) continue;
      const double pose[3] = {centre[0] + (k / width - half) * limits.cell,
                              centre[1] + (k % width - half) * limits.cell, heading};
      const double score = limits.gain * votes[k] - std::min(lay_away(pose, mean, prior), limits.failed);
      best.push_back({score, {pose[0], pose[1], pose[2]}, hypothesis});
    }
    std::stable_sort(best.begin(), best.end(), more);
    starts.insert(starts.end(), best.begin(),
                  best.begin() + std::min<std::size_t>(best.size(), limits.places));
  }
  return starts;
}

constexpr double kLayRoom = 10.0;  // beyond its reach, about a hypothesis (m)
constexpr double kLayGates[] = {4.0, 4.0, 2.0, 1.0, 1.0, 1.0};
constexpr double kLayRegular[] = {1e-2, 1e-2, 1.0};

bool lay_in_view(double x, double y, const Array& views) {
  const double* view = views.data();
  for (Index k = 0; k < views.shape(0); ++k, view += 5) {
    const double dx = x - view[0], dy = y - view[1];
    if (!(dx * dx + dy * dy < view[3] * view[3])) continue;
    if (std::abs(std::remainder(std::atan2(dy, dx) - view[2], kTurn)) < view[4]) return true;
  }
  return false;
}

// The pose after Gauss-Newton steps on the sum of capped squares, and what the cones say of it there.
LaidPose lay_refined(const ConePoints& seen, const ConePoints& known, const Array& views, const double* start,
                     const double* mean, const double* prior, const LayLimits& limits) {
  LaidPose out = {};
  std::copy_n(start, 3, out.pose);
  const double floor = limits.sigma * limits.sigma;
  for (int step = 0; step <= 6; ++step) {
    const double limit = limits.gate * (step < 6 ? kLayGates[step] : 1.0);
    const Turn turn(out.pose[2]);
    double A[3][3] = {}, g[3] = {};
    for (Index i = 0; i < seen.n; ++i) {
      const double *p = &seen.point[2 * i], *K = &seen.covariance[4 * i];
      const double arm[2] = {turn.c * p[0] - turn.s * p[1], turn.s * p[0] + turn.c * p[1]};
      const double cc = turn.c * turn.c, ss = turn.s * turn.s, cs = turn.c * turn.s;
      const double both = 0.5 * (K[1] + K[2]);
      const double xx = cc * K[0] - 2.0 * cs * both + ss * K[3], yy = ss * K[0] + 2.0 * cs * both + cc * K[3];
      const double xy = cs * (K[0] - K[3]) + (cc - ss) * both;
      double least = kInfinity, weight[4] = {}, off[2] = {};
      for (Index j = 0; j < known.n; ++j) {
        if (seen.label[i] != known.label[j]) continue;
        const double* q = &known.covariance[4 * j];
        const double total[4] = {xx + q[0] + floor, xy + q[1], xy + q[2], yy + q[3] + floor};
        const double dx = arm[0] + out.pose[0] - known.point[2 * j];
        const double dy = arm[1] + out.pose[1] - known.point[2 * j + 1];
        // the square is at least this, since no eigenvalue exceeds the trace
        if (!(dx * dx + dy * dy < std::min(least, limit) * (total[0] + total[3]))) continue;
        double inverse[4];
        inverse2(total, inverse);
        const double square =
            dx * (inverse[0] * dx + inverse[1] * dy) + dy * (inverse[2] * dx + inverse[3] * dy);
        if (square < least) {
          least = square, off[0] = dx, off[1] = dy;
          std::copy_n(inverse, 4, weight);
        }
      }
      if (step == 6 && (least < limit || lay_in_view(arm[0] + out.pose[0], arm[1] + out.pose[1], views)))
        ++out.count, out.square += std::min(least, limits.gate);
      if (!(least < limit)) continue;
      const double share = 1.0 - least / limit, w = step < 6 ? share * share : 1.0;
      const double by[2][3] = {{1.0, 0.0, -arm[1]}, {0.0, 1.0, arm[0]}};
      for (int a = 0; a < 3; ++a)
        for (int r = 0; r < 2; ++r)
          for (int k = 0; k < 2; ++k) {
            const double value = w * by[r][a] * weight[2 * r + k];
            g[a] += value * off[k];
            for (int b = 0; b < 3; ++b) A[a][b] += value * by[k][b];
          }
    }
    if (step < 6) {
      for (int a = 0; a < 3; ++a) A[a][a] += kLayRegular[a];
      solve3(A, g);
      for (int a = 0; a < 3; ++a) out.pose[a] -= g[a];
      continue;
    }
    std::copy_n(&A[0][0], 9, out.information);
    out.away = lay_away(out.pose, mean, prior);
  }
  return out;
}

py::tuple laid(const py::tuple& seen_columns, const py::tuple& known_columns, const Array& views,
               const Array& centres, const Array& means, const Array& prior, const py::tuple& reach,
               const py::tuple& tuple) {
  const ConePoints seen(seen_columns), all(known_columns);
  const LayLimits limits(tuple);
  expect(means.ndim() == 2 && means.shape(1) == 3 && prior.size() == 9 && views.size() == 5 * views.shape(0));
  expect(centres.ndim() == 2 && centres.size() == means.size());
  const double within[2] = {reach[0].cast<double>(), reach[1].cast<double>()};
  const double radius = seen.extent() + within[0] + kLayRoom;
  std::vector<ConePoints> known;
  std::vector<LayStart> starts, by_votes, tried;
  for (Index k = 0; k < means.shape(0); ++k) {
    const double *centre = centres.data() + 3 * k, *mean = means.data() + 3 * k;
    known.push_back(all.near(centre, radius));
    starts.push_back({0.0, {centre[0], centre[1], centre[2]}, k});
    const auto found = lay_starts(seen, known.back(), centre, mean, prior.data(), within, limits, k);
    by_votes.insert(by_votes.end(), found.begin(), found.end());
  }
  std::stable_sort(by_votes.begin(), by_votes.end(),
                   [](const LayStart& a, const LayStart& b) { return a.score > b.score; });
  starts.insert(starts.end(), by_votes.begin(), by_votes.end());
  const Index most = means.shape(0) - 1 + 3 * limits.places;
  std::vector<LaidPose> found;
  for (const LayStart& start : starts) {
    if (static_cast<Index>(tried.size()) == most) break;
    const bool is_near = std::any_of(tried.begin(), tried.end(), [&](const LayStart& other) {
      return std::hypot(start.pose[0] - other.pose[0], start.pose[1] - other.pose[1]) < limits.apart &&
             std::abs(start.pose[2] - other.pose[2]) < 1.5 * limits.turn;
    });
    if (is_near) continue;
    tried.push_back(start);
    found.push_back(lay_refined(seen, known[start.hypothesis], views, start.pose,
                                means.data() + 3 * start.hypothesis, prior.data(), limits));
  }
  const Index m = static_cast<Index>(found.size());
  Array poses({m, Index{3}}), information({m, Index{3}, Index{3}}), squares(m), counts(m), away(m);
  for (Index k = 0; k < m; ++k) {
    std::copy_n(found[k].pose, 3, poses.mutable_data() + 3 * k);
    std::copy_n(found[k].information, 9, information.mutable_data() + 9 * k);
    squares.mutable_data()[k] = found[k].square;
    counts.mutable_data()[k] = found[k].count;
    away.mutable_data()[k] = found[k].away;
  }
  return py::make_tuple(poses, information, squares, counts, away);
}

}  // namespace

void add_constellations(py::module_& module) { module.def("laid", &laid); }

}  // namespace kernels
