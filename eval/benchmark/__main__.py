"""`python -m pathspace_graph.eval.benchmark` measures the online mapper's speed."""

from .benchmark import main

main()
