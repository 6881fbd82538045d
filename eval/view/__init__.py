"""What shows a run while it goes on: a recording for the live viewer."""
