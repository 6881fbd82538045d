"""Scenes of any size: lengths are divided by one scale on the way in, and multiplied by it on the way out."""
