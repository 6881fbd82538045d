"""Pictures of maps, and the paper's isolated tests as figures."""
