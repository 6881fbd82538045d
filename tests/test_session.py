"""What tests share is made once, by one of the workers, and none of them can change it for another one."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from .scenes import session
from .scenes.session import FOLDER, once

OTHER_WORKER = """
import runpy, sys
once = runpy.run_path(sys.argv[1])["once"]
print(once(lambda: "made again", "the key", 3))
"""


def test_another_worker_reads_what_was_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER, str(tmp_path))
    monkeypatch.setattr(session, "_known", {})
    made = once(lambda: ["made"], "the key", 3)
    assert once(lambda: ["made again"], "the key", 3) is made
    assert once(lambda: ["another"], "the key", 4) == ["another"]
    command = [sys.executable, "-c", OTHER_WORKER, session.__file__]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "['made']\n"


def test_what_could_not_be_made_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER, str(tmp_path))
    monkeypatch.setattr(session, "_known", {})
    with pytest.raises(ZeroDivisionError):
        once(lambda: 1 / 0, "the key")
    assert once(lambda: 1, "the key") == 1
    (file,) = (one for one in tmp_path.iterdir() if one.is_file())
    assert pickle.loads(file.read_bytes()) == 1
