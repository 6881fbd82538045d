"""The front end: it judges the readings of each cycle before an estimator takes them."""
