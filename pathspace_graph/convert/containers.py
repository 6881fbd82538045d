"""What a file is that can't be read as a ROS bag, in words."""

import sqlite3
import struct
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final

MCAP: Final = b"\x89MCAP0\r\n"
SQLITE: Final = b"SQLite format 3\x00"
KINDS: Final = {  # kind of a file, by its first bytes
    b"#ROSBAG V2.0": "a bag of ROS 1 that is damaged or was cut off",
    b"#ROSBAG V1": "a bag of ROS 1 in its format 1, which is older than 2010",
    b"PK\x03\x04": "a ZIP archive",
    b"\x1f\x8b": "a file that gzip has compressed as a whole",
    b"\x28\xb5\x2f\xfd": "a file that zstd has compressed as a whole",
    b"\x04\x22\x4d\x18": "a file that lz4 has compressed as a whole",
    b"BZh": "a file that bzip2 has compressed as a whole",
    b"\xfd7zXZ\x00": "a file that xz has compressed as a whole",
    b"\x89HDF\r\n\x1a\n": "an HDF5 file, as MATLAB 7.3 and h5py write it",
    b"MATLAB 5.0": "a MATLAB file",
    b"ULog\x01\x12\x35": "a ULog of PX4",
    b"PAR1": "a Parquet file",
    b"ARROW1": "an Arrow file",
    b"\xd4\xc3\xb2\xa1": "a capture of network packets (pcap)",
    b"\x0a\x0d\x0d\x0a": "a capture of network packets (pcapng)",
}
READABLE: Final = (
    "read are bags of ROS 1 and ROS 2 (.bag, .db3, and .mcap of profile 'ros2'), CSV (--from csv) and "
    "JSON lines (--from jsonl)"
)
MOST_BEGIN: Final = 512  # number of bytes that tell what a file is
MOST_NAMED: Final = 8  # number of topics or tables that are named
MOST_RECORDS: Final = 10_000  # number of records of an MCAP file that are searched for its topics
FOOTER_BYTES: Final = 37  # of the last record of an MCAP file with what is around it
HEADER, FOOTER, SCHEMA, CHANNEL = 1, 2, 3, 4  # kinds of records of an MCAP file


def described(path: Path) -> str:
    """Say what a file or a folder holds."""
    if path.is_dir():
        return described_folder(path)
    with path.open("rb") as stream:
        begin = stream.read(MOST_BEGIN)
        if begin.startswith(MCAP):
            return described_mcap(stream)
    if begin.startswith(SQLITE):
        return described_database(path)
    known = next((kind for magic, kind in KINDS.items() if begin.startswith(magic)), "")
    return known or described_text(begin)


def described_folder(path: Path) -> str:
    if (path / "log.toml").exists():
        return "a log, which needs no conversion"
    files = sorted(file for file in path.iterdir() if file.is_file() and file.name != "metadata.yaml")
    if any(file.suffix == ".csv" for file in files):
        return "a folder of CSV files"
    return "; ".join(f"{file.name}, {described(file)}" for file in files[:MOST_NAMED]) or "an empty folder"


def described_text(begin: bytes) -> str:
    """Say which text begins so, or that it is none."""
    first = begin.decode("utf-8-sig", errors="replace").strip().split("\n")[0].strip()
    if not first:
        return "an empty file"
    if "\ufffd" in first or not first.replace("\t", " ").isprintable():
        return "a file of an unknown kind"
    return "text in JSON" if first.startswith(("{", "[")) else f"text that begins with '{first[:40]}'"


def described_mcap(stream: BinaryIO) -> str:
    """Say which messages an MCAP file holds, by the records of its summary."""
    stream.seek(max(stream.seek(0, 2) - FOOTER_BYTES, 0))
    end = stream.read()
    if len(end) < FOOTER_BYTES or not end.endswith(MCAP) or end[0] != FOOTER:
        return "an MCAP file that was cut off or is damaged"
    (summary,) = struct.unpack("<Q", end[9:17])
    stream.seek(len(MCAP))
    profile, schemas, topics = "", dict[int, tuple[str, str]](), dict[str, tuple[str, str]]()
    with suppress(struct.error, UnicodeDecodeError, IndexError):
        for number in range(MOST_RECORDS):
            kind, size = struct.unpack("<BQ", stream.read(9))
            if kind == FOOTER:
                break
            if kind not in (HEADER, SCHEMA, CHANNEL):
                stream.seek(size, 1)
                continue
            record = BytesIO(stream.read(size))
            if kind == HEADER:
                profile = _text(record)
            elif kind == SCHEMA:
                (key,) = struct.unpack("<H", record.read(2))
                schemas[key] = _text(record), _text(record)
            else:
                _, key = struct.unpack("<HH", record.read(4))
                topic, encoding = _text(record), _text(record)
                topics[topic] = encoding, schemas.get(key, ("no schema", ""))[0]
            if number == 0 and summary:
                stream.seek(summary)
    encodings = sorted({encoding or "no known" for encoding, _ in topics.values()})
    if not topics:
        return f"an MCAP file without topics (profile '{profile}')"
    if profile == "ros2" and encodings == ["cdr"]:
        return "an MCAP file of ROS 2 that is damaged"
    named = [f"{topic} ({schema})" for topic, (_, schema) in sorted(topics.items())]
    listed = ", ".join(named[:MOST_NAMED]) + ", ..." * (len(named) > MOST_NAMED)
    return f"an MCAP file of {' and '.join(encodings)} messages (profile '{profile}'), not of ROS 2: {listed}"


def _text(record: BytesIO) -> str:
    """Text of a record, after its length."""
    (size,) = struct.unpack("<I", record.read(4))
    return record.read(size).decode()


def described_database(path: Path) -> str:
    """Say which tables an SQLite database holds."""
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            rows = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
    except sqlite3.Error:
        return "an SQLite database that was cut off or is damaged"
    tables = sorted(name for (name,) in rows)
    if {"topics", "messages"} <= {*tables}:
        return "a bag of ROS 2 in SQLite that is damaged"
    return f"an SQLite database of no bag, with the tables {', '.join(tables[:MOST_NAMED]) or 'none'}"
