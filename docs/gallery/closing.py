# %% [markdown]
# # Closing the loop
#
# When the newest cones lie on those of the start, the lap is solved as a batch in another process. The loop closes if the batch agrees
# with the odometry and the detections. Both curves then become periodic, on fewer control points.

# %%
import matplotlib.pyplot as plt
import numpy as np

from pathspace_graph import FixedLagMapper, run_online
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

track = generate_track(np.random.default_rng(11), TrackGeneratorSettings(lap_length=(200, 240), cones=150))
log = simulate(track, SimulationSettings(laps=2), seed=0)
result = run_online(log, FixedLagMapper(odometry_sigma=log.odometry_sigma))
result

# %%
result.plot(log=log)

# %% [markdown]
# The number of control points drops where the loop closes, and stays constant afterwards.

# %%
cycles = result.to_frame()
figure, axes = plt.subplots(figsize=(7, 2.5), layout="constrained")
axes.plot(cycles["t"], cycles["size_left"] + cycles["size_right"])
axes.set(xlabel="t [s]", ylabel="control points")
