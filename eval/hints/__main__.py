"""`python -m pathspace_graph.eval.hints` measures how many spoiled logs are told and good ones accused."""

from .measure import main

main()
