"""Twists of the vehicle: from poses, with an IMU's yaw rate, without rows that can't be, and interpolated."""

from itertools import pairwise
from typing import Final

import gtsam
import numpy as np
from scipy.interpolate import CubicSpline

from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.se2 import relative
from pathspace_graph.io.log import Odometry
from pathspace_graph.settings.online import LimitSettings

LIMITS: Final = LimitSettings()  # beyond which no estimator uses a twist
ACCELERATIONS: Final = np.array([20.0, 20.0, 15.0])  # that no vehicle exceeds (m/s^2, m/s^2, rad/s^2)
AROUND: Final = 5  # number of rows before a row, and after it, whose medians it is compared with
MAD: Final = 1.4826  # standard deviation of a Gaussian over its median absolute deviation
WRAP_SHARE: Final = 0.7  # share of half a turn in a row that marks a yaw that was differenced where it wraps
MOST_WRONG: Final = 0.05  # largest share of rows that are mistakes of single rows
FEW: Final = 6  # number of rows that jump that are mistakes in any record
FROZEN: Final = 1.2  # longest time (s) for which a repeated pose is one that was not measured anew
PERIOD: Final = 0.05  # longest part (s) of an interval that is interpolated
GAP: Final = 2.5  # a longer interval, in median ones, is a gap, over which nothing is interpolated


def twists_between(t: Array, poses: Array) -> Array:
    """Constant twists (n - 1, 3) that lead from each pose (n, 3) at t (n,) in s to the next."""
    moves = [relative(one, other) for one, other in pairwise(poses)]
    logarithms = np.array([gtsam.Pose2.Logmap(gtsam.Pose2(*move)) for move in moves]).reshape(-1, 3)
    return logarithms / np.diff(t)[:, None]


def measured_anew(t: Array, poses: Array) -> BoolArray:
    """Which poses (n, 3) at t (n,) in s differ from the one before, or stay for longer than `FROZEN`.

    A slow receiver's pose is often repeated at the rate of a faster sensor: differences would be 0, 0, 5 v.
    """
    new = np.append(True, (np.diff(poses, axis=0) != 0.0).any(axis=1))
    since = t - t[np.maximum.accumulate(np.where(new, np.arange(len(t)), 0))]
    return np.asarray(new | (since > FROZEN))


def with_yaw_rate(t: Array, twists: Array, imu_t: Array, rates: Array) -> tuple[Array, Array]:
    """Replace the yaw rate of twists at t (n,) in s, in order, by the mean of an IMU until the next twist."""
    turn = np.argsort(imu_t, kind="stable")
    turn = turn[np.isfinite(rates[turn])]
    imu_t, rates = imu_t[turn], rates[turn]
    inside = (t >= imu_t[0]) & (t <= imu_t[-1]) if len(imu_t) else np.zeros(len(t), bool)
    t, twists = t[inside], twists[inside]
    if len(t) < 2:
        return t, twists
    heading = np.append(0.0, np.cumsum(rates[:-1] * np.diff(imu_t)))
    steps, turned = np.diff(t), np.diff(np.interp(t, imu_t, heading))
    last = rates[np.searchsorted(imu_t, t[-1], side="right") - 1]
    mean = np.interp(t[:-1], imu_t, rates)  # where no time passes
    np.divide(turned, steps, out=mean, where=steps > 0)
    twists[:, 2] = np.append(mean, last)
    return t, twists


def beyond_limits(twists: Array) -> BoolArray:
    """Which entries of twists (n, 3) are beyond what an estimator uses."""
    return np.asarray(np.abs(twists) > [LIMITS.speed, LIMITS.speed, LIMITS.yaw_rate])


def jumps(t: Array, twists: Array) -> Array:
    """How far single rows of twists (n, 3) at t (n,) in s jump, and 0 for the others (n, 3).

    A row x jumps if it lies outside the medians a and b of the rows before and after it by more than a
    vehicle accelerates meanwhile, and more than the rows' noise:

        max(x - max(a, b), min(a, b) - x) > AROUND A dt / 2 + 6 sigma

    Up to two rows in turn can jump. A yaw rate may leave the medians by less than a share of pi / dt: one
    that was differenced where the yaw wraps leaves them by 2 pi / dt, or in two rows by pi / dt.
    """
    if len(t) <= 2 * AROUND:
        return np.zeros(twists.shape)
    steps = np.diff(t)
    dt = float(np.median(steps))
    apart = np.maximum(np.maximum(np.append(dt, steps), np.append(steps, dt)), dt)  # more beside a gap
    rows = np.pad(twists, ((AROUND, AROUND), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(rows, AROUND, axis=0)
    before, after = np.median(windows[: len(t)], axis=-1), np.median(windows[AROUND + 1 :], axis=-1)
    low, high = np.minimum(before, after), np.maximum(before, after)
    off = twists - np.clip(twists, low, high)
    middle = 0.5 * (twists[:-2] + twists[2:])
    sigma = MAD * np.median(np.abs(twists[1:-1] - middle), axis=0) / np.sqrt(1.5)
    most = 0.5 * AROUND * ACCELERATIONS * apart[:, None] + 6.0 * sigma
    most[:, 2] = np.where(apart < 1.5 * dt, np.minimum(most[:, 2], WRAP_SHARE * np.pi / dt), most[:, 2])
    return np.where(np.abs(off) > most, off, 0.0)


def parts_of(t: Array) -> int:
    """Number of parts of an interval of sampled twists at t (n,) in s, each `PERIOD` long at most.

    It is 1 for periods up to 0.12 s, which can be held, and for too few samples to know their period.
    """
    steps = np.diff(np.unique(t[np.isfinite(t)]))
    period = float(np.median(steps)) if len(steps) >= 20 else 0.0
    return int(np.ceil(period / PERIOD - 1e-6)) if period > 0.12 else 1


def interpolated(t: Array, twists: Array, parts: int) -> Odometry:
    """Interpolate sampled twists (n, 3) at t (n,) in s: the mean of each of the parts of an interval.

    A log holds each twist until the next one, so that a slow one would lag by half its period. Cubic splines
    go through the samples between gaps, where the last twist is held.
    """
    if parts == 1 or len(t) < 2:
        return Odometry(t, twists)
    steps = np.diff(t)
    ends = np.flatnonzero(steps > GAP * np.median(steps)) + 1
    stamps, values = [], []
    for run in np.split(np.arange(len(t)), ends):
        at, own = t[run], twists[run]
        if len(run) > 1:
            begins = (at[:-1, None] + np.diff(at)[:, None] * (np.arange(parts) / parts)).ravel()
            whole = CubicSpline(at, own).antiderivative()(np.append(begins, at[-1]))
            stamps.append(begins)
            values.append(np.diff(whole, axis=0) / np.diff(np.append(begins, at[-1]))[:, None])
        stamps.append(at[-1:])
        values.append(own[-1:])
    return Odometry(np.concatenate(stamps), np.concatenate(values))
