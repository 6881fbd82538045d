"""The suite of faults: what each systematic fault of a car costs, and what the estimator says about it."""
