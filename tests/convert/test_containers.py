"""Files that are no ROS bags are named for what they are, and nothing is written."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import pytest

from pathspace_graph.cli import main
from pathspace_graph.convert.bag import described

MAGIC = b"\x89MCAP0\r\n"


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def mcap(profile: str, encodings: dict[str, str], *, summary: bool = True) -> bytes:
    """An MCAP file with a message in each topic of an encoding, by the facts of its specification."""
    header, known, messages = record(1, text(profile) + text("test")), b"", b""
    for number, (topic, encoding) in enumerate(encodings.items(), start=1):
        schema = struct.pack("<H", number) + text(f"car.Message{number}") + text(encoding) + text("")
        channel = struct.pack("<HH", number, number) + text(topic) + text(encoding) + text("")
        known += record(3, schema) + record(4, channel)
        messages += record(5, struct.pack("<HIQQ", number, 0, 7, 7) + b"\x01\x02")
    begin = MAGIC + header + known + messages + record(15, struct.pack("<I", 0))
    footer = record(2, struct.pack("<QQI", len(begin) if summary else 0, 0, 0))
    return begin + (known if summary else b"") + footer + MAGIC


def refused(path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    out = path.parent.parent / "log"
    assert main(["convert", str(path), "--odometry", "/a", "--detections", "/b", "--out", str(out)]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and not out.exists()
    return line


@pytest.mark.parametrize("summary", [True, False])
@pytest.mark.parametrize("encoding", ["protobuf", "json", "flatbuffer", "ros1", "cbor"])
def test_an_mcap_file_of_other_messages_says_what_it_holds(
    encoding: str, summary: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "drives"
    source.mkdir()
    (source / "car.mcap").write_bytes(mcap("", {"/state": encoding, "/cones": encoding}, summary=summary))
    for path in (source / "car.mcap", source):
        said = refused(path, capsys)
        assert f"an MCAP file of {encoding} messages (profile '')" in said
        assert "/cones (car.Message2), /state (car.Message1)" in said
        assert "damaged" not in said and "--from jsonl" in said


def test_messages_of_several_encodings_are_all_named(tmp_path: Path) -> None:
    file = tmp_path / "car.mcap"
    file.write_bytes(mcap("ros2", {"/odom": "cdr", "/cones": "protobuf"}))
    assert "an MCAP file of cdr and protobuf messages (profile 'ros2'), not of ROS 2" in described(file)
    file.write_bytes(mcap("x", {f"/topic{k}": "json" for k in range(20)}))
    assert described(file).count("/topic") == 8 and described(file).endswith(", ...")
    file.write_bytes(mcap("x", {}))
    assert described(file) == "an MCAP file of no messages (profile 'x'), not of ROS 2: "


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_one_that_was_cut_off_is_told_as_that(share: float, tmp_path: Path) -> None:
    whole = mcap("", {"/state": "protobuf"})
    (tmp_path / "car.mcap").write_bytes(whole[: max(int(share * len(whole)), 12)])
    assert described(tmp_path / "car.mcap") == "an MCAP file that was cut off or is damaged"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (gzip.compress(b"#ROSBAG V2.0\n", mtime=0), "a file that gzip has compressed as a whole"),
        (b"\x28\xb5\x2f\xfd rest", "a file that zstd has compressed as a whole"),
        (b"ULog\x01\x12\x35\x01 rest", "a ULog of PX4"),
        (b"PK\x03\x04 rest", "a ZIP archive"),
        (b"SQLite format 3\x00 rest", "an SQLite database that is no bag"),
        (b"#ROSBAG V2.0\n", "a bag of ROS 1 that is damaged or was cut off"),
        (b"t,vx,vy,wz\n0,1,0,0\n", "a file of another kind"),
        (b"", "a file of another kind"),
    ],
)
def test_a_file_of_another_kind_is_named(
    content: bytes, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "drives").mkdir()
    assert "expected a bag, found none" in refused(tmp_path / "drives" / "drive.bag", capsys)
    assert described(tmp_path / "drives") == "an empty folder"
    for name in ("drive.bag", "drive.mcap", "drive.db3", "drive"):
        file = tmp_path / "drives" / name
        file.write_bytes(content)
        assert f"expected a ROS bag, found {said}" in refused(file, capsys)
        file.unlink()
