"""Where, when and by which commit a result was made."""

import platform
import re
import shutil
import subprocess
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path

from threadpoolctl import threadpool_info


def made() -> dict[str, str]:
    """Commit, or version outside a repository, machine and date of what this package makes now."""
    folder, named = Path(__file__).parent, machine()
    installed = {"site-packages", "dist-packages"} & {*folder.parts}  # a repository around it is another one
    commit = "" if installed else commit_of(folder)
    parts = (named["host"], named["processor"], named["blas"])
    commit = commit or f"version {version('pathspace-graph')}"
    return {"commit": commit, "machine": ", ".join(filter(None, parts)), "date": now()}


def now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


@cache
def machine() -> dict[str, str]:
    """Host, processor, and the kernels that BLAS has chosen for it."""
    file, blas = Path("/proc/cpuinfo"), {pool.get("architecture") for pool in threadpool_info()}
    model = re.search(r"model name\s*: (.*)", file.read_text()) if file.exists() else None
    processor = model[1] if model else platform.processor() or platform.machine()
    return {"host": platform.node(), "processor": processor, "blas": " ".join(sorted(filter(None, blas)))}


@cache
def commit_of(folder: Path | None) -> str:
    """Short hash of the commit that is checked out, with `+` where something differs from it.

    It is empty where there is none.
    """
    git = shutil.which("git")
    if git is None or folder is None:
        return ""
    command = [git, "-C", str(folder), "describe", "--always", "--dirty=+", "--exclude=*"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
