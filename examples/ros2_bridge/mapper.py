import json
import sys

import numpy as np

from pathspace_graph import Detections, FixedLagMapper, Odometry, PathspaceError
from pathspace_graph.labels import label_from_name

mapper, twists = FixedLagMapper(), []
for line in sys.stdin:
    message = json.loads(line)
    if "twist" in message:
        twists.append((message["t"], message["twist"]))
        continue
    t, cones = message["t"], message["detections"]
    used = [row for row in twists if row[0] <= t]
    odometry = Odometry(
        np.array([at for at, _ in used]), np.array([twist for _, twist in used]).reshape(-1, 3)
    )
    points = np.array([[cone["x"], cone["y"]] for cone in cones]).reshape(-1, 2)
    labels = np.array([label_from_name(cone["label"]) for cone in cones], int)
    covariances = np.tile(0.02 * np.eye(2), (len(cones), 1, 1))
    try:
        result = mapper.update(odometry, Detections(t, points, covariances, labels))
    except PathspaceError as error:  # the mapper is as it was
        print(error, file=sys.stderr)
        continue
    twists = used[-1:] + twists[len(used) :]
    ahead = mapper.ahead(20.0)
    print(json.dumps({"t": t, "pose": result.pose.tolist(), "centre": ahead.points.tolist()}), flush=True)
