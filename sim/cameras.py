"""Cameras and odometry of real cars: one that recordings show, and a car that is drawn."""

from dataclasses import dataclass
from math import radians
from typing import Final

import numpy as np
from numpy.random import Generator

from .faults import OdometryFaults, SensorFaults
from .sensor import OdometryNoise, SensorSettings
from .vehicle import VehicleSettings

CAMERA: Final = SensorSettings(
    rate=5.0,
    range_max=40.0,
    fov=radians(130.0),
    range_sigma=0.03,
    range_sigma_growth=0.05,
    bearing_sigma=0.0125,
    detection_probability=1.0,
    detection_falloff=0.022,
    blind_fraction=0.0,
    wrong_colour=0.001,
    false_positives=0.05,
    slow_range=0.08,
    slow_bearing=0.8,
    slow_time=8.0,
    duplicates=0.9,
    overlap=(radians(5.0), radians(17.0)),
    dropped_cycles=0.005,
    sigma_range_scale=0.0,
)
"""Three cameras of a Formula Student car, as its recordings of three laps show them.

Their fields span bearings of +-65 degrees. A smoothed map gave the errors of some 900 passes of cones. Those
along the ray grow to 0.5 m at 10 m and 1.2 m at 22 m, with hardly any correlation from cycle to cycle. Those
across are 0.007 rad about their mean over a pass, but 0.011 to 0.015 rad between two cameras that see the
same cone: most of the error stays with the cone. The correlation time gave these figures and those of lag 1
to 5 again in a simulated log. Of the cones in the overlaps, at bearings of 5 to 17 degrees on both sides, 75
to 100 % are seen twice. 0.5 % of the cycles are missing. A cone is detected with a probability of 0.97 below
6 m, 0.8 at 14 m, 0.5 at 22 m and 0.15 at 37 m. Of the detections within 12 m, 0.1 % have the other
boundary's colour and about 0.04 a cycle are of no cone.
"""
CAMERA_FAULTS: Final = SensorFaults(
    latency=-0.12, yaw=-0.0175, range_scale=0.08, range_bias=-0.19, colourless=0.01
)
"""Constant errors of these cameras against the odometry, which differ a little from lap to lap.

Fits on each lap gave stamps 0.108 to 0.131 s early, a yaw of 0.6 to 1.4 degrees to the right, and ranges
0.19 m too short and 7 to 9 % too long.
"""
INS: Final = OdometryNoise(
    white=(0.009, 0.003, 0.003), gyro_bias=0.0002, slow=(0.03, 0.03, 0.0005), slow_time=5.0
)
"""Inertial navigation of the same car.

Third differences of the readings gave the white noise. The slow errors and the bias are such that a lap of
240 m in 90 s ends 1 m and 0.02 rad off by dead reckoning: the three laps ended 0.8, 0.8 and 1.9 m, and 0.01
to 0.03 rad off. The correlation time is assumed.
"""
INS_RATE: Final = 40.0  # rate of the INS (Hz)

SOME: Final = 0.5  # share of the drawn cars that have a fault that not every car has


@dataclass(frozen=True)
class DrawnCar:
    """A vehicle with its sensors and their errors."""

    sensor: SensorSettings
    sensor_faults: SensorFaults
    odometry: OdometryNoise
    odometry_faults: OdometryFaults
    vehicle: VehicleSettings


def draw_car(rng: Generator) -> DrawnCar:
    """Draw everything about a car, so that nothing can be tuned to one.

    The distributions are wider than what the few known cars show.
    """
    # how it drives; it stands still before and after
    vehicle = VehicleSettings(
        # a driverless car's first laps have 4 m/s, its best ones 12
        speed_max=rng.uniform(4.0, 12.0),
        # the log begins before the car does, and ends after it
        rest=rng.uniform(0.0, 3.0),
        stand=rng.uniform(5.0, 8.0),
        # of the odometry: wheel speeds on a bus at 25 Hz, inertial units at 100
        rate=rng.uniform(25.0, 100.0),
    )
    # its detector of cones
    begin = radians(rng.uniform(0.0, 10.0))
    sensor = SensorSettings(
        # front ends run at 10 to 15 Hz; three cameras that share a processor at 5
        rate=rng.uniform(5.0, 15.0),
        # one camera sees 10 to 20 m over 90 to 120 degrees, three cameras 40 m over 130
        range_max=rng.uniform(12.0, 40.0),
        fov=radians(rng.uniform(90.0, 140.0)),
        # the scatter grows to 0.1 m beyond 8 m where depth is measured, to 0.5 m where it is learned
        range_sigma=rng.uniform(0.01, 0.05),
        range_sigma_growth=log_uniform(rng, 0.01, 0.05),
        # from a few pixels of a narrow image to boxes that jump by a tenth of their width
        bearing_sigma=log_uniform(rng, 0.004, 0.016),
        # 1 % less by each metre is typical; the recorded car loses 2.2
        detection_probability=rng.uniform(0.92, 1.0),
        detection_falloff=rng.uniform(0.008, 0.022),
        # cones that lie, or that are covered
        blind_fraction=rng.uniform(0.0, 0.03),
        # 0.1 % in sunshine as recorded, 3 % of colours that glare or are trained badly
        wrong_colour=log_uniform(rng, 0.001, 0.03),
        false_positives=log_uniform(rng, 0.02, 0.3),
        # a network errs alike on like images: most of a bearing's error stays while a cone is passed
        slow_range=rng.uniform(0.05, 0.5),
        slow_bearing=rng.uniform(0.3, 0.8),
        slow_time=log_uniform(rng, 0.5, 8.0),
        # two cameras with an overlap, or one
        duplicates=rng.uniform(0.2, 0.9) * (rng.random() < SOME),
        overlap=(begin, begin + radians(rng.uniform(5.0, 15.0))),
        # cycles that were not ready in time
        dropped_cycles=rng.uniform(0.0, 0.02),
        # detectors have a bias of 0.34 m beyond 8 m in the median, of one sign on one car: a focal length or
        # a size of cones that is wrong bends as the depth's error does, by its square
        range_bend=rng.uniform(-0.005, 0.005),
        range_bend_from=rng.uniform(6.0, 12.0),
        # nobody has measured the scale of its ranges
        sigma_range_scale=0.0,
    )
    # constant errors of the detector against the odometry
    # the sensor of one in four is mounted badly
    yaw = radians(rng.uniform(3.0, 7.0)) if rng.random() < 0.25 else radians(rng.uniform(0.0, 1.5))
    sensor_faults = SensorFaults(
        # stamps of the exposure and of the odometry's receipt make early ones, those of the result late ones
        latency=rng.uniform(-0.15, 0.15),
        # a plate that is mounted by eye is off by a degree; one recorded car's sensor is turned by 6.5
        yaw=yaw * float(rng.choice([-1.0, 1.0])),
        lateral=rng.normal(0.0, 0.03),
        # the recorded car has about 8 % and -0.19 m, which the odometry doesn't share
        range_scale=rng.uniform(-0.08, 0.08),
        range_bias=rng.uniform(-0.2, 0.2),
        # boxes too small for a colour
        colourless=rng.uniform(0.0, 0.05),
    )
    # an odometry between a good INS and wheels with a cheap gyro
    share = rng.random()
    white = np.array(INS.white) ** (1.0 - share) * np.array(OdometryNoise().white) ** share
    slow = np.array(INS.slow) * rng.uniform(0.5, 1.5)
    # scale and bias are those of the faults, so that the log says what was drawn
    odometry = OdometryNoise(
        white=(float(white[0]), float(white[1]), float(white[2])),
        scale=0.0,
        gyro_bias=0.0,
        slow=(float(slow[0]), float(slow[1]), float(slow[2])),
        slow_time=rng.uniform(2.0, 8.0),
    )
    # constant errors of the odometry, and false travel of some
    odometry_faults = OdometryFaults(
        # of a wheel's radius, and of a gyro that was averaged at rest for seconds
        speed_scale=rng.normal(0.0, 0.005),
        yaw_rate_bias=rng.normal(0.0, 0.0015),
        # recorded laps went on for 0.5 to 4 m, one of them at 1.3 m/s for 3 s
        false_travel=rng.uniform(0.3, 1.5) * (rng.random() < SOME),
        false_travel_time=rng.uniform(1.0, 4.0),
    )
    return DrawnCar(sensor, sensor_faults, odometry, odometry_faults, vehicle)


def log_uniform(rng: Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform, since its size isn't known."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
