// The check of the odometry against the detections of the newest cycles (`front_end/motion.py`).

#include <pybind11/stl.h>

#include <optional>

#include "odometry.hpp"
#include "scan_matching.hpp"

namespace kernels {
namespace {

using Pair = std::array<double, 2>;

constexpr double kMinSigma = 1e-6;  // m, rad: keeps the factor of an empty interval finite

// --- odometry ---------------------------------------------------------------------------------------------

constexpr double kHold = 0.15;          // time (s) for which a twist is held without additional noise,
constexpr double kHoldIntervals = 3.0;  // or multiple of the shortest interval of twists, if that is longer

// `factors.noise:TwistNoise`: standard deviations of a twist, and a random walk of the pose.
struct Noise {
  explicit Noise(const py::object& of)
      : white(pose_of(of.attr("white").cast<Array>())), drift(pose_of(of.attr("drift").cast<Array>())) {}

  // Standard deviation of the mean of `count` twists over a duration (s).
  double sigma(int c, double count, double duration) const {
    return std::sqrt(white[c] * white[c] / count + drift[c] * drift[c] / std::max(duration, 1e-6));
  }

  Pose white, drift;
};

enum class Source { kOdometry, kStanding, kDetections };

// A motion between two cycles: what `mapping.motion:MeasuredMotion` says of it.
struct Motion {
  bool is_fault() const { return doubted || missing; }

  Source source = Source::kOdometry;
  Integrated measured;
  Pose twist{};  // at the end
  bool doubted = false, missing = false, stuck = false;
  Doubles durations, excess;  // (k,) of twists (s), and (k, 3) additional standard deviations; of odometry
};

// --- sensor errors ----------------------------------------------------------------------------------------

constexpr double kMemory = 0.65;                 // age (s) of detections over which odometry hardly drifts
constexpr Pair kSigmasErrors = {0.02, 0.05};     // yaw (rad) and latency (s) of a hasty mounting
constexpr Pair kSigmasChanges = {0.001, 0.005};  // their change in a minute

// How far a match is off the odometry, in the vehicle's frame.
struct Difference {
  Pose off{};
  Matrix3 covariance{};            // of a sensor without errors
  std::array<double, 6> shifts{};  // (3, 2) derivatives by the sensor errors
  double variance_turn = 0.0;      // of the heading, with the sensor errors
  double square = 0.0;  // squared Mahalanobis distance; 0 for a match of too few to contradict anything
};

// Kalman filter of the sensor errors e = (yaw, latency).
//
// Detections are corrected by the mean. A remaining yaw shifts a match, in the vehicle's frame, by (d_y,
// -d_x, 0), and a latency by mean(v) - v. d is the displacement from the mean position of the poses of the
// remembered detections, v the velocity, and mean(v) its mean over these poses.
struct SensorErrors {
  // Changes of the velocity are clipped to what a vehicle can do; the rest is slip.
  void shifts(double ahead, double left, const Pose& twist, const Pose& accelerations, double* out) const {
    const double by_yaw[3] = {left, -ahead, 0.0};
    for (int i = 0; i < 3; ++i) {
      const double possible = 0.5 * kMemory * accelerations[i];
      out[2 * i] = by_yaw[i];
      out[2 * i + 1] = clipped(velocity[i] - twist[i], -possible, possible);
    }
  }

  void follow(const Pose& newest, double dt) {
    const double share = std::min(dt / (0.5 * kMemory), 1.0);
    for (int i = 0; i < 3; ++i) velocity[i] += share * (newest[i] - velocity[i]);
  }

  // A match counts by dt / kMemory, since those of a memory share what is remembered.
  void update(const Difference& match, double dt) {
    const double share = std::min(dt / kMemory, 1.0);
    double grown[4] = {covariance[0], covariance[1], covariance[2], covariance[3]}, information[4];
    for (int e = 0; e < 2; ++e) grown[3 * e] += dt * (kSigmasChanges[e] * kSigmasChanges[e] / 60.0);
    inverse2(grown, information);
    Pair gain{};
    for (int e = 0; e < 2; ++e) {
      const Pose column = {match.shifts[e], match.shifts[2 + e], match.shifts[4 + e]};
      const Pose weighted = solved(match.covariance, column);
      for (int i = 0; i < 3; ++i) {
        gain[e] += share * weighted[i] * match.off[i];
        for (int f = 0; f < 2; ++f) information[2 * e + f] += share * weighted[i] * match.shifts[2 * i + f];
      }
    }
    inverse2(information, covariance.data());
    for (int e = 0; e < 2; ++e) mean[e] += covariance[2 * e] * gain[0] + covariance[2 * e + 1] * gain[1];
  }

  Pair mean{};
  std::array<double, 4> covariance = {kSigmasErrors[0] * kSigmasErrors[0], 0.0, 0.0,
                                      kSigmasErrors[1] * kSigmasErrors[1]};
  Pose velocity{};
};

// --- standing still ---------------------------------------------------------------------------------------

constexpr double kStillTime = 1.0;  // s over which cones are compared, and over which twists show a rest
constexpr double kCreep = 3.0;  // largest speed of creep (m/s); a single cycle contradicts spinning wheels
constexpr double kShares[] = {0.0, 0.25, 0.5, 1.0};  // of the odometry's motion: standstill, slip, odometry
constexpr int kHypotheses = 4;
constexpr double kChance = 4.5;  // least gain (sigmas of its scatter): points of a line fit by chance below
constexpr Pose kRestTwist = {0.1, 0.1, 0.05};  // largest mean twist at rest, without its noise
constexpr double kRestSigmas = 3.0;            // allowance for the noise of the mean

using Gains = std::array<double, kHypotheses + 1>;

struct StillCycle {
  double t;
  Doubles points;            // (n, 2) corrected detections, vehicle frame
  double farthest;           // largest distance of these
  Pose by_odometry;          // pose by odometry alone
  std::vector<Gains> gains;  // with each of the previous cycles, summed up from the newest on
};

// The gain of a detection is max(0, most - d^2) with its distance d from the nearest one of the other cycle,
// whitened by twice the covariance plus sigma^2. Detections outside the other cycle's view, by odometry, have
// no gain: the view moves with the vehicle, and its border matches only at standstill. The last entry sums
// (first - last hypothesis)^2 over detections.
Gains gains_of(const StillCycle& newest, const Doubles& precisions, const StillCycle& other, double most) {
  Gains out{};
  const Pose way = relative(newest.by_odometry, other.by_odometry);
  const Turn turned(way[2]);
  const double view = other.farthest - std::hypot(way[0], way[1]);
  for (size_t i = 0; i < newest.points.size(); i += 2) {
    const double *p = &newest.points[i], *P = &precisions[2 * i];
    if (!(std::hypot(p[0], p[1]) <= view)) continue;
    double gains[kHypotheses];
    for (int h = 0; h < kHypotheses; ++h) {
      double least = most;
      for (size_t j = 0; j < other.points.size(); j += 2) {
        const double* q = &other.points[j];
        const double ex = p[0] - q[0] - kShares[h] * (turned.c * q[0] - turned.s * q[1] + way[0] - q[0]);
        const double ey = p[1] - q[1] - kShares[h] * (turned.s * q[0] + turned.c * q[1] + way[1] - q[1]);
        least = std::min(least, P[0] * ex * ex + 2.0 * P[1] * ex * ey + P[3] * ey * ey);
      }
      out[h] += gains[h] = most - least;
    }
    const double more = gains[0] - gains[kHypotheses - 1];
    out[kHypotheses] += more * more;
  }
  return out;
}

// The hypothesis that the vehicle stands, by the twists or by the cones of the last second.
class Standstill {
 public:
  void forget() { cycles_.clear(), poses_.clear(); }

  // Whether the twists, with some noise, have shown a rest for kStillTime at t (s).
  //
  // Their mean is consistent with a rest in each cycle, which shows at once that the vehicle pulls off, and
  // since the last measurement of the bias, which shows a creep.
  bool by_twists(const double* stamps, const double* twists, Index count, double t, const Noise& noise) {
    const Index first = count > 1 ? 1 : 0;  // the first one is held
    Pose total{};
    for (Index i = first; i < count; ++i)
      for (int c = 0; c < 3; ++c) total[c] += twists[3 * i + c];
    const double own = count - first;
    bool rests = own > 0;
    for (int c = 0; c < 3; ++c)
      rests &= std::abs(total[c] / own) <= kRestTwist[c] + kRestSigmas * noise.white[c] / std::sqrt(own);
    if (!rests) {
      since_.reset();
      return false;
    }
    if (!since_) since_ = stamps[0], restart(stamps[0]);
    count_ += own;
    for (int c = 0; c < 3; ++c) {
      sum_[c] += total[c];
      const double allowed = kRestTwist[c] + kRestSigmas * noise.sigma(c, count_, t - begin_);
      rests &= std::abs(sum_[c] / count_) < allowed;
    }
    return rests && t - *since_ >= kStillTime;
  }

  // Bias of the yaw rate and its sigma since the last result, if that is kStillTime ago at t (s).
  std::optional<Pair> bias(double t, const Noise& noise) {
    if (t - begin_ < kStillTime) return {};
    const Pair measured = {sum_[2] / count_, noise.sigma(2, count_, t - begin_)};
    restart(t);
    return measured;
  }

  // Add corrected detections after the motion by odometry; `pose` is the accepted one of the cycle before.
  void add(double t, const Doubles& points, const double* covariances, double excess, const Pose& delta,
           const Pose& pose, const Matching& by) {
    const Index m = points.size() / 2;
    const auto newest = std::make_shared<StillCycle>();
    newest->t = t, newest->points = points, newest->farthest = 0.0, newest->by_odometry = {};
    std::vector<std::shared_ptr<const StillCycle>> cycles = {newest};
    if (!cycles_.empty()) {
      newest->by_odometry = compose(cycles_[0]->by_odometry, delta);
      if (std::hypot(delta[0], delta[1]) <= kCreep * (t - cycles_[0]->t))
        for (const auto& one : cycles_)
          if (one->t >= t - kStillTime) cycles.push_back(one);
    }
    Doubles precisions(4 * m);
    for (Index i = 0; i < m; ++i) {
      newest->farthest = std::max(newest->farthest, std::hypot(points[2 * i], points[2 * i + 1]));
      double K[4];
      for (int e = 0; e < 4; ++e)
        K[e] = 2.0 * (excess * covariances[4 * i + e]) + (e % 3 ? 0.0 : by.sigma_cone * by.sigma_cone);
      inverse2(K, &precisions[4 * i]);
    }
    Gains sums{};
    for (size_t k = 1; k < cycles.size(); ++k) {
      const Gains own = gains_of(*newest, precisions, *cycles[k], by.most_misfit);
      for (size_t h = 0; h < own.size(); ++h) sums[h] += own[h];
      newest->gains.push_back(sums);
    }
    cycles_ = cycles;
    poses_.insert(poses_.begin(), pose);
    poses_.resize(cycles_.size() - 1);
  }

  // The pose at which the vehicle stands, if it does.
  //
  // Twice the log-likelihood of n cycles is 2 / n times the sum of the gains of their pairs. The vehicle
  // stands if, for some number of newest cycles, twice the log-likelihood ratio of standstill to odometry
  // exceeds limit^2, standstill is likelier than slip, and the gain exceeds its scatter. All of these cycles
  // then get the pose of the first one.
  std::optional<Pose> by_cones(double limit) {
    double best = 0.0;
    size_t first = 0;
    for (size_t n = 0; n < poses_.size(); ++n) {
      Gains sums{};
      for (size_t k = 0; k <= n; ++k)
        for (size_t h = 0; h < sums.size(); ++h) sums[h] += cycles_[k]->gains[n - k][h];
      const double more = sums[0] - sums[kHypotheses - 1];
      const bool possible = sums[0] >= *std::max_element(&sums[1], &sums[kHypotheses - 1]) &&
                            more > kChance * std::sqrt(sums[kHypotheses]);
      const double likelier = more * 2.0 / (2.0 + n);
      if (possible && likelier > best) best = likelier, first = n;
    }
    if (!(best > limit * limit)) return {};
    std::fill_n(poses_.begin(), first, poses_[first]);
    return poses_[first];
  }

 private:
  void restart(double t) { begin_ = t, sum_ = {}, count_ = 0.0; }

  std::vector<std::shared_ptr<const StillCycle>> cycles_;  // newest first
  std::vector<Pose> poses_;                                // accepted ones of all but the newest of these
  std::optional<double> since_;  // stamp from which the twists show a rest, if they do
  double begin_ = 0.0, count_ = 0.0;
  Pose sum_{};
};

// --- check of the odometry --------------------------------------------------------------------------------

constexpr double kReachFirst = 1.0;      // reach (m) of the first iteration of a match,
constexpr double kReachLast = 0.4;       // and of the last one
constexpr double kGateDistrusted = 3.8;  // gate (sigmas) for kDistrust seconds after a contradiction
constexpr double kDistrust = 12.0;       // s: wheels that slip do so again in the next bends
constexpr double kDoubtRate = 2.0;       // gate (sigmas) of the yaw rate of a contradicted odometry
constexpr double kMaxChange = 3.5;       // largest change of the motion between cycles, in kSigmasChange
constexpr Pose kSigmasChange = {3.0, 1.0, 0.5};  // change of the velocity in a cycle (m/s, m/s, rad/s)
constexpr double kBefore = 0.5;   // share of a contradiction added to its sigma: it may have begun earlier
constexpr double kWidened = 1.5;  // inflation of a match's sigmas: the estimator uses its detections again
constexpr Pose kSigmasStanding = {5e-4, 5e-4, 5e-5};  // of the motion at rest (m, m, rad)
constexpr size_t kMostRemembered = 2000;  // largest number of remembered detections, and of points of lines
constexpr Index kMostOfLines = 40;        // in a cycle: they bound the time of a match

// A motion with a mean twist that replaces one by odometry, whose faults it has.
Motion without_odometry(const Motion& motion, const Pose& delta, const Matrix3& covariance,
                        const Pose& twist) {
  const Integrated measured = {delta, covariance, {}};
  return {Source::kDetections, measured, twist, !motion.missing, motion.missing, motion.stuck, {}, {}};
}

void add_outer(Matrix3& covariance, const Pose& off) {
  for (int i = 0; i < 9; ++i) covariance[i] += off[i / 3] * off[i % 3];
}

struct Remembered {
  double t;
  Pair from, place, by_errors[2];  // places of vehicle and detection, and derivatives of the latter
};

class MotionCheck {
 public:
  MotionCheck(const py::object& noise, const py::object& settings, const py::object& matching)
      : matching_(matching),
        noise_(noise),
        doubt_(settings.attr("doubt").cast<double>()),
        accelerations_(pose_of(settings.attr("accelerations").cast<Array>())) {}

  void set_noise(const py::object& noise) {
    noise_ = Noise(noise);
    errors_ = {};
    remembered_.clear(), earlier_.clear();
    standstill_.forget();
  }

  py::tuple update(const Array& stamps, const Array& twists, double now, const Array& points,
                   const Array& covariances, bool may_contradict) {
    const Index count = stamps.size(), m = points.shape(0);
    expect(twists.size() == 3 * count && points.size() == 2 * m && covariances.size() == 4 * m);
    const Motion motion = by_odometry(stamps.data(), twists.data(), count, now);
    const Seen seen = corrected(points, covariances, now, motion.twist);
    std::optional<Pose> place;
    if (!matching_.of_lines) {  // points of lines cannot show a standstill
      standstill_.add(now, seen.points, covariances.data(), excess(), motion.measured.end, pose, matching_);
      if (may_contradict) place = standstill_.by_cones(doubt_);
    }
    Motion found;
    if (place) {
      const Pose back = relative(pose, *place);
      Matrix3 covariance = squares_of(kSigmasStanding);
      add_outer(covariance, {kBefore * back[0], kBefore * back[1], kBefore * back[2]});
      found = without_odometry(motion, back, covariance, {});
    } else {
      const bool rests =
          !motion.missing && standstill_.by_twists(stamps.data(), twists.data(), count, now, noise_);
      found = likeliest(motion, now, seen, rests, may_contradict);
    }
    if (found.doubted) doubted_at_ = now;
    std::optional<Pair> bias;
    bool leaves = false;
    if (!found.is_fault()) {
      const bool stands = found.source == Source::kStanding;
      leaves = rests_ && !stands, rests_ = stands;
      if (stands) bias = standstill_.bias(now, noise_);
    }
    pose = compose(pose, found.measured.end);
    seen_again = py::array_t<bool>(m);
    const Turn turn(pose[2]);
    for (Index i = 0; i < m; ++i) {
      double point[2];
      point_in_map(pose, turn, &seen.points[2 * i], point);
      seen_again.mutable_data()[i] =
          matching_.of_lines
              ? Nearby(point, earlier_, kReachFirst, 1.0).weight > 0.0  // any point in reach
              : Nearby(point, earlier_, kReachLast, matching_.farthest).weight > matching_.min_weight;
    }
    remember(points, now, found.is_fault() ? found.twist : motion.twist);
    if (t_ && now > *t_) {
      const double dt = now - *t_;
      const Pose& delta = found.measured.end;
      velocity_ = {delta[0] / dt, delta[1] / dt, delta[2] / dt};
      errors_.follow(*velocity_, dt);
    }
    t_ = now;

    const Index held = found.durations.size();
    const Integrated& own = found.measured;
    const py::tuple odometry = py::make_tuple(
        array_of({3}, own.end), array_of({3, 3}, own.covariance), array_of({3, 2}, own.by_calibration),
        array_of({3, 3}, whitener_of(own.covariance.data(), kMinSigma)), array_of({3}, found.twist));
    const Array of_motion = found.source == Source::kOdometry ? twists : array_of({1, 3}, found.twist);
    const py::object durations = held ? py::object(Array(held, found.durations.data())) : py::none();
    const Array excess(Shape{held, 3}, found.excess.data());
    return py::make_tuple(odometry, of_motion, found.doubted, found.missing, found.stuck, bias, durations,
                          excess, leaves);
  }

  Pose pose{};                             // newest one by dead reckoning; the first one is 0
  py::array_t<bool> seen_again{Index(0)};  // whether each detection of the newest cycle was seen before
  const SensorErrors& errors() const { return errors_; }

 private:
  double excess() const { return std::max(misfit_ / matching_.large_misfit, 1.0); }

  Motion by_odometry(const double* stamps, const double* twists, Index count, double now) {
    Motion motion;
    motion.missing = count == 0 && t_;
    if (count == 0) return motion;  // no motion, with certainty
    double first = stamps[0];
    if (t_ && first <= *t_ && twist_ && std::equal(twist_->begin(), twist_->end(), twists))
      first = twist_t_;  // the first row repeats it
    for (Index i = 1; i < count; ++i)
      twist_interval_ = std::min(twist_interval_, stamps[i] - (i > 1 ? stamps[i - 1] : first));
    const double room = std::max(kHold, kHoldIntervals * twist_interval_);
    const bool drifts = noise_.drift != Pose{};
    Doubles sigmas(3 * count);
    Index same = 0;
    for (Index i = 0; i < count; ++i) {
      const double end = i + 1 < count ? stamps[i + 1] : now, dt = end - stamps[i];
      const double longer = std::max(end - (i ? stamps[i] : first) - room, 0.0);
      motion.durations.push_back(dt);
      for (int c = 0; c < 3; ++c) {
        motion.excess.push_back(longer * accelerations_[c]);
        sigmas[3 * i + c] =
            std::hypot(drifts ? noise_.sigma(c, 1.0, dt) : noise_.white[c], motion.excess.back());
      }
      motion.missing = longer > 0.0;
      same += i && std::equal(twists + 3 * i, twists + 3 * i + 3, twists + 3 * i - 3);
    }
    motion.stuck = same >= 3;
    motion.measured = integrate(count, motion.durations.data(), twists, sigmas.data());
    std::copy_n(twists + 3 * (count - 1), 3, motion.twist.begin());
    twist_ = motion.twist, twist_t_ = count > 1 ? stamps[count - 1] : first;
    return motion;
  }

  // Correct a cycle's detections, and the remembered ones, for the sensor errors; forget old ones.
  Seen corrected(const Array& points, const Array& covariances, double now, const Pose& by) {
    const auto is_old = [&](const Remembered& one) { return !(one.t > now - kMemory); };
    remembered_.erase(remembered_.begin(), std::find_if_not(remembered_.begin(), remembered_.end(), is_old));
    earlier_.clear();
    const Pair& e = errors_.mean;
    for (const Remembered& one : remembered_)
      for (int c = 0; c < 2; ++c)
        earlier_.push_back(one.place[c] + (one.by_errors[c][0] * e[0] + one.by_errors[c][1] * e[1]));
    Seen seen;
    double C[2][kSensor];
    for (Index i = 0; i < points.shape(0); ++i) {
      const double *z = points.data() + 2 * i, *K = covariances.data() + 4 * i;
      sensor_columns(z, by.data(), C);
      for (int c = 0; c < 2; ++c) seen.points.push_back(z[c] + (C[c][kYaw] * e[0] + C[c][kLatency] * e[1]));
      seen.variances.push_back(0.5 * (K[0] + K[3]));
    }
    return seen;
  }

  void remember(const Array& points, double now, const Pose& by) {
    const Index m = points.shape(0), every = matching_.of_lines ? (m + kMostOfLines - 1) / kMostOfLines : 1;
    const Turn turn(pose[2]);
    double C[2][kSensor];
    for (Index i = 0; i < m; i += every) {
      const double* z = points.data() + 2 * i;
      sensor_columns(z, by.data(), C);
      Remembered one{now, {pose[0], pose[1]}, {}, {}};
      one.place = {turn.c * z[0] - turn.s * z[1] + pose[0], turn.s * z[0] + turn.c * z[1] + pose[1]};
      int e = 0;
      for (const Index k : {kYaw, kLatency}) {
        one.by_errors[0][e] = turn.c * C[0][k] - turn.s * C[1][k];
        one.by_errors[1][e++] = turn.s * C[0][k] + turn.c * C[1][k];
      }
      remembered_.push_back(one);
    }
    if (remembered_.size() > kMostRemembered)
      remembered_.erase(remembered_.begin(), remembered_.end() - kMostRemembered);
  }

  Difference difference(const Match& match, const Motion& motion, const Pose& predicted) const {
    Difference out;
    Pair from{};
    for (const Remembered& one : remembered_)
      for (int c = 0; c < 2; ++c) from[c] += one.from[c];
    const double n = remembered_.size();
    const Pose way = relative({from[0] / n, from[1] / n, predicted[2]}, predicted);
    errors_.shifts(way[0], way[1], motion.twist, accelerations_, out.shifts.data());
    out.off = relative(predicted, match.pose);
    out.covariance = turned(inverse3(match.information), -predicted[2]);
    const std::array<double, 6>& S = out.shifts;
    Matrix3 spread;
    for (int i = 0; i < 9; ++i) {
      spread[i] = out.covariance[i] = excess() * out.covariance[i] + motion.measured.covariance[i];
      for (int a = 0; a < 2; ++a)
        for (int b = 0; b < 2; ++b)
          spread[i] += S[2 * (i / 3) + a] * errors_.covariance[2 * a + b] * S[2 * (i % 3) + b];
    }
    out.variance_turn = spread[8];
    const Pose weighted = solved(spread, out.off);
    if (match.count >= matching_.min_doubting)
      for (int i = 0; i < 3; ++i) out.square += out.off[i] * weighted[i];
    return out;
  }

  // Whether a match is in reach after dt (s), with constant velocity to the pose `going_on`.
  bool is_possible(const Match& match, const Pose& going_on, double dt) const {
    const Matrix3 covariance = turned(inverse3(match.information), -match.pose[2]);
    const Pose change = relative(going_on, match.pose);
    bool possible = true;
    for (int i = 0; i < 3; ++i)
      possible &= std::abs(change[i]) < kMaxChange * (kSigmasChange[i] * dt + std::sqrt(covariance[4 * i]));
    return possible;
  }

  // The motion that the detections agree with.
  //
  // The hypotheses are, in this order, standing still if the vehicle `rests` by the twists, and the odometry,
  // each if a match beside it agrees; then the best match that is possible after the newest velocity and fits
  // clearly better than the odometry, and the odometry again. The odometry has failed where it is missing, or
  // stuck at a velocity to which no vehicle jumps; then the last hypothesis is constant velocity.
  Motion likeliest(const Motion& motion, double now, const Seen& seen, bool rests, bool may_contradict) {
    if (!t_ || now <= *t_) return motion;
    const double dt = now - *t_, limit = now - doubted_at_ < kDistrust ? kGateDistrusted : doubt_;
    const double largest = 3.0 * excess();  // misfits are 1 where the vehicle moved, 4 where it was put down
    const Pose& delta = motion.measured.end;
    Pose going_on, sigmas;
    bool jumped = false;
    for (int i = 0; i < 3; ++i) {
      going_on[i] = dt * (velocity_ ? *velocity_ : motion.twist)[i];
      sigmas[i] = kSigmasChange[i] * dt;
      jumped |= std::abs(delta[i] - going_on[i]) > sigmas[i];
    }
    Motion standing;
    standing.source = Source::kStanding, standing.measured.covariance = squares_of(kSigmasStanding);
    bool failed = false;
    for (const bool still : {true, false}) {
      if (still && !rests) continue;
      const Motion& one = still ? standing : motion;
      const Pose predicted = compose(pose, one.measured.end);
      const Match near = match(earlier_, seen, predicted, {kReachFirst, kReachLast}, matching_);
      const bool fits = near.is_certain && near.misfit < largest;
      const bool stuck = motion.stuck && jumped && !(fits && near.count >= matching_.min_doubting);
      failed = motion.missing || (stuck && doubt_ < kInfinity);
      if (!fits || failed) continue;
      const Difference off = difference(near, one, predicted);
      if (!(off.square <= limit * limit)) continue;
      misfit_ += matching_.misfit_gain * (near.misfit - misfit_);
      errors_.update(off, dt);
      return one;
    }
    if (!may_contradict && !failed) return motion;

    static const Doubles kReaches = [] {
      Doubles reaches;
      for (int k = 0; k < 6; ++k)
        reaches.push_back(kReachFirst * std::pow(std::pow(kReachLast / kReachFirst, 0.2), k));
      return reaches;
    }();
    const Pose predicted = compose(pose, delta), start = compose(pose, going_on);
    std::optional<Match> best;
    for (const Pose& from : {start, predicted}) {
      const Match found = match(earlier_, seen, from, kReaches, matching_);
      if (!found.is_certain || !(found.misfit < largest) || !is_possible(found, start, dt)) continue;
      if (!best || found.count - found.misfit > best->count - best->misfit) best = found;
    }
    if (!best && !failed) return motion;
    Pose moved = going_on;
    Matrix3 covariance = squares_of(sigmas);
    if (best) {
      const Difference off = difference(*best, motion, predicted);
      if (!failed) {
        Seen matched;
        for (size_t i = 0; i < seen.variances.size(); ++i)
          if (best->is_matched[i]) {
            matched.points.insert(matched.points.end(), {seen.points[2 * i], seen.points[2 * i + 1]});
            matched.variances.push_back(seen.variances[i]);
          }
        const double at_odometry = misfit(earlier_, matched, predicted, kReachLast, matching_);
        const double at_match = misfit(earlier_, matched, best->pose, kReachLast, matching_);
        const bool fits_better = at_odometry > std::max(2.0, 1.3 * at_match);
        if (off.square <= limit * limit || !fits_better) return motion;
      }
      if (std::abs(off.off[2]) <= kDoubtRate * std::sqrt(off.variance_turn) &&
          !(motion.missing || motion.stuck)) {  // the gyro is right
        moved[2] = delta[2], covariance[8] = motion.measured.covariance[8];
      }
      Matrix3 both = turned(best->information, -best->pose[2]);
      const Pose way = relative(pose, best->pose);
      Pose weighted{};
      for (int i = 0; i < 9; ++i) {
        both[i] /= kWidened * kWidened * excess();
        weighted[i / 3] += both[i] * way[i % 3];
      }
      for (int i = 0; i < 3; ++i) {
        weighted[i] += moved[i] / covariance[4 * i];
        both[4 * i] += 1.0 / covariance[4 * i];
      }
      covariance = inverse3(both);
      moved = solved(both, weighted);
      Pose off_odometry;
      for (int i = 0; i < 3; ++i) off_odometry[i] = (motion.missing ? 0.0 : kBefore) * (moved[i] - delta[i]);
      add_outer(covariance, off_odometry);
    }
    return without_odometry(motion, moved, covariance, {moved[0] / dt, moved[1] / dt, moved[2] / dt});
  }

  std::optional<double> t_;  // stamp of the newest cycle
  Matching matching_;
  Noise noise_;
  double doubt_;
  Pose accelerations_;
  double misfit_ = 1.0;  // mean of those of the matches that agreed, the newest counting most
  SensorErrors errors_;
  Standstill standstill_;
  std::vector<Remembered> remembered_;
  Doubles earlier_;  // (n, 2) places of the remembered detections, corrected
  bool rests_ = false;
  std::optional<Pose> velocity_;
  double doubted_at_ = -kInfinity;     // stamp of the last contradiction
  std::optional<Pose> twist_;          // newest measured one
  double twist_t_ = -kInfinity;        // stamp of the newest measured twist
  double twist_interval_ = kInfinity;  // shortest time between measured twists
};

}  // namespace

void add_motion_check(py::module_& module) {
  using Check = const MotionCheck&;
  py::class_<MotionCheck>(module, "MotionCheck")
      .def(py::init<const py::object&, const py::object&, const py::object&>())
      .def("copy", [](Check check) { return MotionCheck(check); })
      .def("set_noise", &MotionCheck::set_noise)
      .def("update", &MotionCheck::update)
      .def_readonly("seen_again", &MotionCheck::seen_again)
      .def_property_readonly("pose", [](Check check) { return array_of({3}, check.pose); })
      .def_property_readonly("errors", [](Check check) {
        return py::make_tuple(array_of({2}, check.errors().mean),
                              array_of({2, 2}, check.errors().covariance));
      });
}

}  // namespace kernels
