# %% [markdown]
# # An ablation
#
# A study is a grid of tracks, seeds, estimators and settings. The same study can be a TOML file for `pathspace-graph ablate`. This one is
# kept small: two short tracks, one lap, and a lag of 1 s against 3 s.

# %%
from tempfile import mkdtemp

from pathspace_graph.eval.experiment.plots import plot_differences
from pathspace_graph.eval.experiment.run import run_study
from pathspace_graph.eval.experiment.study import Study

study = Study(
    tracks=(11, 12), seeds=(0,), laps=1, grids=({"lag": [1.0, 3.0]},), metrics=("rmse", "missed", "size")
)
runs = run_study(study, mkdtemp(), jobs=1)
runs.groupby("variant")[["rmse", "missed", "size"]].mean().round(3)

# %% [markdown]
# Differences from the baseline are paired by drive. With two tracks their intervals are wide: a study for a paper has ten or more.

# %%
plot_differences(study, runs)
