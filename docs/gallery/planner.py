# %% [markdown]
# # What a planner reads
#
# The centre line of a map comes as arrays: points, heading, curvature, arc length and widths, each with its standard deviation. A speed
# profile follows from friction and curvature.

# %%
import matplotlib.pyplot as plt
import numpy as np

from pathspace_graph import FixedLagMapper, run_online
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track
from pathspace_graph.spline.planning import speed_profile

track = generate_track(np.random.default_rng(11), TrackGeneratorSettings(lap_length=(200, 240), cones=150))
log = simulate(track, SimulationSettings(laps=1), seed=0)
line = run_online(log, FixedLagMapper(odometry_sigma=log.odometry_sigma)).map.centre_line(step=1.0)
profile = speed_profile(line)
print(f"a lap of {line.length:.0f} m takes {profile.duration:.1f} s")

# %%
figure, (where, how) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
coloured = where.scatter(*line.points.T, c=profile.speed, s=6)
where.set_aspect("equal")
figure.colorbar(coloured, ax=where, label="speed [m/s]")
how.plot(line.arc_length, line.width_left, label="left")
how.plot(line.arc_length, line.width_right, label="right")
how.set(xlabel="arc length [m]", ylabel="width [m]")
how.legend()
