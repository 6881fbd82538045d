# %% [markdown]
# # A graph to take away
#
# The batch is a GTSAM graph. What was measured of curves are factors in Python, which GTSAM cannot serialize: `write_graph` linearizes
# them at the optimum, so that GTSAM alone, in C++ too, reads the file and comes back to the same optimum.

# %%
from pathlib import Path
from tempfile import mkdtemp

import gtsam
import matplotlib.pyplot as plt
import numpy as np

from pathspace_graph import BatchMapper
from pathspace_graph.graph.exchange import read_graph, write_g2o, write_graph
from pathspace_graph.graph.variables import pose_key
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

log = simulate(generate_track(np.random.default_rng(5)), SimulationSettings(laps=2), 5)
result, folder = BatchMapper(odometry_sigma=log.noise).solve(log), Path(mkdtemp())
write_graph(folder / "graph.json", result.graph(), result.values())
print(f"{result.graph().size()} factors, {(folder / 'graph.json').stat().st_size / 1e6:.1f} MB")


def poses_of(values):
    """Poses (P, 3) of all cycles."""
    poses = (values.atPose2(pose_key(k)) for k in range(len(result.trajectory)))
    return np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses])


# %% [markdown]
# ## Optimized again
#
# Every pose begins some centimetres beside its optimum. GTSAM's own optimizer needs nothing of this project.

# %%
graph, values = read_graph(folder / "graph.json")
begin, rng = gtsam.Values(values), np.random.default_rng(0)
for k in range(len(result.trajectory)):
    begin.update(pose_key(k), values.atPose2(pose_key(k)).retract(rng.normal(0.0, [0.05, 0.05, 0.005])))
found = gtsam.LevenbergMarquardtOptimizer(graph, begin).optimize()
off = np.hypot(*(poses_of(found) - result.trajectory)[:, :2].T)
print(f"largest distance from the optimum: {1e3 * off.max():.2f} mm")

# %% [markdown]
# ## The pose graph
#
# g2o has poses, and measurements of one pose relative to another: odometry, corrected by the calibration that was found, and revisits. Curves
# and calibrations are left out, so the optimum is another one. The difference is what the boundaries say.

# %%
pose_graph = result.pose_graph()
write_g2o(folder / "graph.g2o", pose_graph, result.values())
print(f"{pose_graph.size()} of {result.graph().size()} factors; the file begins with")
print(*(folder / "graph.g2o").read_text().splitlines()[:2], sep="\n")

with_start = gtsam.NonlinearFactorGraph(pose_graph)
start = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
with_start.add(gtsam.PriorFactorPose2(pose_key(0), result.values().atPose2(pose_key(0)), start))
poses = gtsam.Values()
for k in range(len(result.trajectory)):
    poses.insert(pose_key(k), result.values().atPose2(pose_key(k)))
alone = poses_of(gtsam.LevenbergMarquardtOptimizer(with_start, poses).optimize())
figure, axes = plt.subplots()
for name, found in (("with curves", result.trajectory), ("pose graph alone", alone)):
    true = np.column_stack(
        [np.interp(result.trajectory_t, log.truth.pose_t, x) for x in log.truth.poses[:, :2].T]
    )
    axes.plot(result.trajectory_t, np.hypot(*(found[:, :2] - true).T), label=name)
axes.set(xlabel="time [s]", ylabel="distance from the true position [m]", ylim=(0, None))
axes.legend()
