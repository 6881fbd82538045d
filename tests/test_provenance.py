"""What made a result: the commit that is checked out, or the version that is installed."""

from __future__ import annotations

import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest

from pathspace_graph.io import results as provenance


def git(folder: Path, *words: str) -> str:
    names = ("-c", "user.name=a", "-c", "user.email=a@b")
    done = subprocess.run(["git", "-C", folder, *names, *words], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_a_commit_is_that_of_the_folder_and_says_where_something_differs(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("1")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "a.py")
    git(tmp_path, "commit", "-q", "-m", "one")
    commit = git(tmp_path, "rev-parse", "HEAD")
    assert commit.startswith(provenance.commit_of(tmp_path))
    provenance.commit_of.cache_clear()
    (tmp_path / "a.py").write_text("2")
    found = provenance.commit_of(tmp_path)
    assert found.endswith("+") and commit.startswith(found[:-1])


@pytest.mark.parametrize("folder", ["lib/site-packages/pathspace_graph", "pathspace_graph"])
def test_what_is_installed_has_a_version_even_inside_a_repository(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / folder / "io" / "results.py"))
    monkeypatch.setattr(provenance, "commit_of", lambda at: "abc" if "lib" in at.parts else "")
    assert provenance.made()["commit"] == f"version {version('pathspace-graph')}"
