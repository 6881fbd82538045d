# %% [markdown]
# # Skidpad
#
# The road stays open: each round passes a stretch that is mapped already, but not the start. Revisits of earlier cones take the drift out.

# %%
import numpy as np

from pathspace_graph import FixedLagMapper, run_online
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import skidpad

log = simulate(skidpad(), SimulationSettings(), seed=0)
result = run_online(log, FixedLagMapper(odometry_sigma=log.noise))
true = np.column_stack(
    [np.interp(result.trajectory_t, log.truth.pose_t, log.truth.poses[:, k]) for k in range(2)]
)
print(f"trajectory error {np.sqrt(((result.trajectory[:, :2] - true) ** 2).sum(axis=1).mean()):.2f} m rms")
result.plot(log=log)
