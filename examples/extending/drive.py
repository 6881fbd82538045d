from compass import compass_factor

from pathspace_graph import FixedLagMapper
from pathspace_graph.run import split_odometry


def drive(log, headings):
    """Map a log with a compass, which gives a heading (rad) for each cycle; return the mapper."""
    mapper = FixedLagMapper(odometry_sigma=log.noise)
    for (odometry, detections), heading in zip(split_odometry(log), headings, strict=True):
        compass = compass_factor(mapper.next_pose_key, heading, sigma=0.01)
        mapper.update(odometry, detections, [compass])
    return mapper
