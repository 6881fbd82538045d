// Detections in the frames of the vehicle and of the map (`factors/sensor.py`).

#pragma once

#include "common.hpp"

namespace kernels {

constexpr Index kSensor = 5;             // entries of the sensor's calibration,
constexpr Index kYaw = 0, kLatency = 2;  // two of which are these

// Derivatives C (2, 5) of a detection z (2,), vehicle frame, by the sensor's calibration, at a twist (3,).
void sensor_columns(const double* z, const double* twist, double (*C)[kSensor]);

// A point (2,) of the vehicle's frame in that of the map, by a pose and its turn.
inline void point_in_map(const Pose& pose, const Turn& turn, const double* point, double* out) {
  out[0] = turn.c * point[0] - turn.s * point[1] + pose[0];
  out[1] = turn.s * point[0] + turn.c * point[1] + pose[1];
}

// Points (m, 2) corrected by the sensor's calibration (5,), vehicle frame.
Array shifted(const Array& points, const Array& twists, const Array& sensor);

// Points (m, 2) of the vehicle's frame in that of the map, by poses (m, 3); either may be one for all.
Array to_map(const Array& points, const Array& poses);

}  // namespace kernels
