# %% [markdown]
# # Own factors
#
# A compass measures the heading of each pose, a receiver the position of each tenth one. A method `factors` gives them to the online mapper
# and to the batch. Studies record the sources of their estimators, so the classes are in a file.

# %%
import sys
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt
import numpy as np

from pathspace_graph import BatchMapper, FixedLagMapper, estimators, write_log
from pathspace_graph.eval.experiment.run import run_study
from pathspace_graph.eval.experiment.study import Baseline, Study
from pathspace_graph.run import run_online
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

MODULE = """
import gtsam
import numpy as np

from pathspace_graph import BatchMapper, FixedLagMapper
from pathspace_graph.graph.variables import pose_key

SIGMA_HEADING, SIGMA_POSITION = 0.01, 0.2  # rad, m


def true_poses(log):
    t = np.array([cycle.t for cycle in log.cycles])
    return np.column_stack([np.interp(t, log.truth.pose_t, x) for x in np.unwrap(log.truth.poses, axis=0).T])


class Sensors:
    def factors(self, log):
        rng, found = np.random.default_rng(0), []
        heading = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e3, 1e3, SIGMA_HEADING]))
        position = gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_POSITION)
        for k, (x, y, theta) in enumerate(true_poses(log)):  # readings are drawn about the truth
            read = gtsam.Pose2(x, y, theta + SIGMA_HEADING * rng.normal())
            found.append(gtsam.PriorFactorPose2(pose_key(k), read, heading))
            if k % 10 == 0:
                fix = gtsam.Pose2(*([x, y] + SIGMA_POSITION * rng.normal(size=2)), 0.0)
                found.append(gtsam.PoseTranslationPrior2D(pose_key(k), fix, position))
        return found


class SensorFixedLag(Sensors, FixedLagMapper):
    pass


class SensorBatch(Sensors, BatchMapper):
    def __init__(self, settings, noise):
        super().__init__(settings, noise, SensorFixedLag)
"""
folder = Path(mkdtemp())
(folder / "sensors.py").write_text(MODULE)
sys.path.insert(0, str(folder))
from sensors import SensorBatch, SensorFixedLag, true_poses

# %% [markdown]
# ## One optimum
#
# Without cones, a window of all cycles and the batch are one problem, and so is what GTSAM makes of the exported graph. With cones the batch
# has other weights and other knots: its graph is at its optimum, and the poses online are near.

# %%
tracks = [
    generate_track(np.random.default_rng(seed), TrackGeneratorSettings(lap_length=(130, 160), cones=100))
    for seed in (11, 12)
]
logs = [simulate(track, SimulationSettings(laps=1), seed=k) for k, track in enumerate(tracks)]
log = logs[0]
run, result = run_online(log, SensorFixedLag(None, log.noise)), SensorBatch(None, log.noise).solve(log)
count, cost = result.own_factors
print(f"{count} factors with a cost of {cost:.1f}, of {result.graph().size()} factors with {result.cost:.1f}")
linear = result.graph().linearize(result.values())
hessian, gradient = linear.hessian(result.optimum.state.variables.layout.ordering)
print(f"next step by GTSAM: {np.sqrt(gradient @ np.linalg.solve(hessian, gradient)):.2f} joint sigmas")

plain = run_online(log, FixedLagMapper(None, log.noise)), BatchMapper(None, log.noise).solve(log)
figure, axes = plt.subplots()
named = {"online": plain[0], "batch": plain[1], "online, with sensors": run, "batch, with sensors": result}
for name, found in named.items():
    off = np.hypot(*(found.trajectory - true_poses(log))[:, :2].T)
    axes.plot(found.trajectory_t, off, "-" if "sensors" in name else ":", label=name)
axes.set(xlabel="time [s]", ylabel="distance from the true position [m]", ylim=(0, None))
_ = axes.legend()

# %% [markdown]
# ## An ablation
#
# A study knows an estimator by its name. A package names its own in an entry point; a notebook can register them in its process.

# %%
estimators.ONLINE["sensor-fixed-lag"] = SensorFixedLag
estimators.BATCH["sensor-batch"] = SensorBatch
for k, one in enumerate(logs):
    write_log(one, folder / f"drive{k}")
study = Study(
    logs={name: (folder / name,) for name in ("drive0", "drive1")},
    estimators=("fixed-lag", "sensor-fixed-lag", "spline", "sensor-batch"),
    metrics=("rmse", "ate"),
    baseline=Baseline(estimator="fixed-lag"),
)
runs = run_study(study, jobs=1)
runs.groupby("estimator", sort=False)[["rmse", "ate", "along", "across"]].mean().round(3)
