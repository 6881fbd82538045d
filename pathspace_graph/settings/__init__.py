"""Settings: frozen dataclasses of what a user or a study changes; every other number is a constant."""
