"""Wrong usages of the command line: each is one line on standard error, exit code 2, and leaves nothing."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

from pathspace_graph.cli import main
from pathspace_graph.errors import PathspaceError
from pathspace_graph.io.map import map_to_json

from ..fuzz.targets import INPUTS, READ, TARGETS
from ..scenes.maps import point_map

USAGES = """
onlin | found 'onlin', the nearest is 'online'
help onlin | found 'onlin', the nearest is 'online'
zzz | report), found 'zzz'
online | --log requires an argument
online LOG | --out requires an argument
online LOG MAP --out X | ['MAP']
online LOG --out MAP | LOG: expected a log folder
online LOG --out MAP --lag long | --lag: unable to convert "long"
online LOG --out MAP --lag nan | lag: expected a positive number, found nan
online LOG --out MAP --lag 2 --lag 3 | --lag specified multiple times
online LOG --out MAP --zzz 1 | Unknown option: --zzz
online LOG --out MAP --estimator magic | ckf, fixed-lag, landmark-ckf, landmark-fixed-lag), found 'magic'
online LOG --out MAP --gate 3 | Unknown option: --gate
online LOG --out MAP --max-poses 2.7 | --max-poses: unable to convert
online LOG --out MAP --keep-map=x | --keep-map: unable to convert
online LOG --out MAP --noise x | Choose from: "measured", "stated"
online LOG --out MAP --plot map.doc | map.doc: expected a file name that ends
online LOG --out MAP --settings none.toml | none.toml: expected a file of settings, found none
online LOG --out MAP --spline.degree 0 | spline.degree: expected a positive whole number
online LOG --out MAP --start 0 0 0 | --start: expected --on MAP as well, found none
online LOG --out MAP --keep-map | --keep-map: expected --on MAP as well, found none
online LOG --out MAP --on map --estimator ckf | --on: expected --estimator fixed-lag, found ckf
online LOG --out MAP --on map --start 1 2 | --start requires 3
online LOG --out MAP --on map --map-sigma 0 | map_sigma: expected a positive number, found 0
online LOG --out MAP --on nowhere | nowhere: expected a map's folder, a track file, skidpad or acceleration
batch a b --out MAP --estimator landmark-batch | --estimator: expected spline for several logs
batch a b --out MAP | a: expected a log folder, found none
export map --out F --as word | --as. Choose from: "centerline", "tum"
export map --out F --as geojson | --origin: expected LATITUDE LONGITUDE HEADING in degrees
export map --out F --as lanelet2 --origin 95 0 0 | origin: expected a latitude between -90 and 90 degrees
export map --out F --as lanelet2 --origin 9 9 0 | map.json: lanelet2: expected a curve as left boundary
export map --out F --as centerline | map.json: a centre line: expected a curve as left boundary
export map --out F --as points --stop | --start-speed, --stop: expected --as profile
export map --out F --as points --step 0 | --step: expected a number of at least
export map --out F --as tum | trajectory.tum: expected a trajectory, found none
plot map --out map.doc | map.doc: expected a file name that ends
plot MAP --out map.png | map.json: expected a map, found none
convert BAG --out LOG --sigma-odometry 1 2 | --sigma-odometry requires 3
convert BAG --out LOG --mounting 1 -2 a | --mounting: unable to convert "a"
convert BAG --out LOG --start 3 --end 2 | start: expected less than end, found 3 and 2
convert BAG --out LOG --time-offset nan | time_offset: expected a number, found nan
simulate --out LOG | expected one of --track FILE, --generate SEED or --event NAME
simulate --generate 99999999999999999999 --out LOG | --generate: unable to convert
simulate --generate 1 --sensor lidar --out LOG | sensor
simulate --generate -1 --out LOG | seed of a generated track: expected at least 0
simulate --event skidpad --out LOG --faults.sensor.colourless 2 | colourless: expected a number in [0, 1]
simulate --track none.yaml --out LOG | none.yaml: expected a track file, found none
compare map --out D --estimators nothing | 'nothing'
ablate lagg --out D | the nearest is 'lag'
ablate lag --out D --jobs 0 | jobs: expected
ablate lag --out D --laps 0 | --laps: expected at least 1
ablate lag --out D --baseline lagg | --baseline: expected a variant or an estimator
ablate lag --out D --tracks none.yaml | none.yaml
faults --out D --only latenc | the nearest is 'latency of detections'
faults --out D --estimator fixed-lagg | the nearest is 'fixed-lag'
scale --out D --estimators foo | --estimators: expected a known online estimator
"""


@pytest.mark.parametrize("usage", USAGES.strip().splitlines())
def test_a_wrong_usage_is_one_line(
    usage: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "map.json").write_text(json.dumps(map_to_json(point_map())))
    words, said = usage.split(" | ")
    assert main(shlex.split(words)) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1 and printed.err.startswith("pathspace-graph: ")
    assert said in printed.err
    assert [path.name for path in tmp_path.iterdir()] == ["map"]


# --- strange files, with which fuzzing began or which it found -------------------------------------------


COMMANDS = {
    "log": ["online", "{folder}", "--out", "{out}"],
    "map": ["plot", "{folder}", "--out", "{out}.png"],
    "track": ["simulate", "--track", "{track}", "--out", "{out}"],
    "study": ["ablate", "{folder}/study.toml", "--out", "{out}"],
}
STRANGE = [file for file in INPUTS if file.name not in READ]


@pytest.mark.parametrize("file", [file for file in INPUTS if file.name in READ], ids=lambda file: file.name)
def test_a_good_file_of_the_corpus_is_read(file: Path, tmp_path: Path) -> None:
    TARGETS[file.parent.name].run(file.read_bytes(), tmp_path)


@pytest.mark.parametrize("file", STRANGE, ids=lambda file: f"{file.parent.name}-{file.name}")
def test_a_strange_file_ends_in_one_line(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    if file.parent.name not in COMMANDS:
        with pytest.raises(PathspaceError):
            TARGETS[file.parent.name].run(file.read_bytes(), folder)
        return
    TARGETS[file.parent.name].write(file.read_bytes(), folder)
    track = next(iter(folder.glob("track.*")), folder)
    command = [
        word.format(folder=folder, track=track, out=tmp_path / "out") for word in COMMANDS[file.parent.name]
    ]
    assert main(command) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "expected" in line and str(folder) in line
    assert len(line) < 600
    assert [path.name for path in tmp_path.iterdir()] == ["in"]
