"""Drives: names of tracks, folders of tracks, and what two drives must share to have one log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import InputError
from pathspace_graph.eval.experiment.study import load_tracks, simulated_drive, track_digest
from pathspace_graph.sim.simulate import SimulationSettings

from ...scenes.pretenders import write_round_track


def folder_of_two(folder: Path) -> Path:
    """A folder with two track files, and a file that is none."""
    folder.mkdir()
    track = write_round_track(folder)
    track.rename(folder / f"another{track.suffix}")
    write_round_track(folder)
    (folder / "README.md").write_text("no track")
    return folder


def test_a_folder_stands_for_its_track_files_in_order(tmp_path: Path) -> None:
    folder = folder_of_two(tmp_path / "tracks")
    names = sorted(file.stem for file in folder.iterdir() if file.suffix != ".md")
    assert [track.name for track in load_tracks([folder, 3])] == [*names, "generated 3"]


def test_files_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    files = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        files.append(write_round_track(tmp_path / name))
    assert [track.name for track in load_tracks(files)] == [f"{n}/{files[0].stem}" for n in ("a", "b")]


def test_a_folder_without_tracks_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected track files"):
        load_tracks([tmp_path])
    track = write_round_track(tmp_path)
    wrong = track.with_name(f"x{track.name}")
    with pytest.raises(InputError, match=f"the nearest is '{track.name}'"):
        load_tracks([wrong])


def test_a_drive_is_the_same_by_geometry_seed_and_simulation_whatever_its_names() -> None:
    (track,) = load_tracks([0])
    two, three = (SimulationSettings(laps=laps) for laps in (2, 3))
    drive, renamed = simulated_drive(track, 0, "nominal", two), replace(track, name="another name")
    assert simulated_drive(renamed, 0, "quiet", two).id == drive.id
    assert simulated_drive(track, 1, "nominal", two).id != drive.id
    assert simulated_drive(track, 0, "nominal", three).id != drive.id


def test_the_last_digits_of_a_track_do_not_matter_to_its_drives_and_a_centimetre_does() -> None:
    (track,) = load_tracks([0])
    simple = replace(track, other=np.array([[-0.0, 0.0005], [1.0, 2.5 / 3.0]]))
    for one in (track, simple):
        for shift in (-1e-12, 1e-12):
            moved = {name: getattr(one, name) + shift for name in ("left", "right", "other", "start")}
            assert track_digest(replace(one, **moved)) == track_digest(one)
        for name in ("left", "right", "start"):
            cone_moved = getattr(one, name).copy()
            cone_moved.flat[-1] += 0.01
            assert track_digest(replace(one, **{name: cone_moved})) != track_digest(one)
    assert track_digest(replace(simple, other=np.abs(simple.other))) == track_digest(simple)


def test_the_drives_of_a_generated_track_are_those_of_every_machine() -> None:
    """Another number makes other drives on all generated tracks, and all figures of the pages old."""
    assert simulated_drive(load_tracks([0])[0], 0, "nominal", SimulationSettings()).source == "3921578876"
