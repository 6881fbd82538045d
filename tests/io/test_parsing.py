"""Text files as plain data: what is nested too deep, too long, too large, or no data at all is refused."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pathspace_graph.errors import InputError
from pathspace_graph.io.parsing import (
    MAX_DEPTH,
    MAX_INTEGER,
    parse_json,
    parse_toml,
    parse_yaml,
    read_text,
    shown,
)

FILE = Path("file")


def test_the_limits_of_depth_and_of_whole_numbers_are_exact() -> None:
    for parse, text in ((parse_toml, "a = {}"), (parse_yaml, "{}")):
        deep = MAX_DEPTH - (parse is parse_toml)
        parse(text.format("[" * deep + "]" * deep), FILE)
        with pytest.raises(InputError, match=f"at most {MAX_DEPTH} deep"):
            parse(text.format("[" * (deep + 1) + "]" * (deep + 1)), FILE)
    assert parse_toml(f"a = {MAX_INTEGER}", FILE)
    with pytest.raises(InputError, match="whole numbers"):
        parse_toml(f"a = {MAX_INTEGER + 1}", FILE)


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        (parse_json, "[" * 1_000_000),
        (parse_json, '{\n"format": \n'),
        (parse_toml, "a = " + "[" * 100_000),
        (parse_toml, ".".join(["a"] * 3000) + " = 1"),
        (parse_yaml, "[" * 1_000_000),
        (parse_yaml, "\n".join("  " * k + "a:" for k in range(1000))),
        (parse_toml, "a = " + "9" * 5000),
        (parse_yaml, "a: " + "9" * 5000),
    ],
)
def test_what_no_parser_can_take_is_refused(parse: Callable[[str, Path], Any], text: str) -> None:
    with pytest.raises(InputError, match="expected"):
        parse(text, FILE)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: 2020-99-99", "expected YAML"),
        ("a: !!int x", "expected YAML"),
        ("a: !!bool x", "expected YAML"),
        ("a: !!python/object/apply:os.getcwd []", "could not determine a constructor"),
        ("a: &a {b: 1}\nc: {<<: *a}", "row 2: expected YAML: merge keys"),
        ("a: [1", "row 2"),
        ("a: \x00", "expected YAML"),
    ],
)
def test_yaml_that_does_not_fit_its_tags_is_refused(text: str, says: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_yaml(text, FILE)
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_is_regular_of_limited_size_and_text(tmp_path: Path) -> None:
    file = tmp_path / "f"
    with pytest.raises(InputError, match="expected a map, found none"):
        read_text(file, "a map")
    with pytest.raises(InputError, match="found a folder"):
        read_text(tmp_path)
    file.write_bytes(b"\xef\xbb\xbfab")
    assert read_text(file, most=5) == "ab"
    with pytest.raises(InputError, match="at most 4 bytes"):
        read_text(file, most=4)
    file.write_bytes(b"a\nb\xff")
    with pytest.raises(InputError, match="row 2: expected text in UTF-8"):
        read_text(file)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe"):
        read_text(tmp_path / "pipe")


def test_a_message_shows_what_was_found_in_short() -> None:
    laughs: list[Any] = ["lol"]
    for _ in range(30):
        laughs = [laughs] * 9
    for value in (laughs, "x" * 10**6, {k: k for k in range(9999)}, 10**3000):
        assert len(shown(value)) <= 120
    assert shown([1, "a", None]) == "[1, 'a', None]"
