# %% [markdown]
# # A known map
#
# The map of one drive is the prior of the next. The vehicle may start anywhere on it; here it starts a third of a lap further on, with
# other odometry and other noise. Until it is found, its poses are in a frame of its own.

# %%
from dataclasses import replace

import numpy as np

from pathspace_graph import FixedLagMapper, run_online
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

track = generate_track(np.random.default_rng(11), TrackGeneratorSettings(lap_length=(130, 160), cones=100))
first = simulate(track, SimulationSettings(laps=1), seed=0)
known = run_online(first, FixedLagMapper(odometry_sigma=first.odometry_sigma)).map
known

# %%
again = simulate(track, SimulationSettings(laps=1), seed=1)
late = again.cycles[80].t
log = replace(
    again,
    odometry=again.odometry.between(late, np.inf),
    cycles=tuple(cycle for cycle in again.cycles if cycle.t > late + 0.1),
    truth=None,
)
mapper = FixedLagMapper.on(known, odometry_sigma=log.noise)
result = run_online(log, mapper)
print(next(record.notice for record in result.cycles if record.notice))
result.plot()
