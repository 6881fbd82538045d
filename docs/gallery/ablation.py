# %% [markdown]
# # An ablation
#
# A study is a grid of tracks, seeds, estimators and settings. The same study can be a TOML file for `pathspace-graph ablate`. This one is
# kept small: a lap of two short tracks, and a lag of 1 s against 3 s.

# %%
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

from pathspace_graph import write_log
from pathspace_graph.eval.experiment.run import run_study
from pathspace_graph.eval.experiment.study import Study
from pathspace_graph.eval.experiment.tables import plot_differences
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

folder = Path(mkdtemp())
for seed in (11, 12):
    track = generate_track(
        np.random.default_rng(seed), TrackGeneratorSettings(lap_length=(130, 160), cones=100)
    )
    write_log(simulate(track, SimulationSettings(laps=1), seed=seed), folder / f"drive{seed}")
study = Study(
    logs={name: (folder / name,) for name in ("drive11", "drive12")},
    grids=({"lag": [1.0, 3.0]},),
    metrics=("rmse", "missed", "size"),
)
runs = run_study(study, folder / "study", jobs=1)
runs.groupby("variant")[["rmse", "missed", "size"]].mean().round(3)

# %% [markdown]
# Differences from the baseline are paired by drive. With two tracks their intervals are wide: a study for a paper has ten or more.

# %%
plot_differences(study, runs)
