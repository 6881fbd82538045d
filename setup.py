"""The compiled kernels; everything else is in pyproject.toml."""

from pybind11.setup_helpers import Pybind11Extension
from setuptools import setup

KERNELS = Pybind11Extension(
    "pathspace_graph.factors._kernels",
    ["pathspace_graph/factors/kernels.cpp"],
    cxx_std=17,
    extra_compile_args=["-O3", "-ffp-contract=off"],
)
KERNELS.optional = True  # without a compiler the functions in numpy run

setup(ext_modules=[KERNELS])
