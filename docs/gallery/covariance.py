# %% [markdown]
# # Graph and covariance
#
# The window is a GTSAM graph, and the joint covariance of any of its variables can be asked for.

# %%
import matplotlib.pyplot as plt
import numpy as np

from pathspace_graph import LEFT, FixedLagMapper, split_odometry
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

track = generate_track(np.random.default_rng(11), TrackGeneratorSettings(lap_length=(200, 240), cones=150))
log = simulate(track, SimulationSettings(laps=1), seed=0)
mapper = FixedLagMapper(odometry_sigma=log.odometry_sigma)
for odometry, detections in list(split_odometry(log))[:150]:
    mapper.update(odometry, detections)
graph, values = mapper.graph(), mapper.values()
print(graph.size(), "factors,", values.size(), "variables, error", round(graph.error(values), 2))

# %% [markdown]
# The newest pose and the last control point of the left boundary are correlated:

# %%
keys = [mapper.next_pose_key - 1, mapper.control_keys(LEFT)[-1]]
covariance = mapper.marginal_covariance(keys)
sigma = np.sqrt(np.diag(covariance))
print(np.round(covariance / np.outer(sigma, sigma), 2))

# %% [markdown]
# Along a boundary, the joint covariance of the control points gives the uncertainty across the curve. It grows with the distance driven and
# towards the end of the curve.

# %%
left = mapper.map().left
u = np.linspace(*left.spline.domain, 400)
figure, axes = plt.subplots(figsize=(7, 2.5), layout="constrained")
axes.plot(u, left.spline.normal_sigma(u, left.covariance))
axes.set(xlabel="parameter of the left boundary [m]", ylabel="sigma across [m]")
