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
from pathspace_graph.spline.planning import speed_profile

track = generate_track(np.random.default_rng(11), TrackGeneratorSettings(lap_length=(130, 160), cones=100))
log = simulate(track, SimulationSettings(laps=2), seed=0)
result = run_online(log, FixedLagMapper(odometry_sigma=log.noise))
result

# %%
result.plot(log=log)

# %% [markdown]
# The number of control points drops where the loop closes, and stays constant afterwards.

# %%
cycles = result.to_frame()
figure, axes = plt.subplots(figsize=(7, 2.5), layout="constrained")
axes.plot(cycles["t"], cycles["size_left"] + cycles["size_right"])
_ = axes.set(xlabel="t [s]", ylabel="control points")

# %% [markdown]
# ## What a planner reads
#
# The centre line of a map comes as arrays: points, heading, curvature, arc length and widths, each with its standard deviation. A speed
# profile follows from friction and curvature.

# %%
line = result.map.centre_line(step=1.0)
profile = speed_profile(line)
print(f"a lap of {line.length:.0f} m takes {profile.duration:.1f} s")
figure, (where, how) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
coloured = where.scatter(*line.points.T, c=profile.speed, s=6)
where.set_aspect("equal")
figure.colorbar(coloured, ax=where, label="speed [m/s]")
how.plot(line.arc_length, line.width_left, label="left")
how.plot(line.arc_length, line.width_right, label="right")
how.set(xlabel="arc length [m]", ylabel="width [m]")
_ = how.legend()
