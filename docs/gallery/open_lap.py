# %% [markdown]
# # The first lap
#
# The map grows with every cycle. Cones ahead that no curve explains yet appear as a tentative (dashed) stretch, so a planner can use the
# map before it is confirmed.

# %%
import matplotlib.pyplot as plt
import numpy as np

from pathspace_graph import LEFT, FixedLagMapper, split_odometry
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

track = generate_track(np.random.default_rng(11), TrackGeneratorSettings(lap_length=(130, 160), cones=100))
log = simulate(track, SimulationSettings(laps=1), seed=0)
log

# %% [markdown]
# By odometry alone the detections of a cone spread by metres over the lap:

# %%
log.plot()

# %% [markdown]
# `update` takes the twists since the last cycle and the detections of this one. After 120 cycles:

# %%
mapper = FixedLagMapper(odometry_sigma=log.noise)
for odometry, detections in list(split_odometry(log))[:120]:
    result = mapper.update(odometry, detections)
print(f"{result.t:.1f} s: {sum(result.sizes)} control points, {result.health.condition}")
mapper.map().plot(trajectory=mapper.poses)

# %% [markdown]
# What a controller reads in each cycle: the next 20 m in the vehicle's frame.

# %%
ahead = mapper.ahead(20.0)
print(f"{len(ahead.points)} points, {ahead.confirmed.sum()} of them confirmed")
np.round(ahead.curvature, 3)

# %% [markdown]
# ## Graph and covariance
#
# The window is a GTSAM graph, and the joint covariance of any of its variables can be asked for. The newest pose and the last control point
# of the left boundary are correlated:

# %%
graph, values = mapper.graph(), mapper.values()
print(f"{graph.size()} factors, {values.size()} variables, error {graph.error(values):.2f}")
covariance = mapper.marginal_covariance([mapper.next_pose_key - 1, mapper.control_keys(LEFT)[-1]])
sigma = np.sqrt(np.diag(covariance))
print(np.round(covariance / np.outer(sigma, sigma), 2))

# %% [markdown]
# The joint covariance of the control points gives the uncertainty across the curve. It grows with the distance driven and towards the end
# of the curve.

# %%
left = mapper.map().left
u = np.linspace(*left.spline.domain, 400)
figure, axes = plt.subplots(figsize=(7, 2.5), layout="constrained")
axes.plot(u, left.spline.normal_sigma(u, left.covariance))
_ = axes.set(xlabel="parameter of the left boundary [m]", ylabel="sigma across [m]")
