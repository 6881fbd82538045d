"""Settings: frozen dataclasses with a sentence for each field, and no number anywhere else."""
