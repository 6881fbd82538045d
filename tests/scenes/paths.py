"""Where the project is, and the real tracks beside it, which not every machine has."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The project's folder."""
TRACKS = ROOT.parent / "shared" / "tracks"
"""Track files of other projects, in a folder for each kind."""
