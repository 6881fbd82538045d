"""Places on what is known: proposers, verifiers, and one decision by odds."""
