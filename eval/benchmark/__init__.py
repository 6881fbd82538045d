"""The online mapper's speed, as ratios within one run."""
