"""What is fuzzed: each reader of files, on a folder of good files of which an input replaces some.

An input is text in sections. Each begins with a line `=== NAME` and is the content of the file of that name.
Bytes before the first section are the content of the target's first file. The rest of the folder is good.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from pathspace_graph.eval.experiment.study import read_study_file
from pathspace_graph.io.log_files import read_log
from pathspace_graph.io.map import read_map
from pathspace_graph.io.tables import read_trajectory
from pathspace_graph.sim.track_files import read_track

SECTION = re.compile(rb"(?:\A|(?<=\n))=== ([a-z_]+\.[a-z]+)\n")


@dataclass(frozen=True)
class Target:
    """Names the files of a reader, and how it is called."""

    files: Mapping[str, str]
    """These are the files of the folder with their good content; an input replaces only these."""
    read: Callable[[Path], object]
    """This reads the folder."""

    def run(self, data: bytes, folder: Path) -> None:
        """Writes the input's files to the folder, and reads it."""
        self.write(data, folder)
        self.read(folder)

    def write(self, data: bytes, folder: Path) -> None:
        """Writes the input's files to the folder."""
        names = iter(SECTION.split(data))
        contents = {next(iter(self.files)): next(names)}
        contents |= {name.decode(): content for name, content in zip(names, names, strict=True)}
        for name, good in self.files.items():
            content = contents.get(name, b"") or good.encode()
            if content:
                (folder / name).write_bytes(content)
            else:
                (folder / name).unlink(missing_ok=True)


def read_tracks(folder: Path) -> None:
    """Reads whichever track file there is."""
    for name in ("track.yaml", "track.csv"):
        if (folder / name).exists():
            read_track(folder / name)


LOG = {
    "log.toml": 'format = "pathspace-log/1"\n[odometry]\nsigma = [0.1, 0.1, 0.01]\n',
    "odometry.csv": "t,vx,vy,wz\n0.0,5,0,0\n0.1,5,0,0.1\n0.2,5,0,0.1\n",
    "detections.csv": "t,x,y,label,xx,xy,yy\n0.0,5,1.5,left,0.01,0,0.01\n0.1,5,-1.5,right,0.01,0,0.01\n",
    "truth_poses.csv": "",
    "truth_cones.csv": "",
    "truth_associations.csv": "",
}
TARGETS = {
    "log": Target(LOG, read_log),
    "map": Target({"map.json": ""}, read_map),
    "trajectory": Target({"trajectory.tum": ""}, lambda folder: read_trajectory(folder / "trajectory.tum")),
    "track": Target({"track.yaml": "", "track.csv": ""}, read_tracks),
    "study": Target({"study.toml": ""}, lambda folder: read_study_file(folder / "study.toml")),
}
INPUTS = sorted(file for file in Path(__file__).with_name("corpus").rglob("*") if file.is_file())
READ = {"good", "quoted", "splines", "points", "eufs", "tum", "pacsim", "fssim"}
"""Inputs of the corpus of these names are read, all others are refused."""
