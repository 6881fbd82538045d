# %% [markdown]
# # Lines instead of cones
#
# Points lie anywhere along both boundaries, 1 m apart on average, at other places in each cycle. No point is seen twice, so there are no
# landmarks to associate. The residual across the curve needs none.

# %%
from dataclasses import replace

import numpy as np

from pathspace_graph import make_online, run_online
from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import preset, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

track = generate_track(np.random.default_rng(11), TrackGeneratorSettings(lap_length=(130, 160), cones=100))
log = simulate(track, replace(preset({"sensor": "line"}), laps=2), seed=0)
result = run_online(log, make_online("fixed-lag", MapperSettings(), log))
lap_metrics(result.map, log.truth, lap=2)

# %%
result.plot(log=log)
