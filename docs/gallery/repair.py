# %% [markdown]
# # Repairing a closed map
#
# In the first lap the sensor misses the left cones of a stretch of 20 m, and a curve without cones bridges the hole. In the second lap the
# detections there contradict the closed map; the drive is solved again and the stretch is replaced.

# %%
import numpy as np

from pathspace_graph import FixedLagMapper, run_online
from pathspace_graph.sim.faults import Faults, SensorFaults
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

track = generate_track(np.random.default_rng(11), TrackGeneratorSettings(lap_length=(130, 160), cones=100))
faults = Faults(sensor=SensorFaults(blind=20.0, blind_at=0.4))
log = simulate(track, SimulationSettings(laps=2, faults=faults), seed=0)
result = run_online(log, FixedLagMapper(odometry_sigma=log.noise))
for record in result.cycles:
    if record.notice:
        print(f"{record.t:.1f} s: {record.notice}")

# %% [markdown]
# The map at the end of the first lap, and at the end of the drive:

# %%
result.lap_maps[0][1].plot(log=log)

# %%
result.map.plot(log=log)
