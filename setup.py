"""The compiled kernels, and where the project is published; everything else is in pyproject.toml.

Where no C++ compiler is found, the package `ziglang` is one, which pip installs for the build alone.
"""

import os
import re
import shlex
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path
from sysconfig import get_config_var

from pybind11.setup_helpers import ParallelCompile, Pybind11Extension, build_ext
from setuptools import setup

NO_COMPILER = "expected a C++ compiler for the kernels, found none: install g++, or pip install ziglang"


def has_compiler() -> bool:
    """Return whether there is the C++ compiler that setuptools calls; on Windows it looks for one itself."""
    command = shlex.split(os.environ.get("CXX") or get_config_var("CXX") or "c++")
    return sys.platform == "win32" or shutil.which(command[0]) is not None


class BuildKernels(build_ext):
    """Builds with ziglang where there is no compiler."""

    def build_extension(self, ext: Pybind11Extension) -> None:
        if has_compiler():
            super().build_extension(ext)
            return
        if find_spec("ziglang") is None:
            sys.exit(NO_COMPILER)
        target = Path(self.get_ext_fullpath(ext.name))
        target.parent.mkdir(parents=True, exist_ok=True)
        flags = ["-shared", "-fPIC", *ext.extra_compile_args]
        if sys.platform == "darwin":
            flags += ["-undefined", "dynamic_lookup"]
        flags += [f"-I{folder}" for folder in (*ext.include_dirs, *self.include_dirs)]
        self.spawn([sys.executable, "-m", "ziglang", "c++", *flags, *ext.sources, "-o", str(target)])


def readme(repository: str) -> str:
    """Return the README, whose links lead to the repository (a URL) where one publishes it."""
    text = Path("README.md").read_text(encoding="utf-8")
    if repository:
        text = re.sub(r"(!\[[^]]*\]\()(?!http)", rf"\1{repository}/raw/HEAD/", text)
        text = re.sub(r"(\]\()(?!http|#)", rf"\1{repository}/blob/HEAD/", text)
    return text


FOLDER = Path("pathspace_graph/factors/kernels")
KERNELS = Pybind11Extension(
    "pathspace_graph.factors._kernels",
    sorted(map(str, FOLDER.glob("*.cpp"))),
    depends=sorted(map(str, FOLDER.glob("*.hpp"))),
    cxx_std=17,
    extra_compile_args=["-O3", "-ffp-contract=off"],
)

REPOSITORY = os.environ.get("REPOSITORY_URL", "")  # set by the workflows
URLS = {"Source": "", "Issues": "/issues", "Changelog": "/blob/HEAD/CHANGELOG.md"}

ParallelCompile().install()
setup(
    long_description=readme(REPOSITORY),
    long_description_content_type="text/markdown",
    project_urls={name: REPOSITORY + path for name, path in URLS.items() if REPOSITORY},
    ext_modules=[KERNELS],
    cmdclass={"build_ext": BuildKernels},
    setup_requires=[] if has_compiler() else ["ziglang>=0.13"],
)
