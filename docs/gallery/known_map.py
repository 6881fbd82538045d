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

# %% [markdown]
# ## How sure a place is
#
# Every place has log odds against all others, and against none of them. Each second drive of a track searches itself at every tenth metre,
# knowing only its last 30 m of cones or 60 m of lines. On the map of another track none was found. From the line on, a place is taken.

# %%
import matplotlib.pyplot as plt
import pandas as pd

from pathspace_graph.eval.cars import odds_of_track
from pathspace_graph.places.find import SURE_ODDS

searches = pd.DataFrame([row for car in ("plain", "drawn", "lines") for row in odds_of_track(car, 60)])
found = searches[np.isfinite(searches["odds"])]
print(
    searches.groupby("kind").size().to_dict(),
    found.groupby("kind")["wrong"].agg(["size", "sum"]).to_dict("index"),
)
figure, axes = plt.subplots(figsize=(7, 3))
bins = np.arange(-5.0, 20.0)
axes.hist(
    [found["odds"][found["wrong"] == wrong] for wrong in (False, True)],
    bins,
    stacked=True,
    label=["right", "wrong"],
)
axes.axvline(SURE_ODDS, color="black")
axes.set(xlabel="log odds of a place", ylabel="searches")
_ = axes.legend()
