# %% [markdown]
# # The first lap
#
# The map grows with every cycle. Cones ahead that no curve explains yet appear as a tentative (dashed) stretch, so a planner can use the
# map before it is confirmed.

# %%
import numpy as np

from pathspace_graph import FixedLagMapper, split_odometry
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

track = generate_track(np.random.default_rng(11), TrackGeneratorSettings(lap_length=(200, 240), cones=150))
log = simulate(track, SimulationSettings(laps=1), seed=0)
log

# %% [markdown]
# By odometry alone the detections of a cone spread by metres over the lap:

# %%
log.plot()

# %% [markdown]
# `update` takes the twists since the last cycle and the detections of this one. After 150 cycles:

# %%
mapper = FixedLagMapper(odometry_sigma=log.odometry_sigma)
for odometry, detections in list(split_odometry(log))[:150]:
    result = mapper.update(odometry, detections)
print(result)
mapper.map().plot(trajectory=mapper.poses)

# %% [markdown]
# What a controller reads in each cycle: the next 20 m in the vehicle's frame.

# %%
ahead = mapper.ahead(20.0)
print(f"{len(ahead.points)} points, {ahead.confirmed.sum()} of them confirmed")
np.round(ahead.curvature, 3)
