# SPDX-License-Identifier: Apache-2.0
"""Build of loopcal-native: one shared library, called through ctypes, in one wheel for all Pythons.

The environment variable CXX chooses the compiler (GCC or Clang: the code uses their vector
extensions), CXXFLAGS adds options. No other tool is needed.
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

HERE = Path(__file__).resolve().parent
SOURCES = HERE / "cpp"
ENDING = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
LIBRARY = f"libloopcal{ENDING}"
OPTIONS = ("-std=c++17", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-exceptions")
OPTIONS += ("-fno-rtti", "-fvisibility=hidden", "-Wall", "-Wextra", "-Wno-psabi")
GCC_OPTIONS = ("-fno-tree-loop-distribute-patterns",)
"""GCC would copy vectors in pieces, which stall the loads of whole ones."""
AVX512 = "f bw cd dq vl"
SETS = {
    "x86": {
        "baseline": (2, ()),
        "v3": (4, ("-mavx2",)),
        "v4": (8, ("-mavx2", *(f"-mavx512{part}" for part in AVX512.split()))),
    },
    "other": {"baseline": (2, ())},
}
"""Instruction sets by processor: lanes of a vector, options. A line is all that a set needs."""


def find_compiler() -> list[str]:
    """Return the words that call a C++ compiler."""
    if os.environ.get("CXX"):
        return shlex.split(os.environ["CXX"])
    names = ("clang++", "g++") if sys.platform == "win32" else ("g++", "clang++", "c++")
    found = next((name for name in names if shutil.which(name)), None)
    if found is None:
        sys.exit("loopcal-native needs GCC or Clang; install one, or name it in CXX.")
    return [found]


def compile_library(target: Path, work: Path) -> None:
    """Compile the library; every instruction set by a call of its own."""
    is_x86 = platform.machine().lower() in ("x86_64", "amd64")
    sets = SETS["x86" if is_x86 else "other"]
    compiler = find_compiler()
    about = subprocess.run([*compiler, "--version"], check=True, capture_output=True, text=True)
    compiler += OPTIONS if "clang" in about.stdout else (*OPTIONS, *GCC_OPTIONS)
    compiler += shlex.split(os.environ.get("CXXFLAGS", ""))
    if sys.platform != "win32":
        compiler.append("-fPIC")
    work.mkdir(parents=True, exist_ok=True)
    target.parent.mkdir(parents=True, exist_ok=True)
    objects, calls = [], []
    for name, (lanes, options) in sets.items():
        words = [f"-DINSTRUCTION_SET={name}", f"-DLANES={lanes}", *options]
        calls.append((name, "kernels.cpp", words))
    calls.append(("dispatch", "dispatch.cpp", [f"-DWITH_{name.upper()}" for name in sets]))
    for name, source, words in calls:
        objects.append(str(work / f"{name}.o"))
        subprocess.run(
            [*compiler, *words, "-c", str(SOURCES / source), "-o", objects[-1]], check=True
        )
    subprocess.run([*compiler, "-shared", *objects, "-o", str(target)], check=True)


class BuildWithLibrary(build_py):
    """Copy the Python files and compile the library beside them."""

    def run(self) -> None:
        """Build."""
        super().run()
        folder = HERE / "src" if self.editable_mode else Path(self.build_lib)
        work = Path(self.get_finalized_command("build").build_temp)
        compile_library(folder / "loopcal_native" / LIBRARY, work)


class Wheel(bdist_wheel):
    """A wheel for one platform and every Python."""

    def finalize_options(self) -> None:
        """Note that the wheel belongs to a platform."""
        super().finalize_options()
        self.root_is_pure = False

    def get_tag(self) -> tuple[str, str, str]:
        """Return the tag: any Python 3, no binary interface of Python, this platform."""
        return "py3", "none", super().get_tag()[2]


class PlatformDistribution(Distribution):
    """A distribution with compiled content."""

    def has_ext_modules(self) -> bool:
        """Return that it has one."""
        return True


if __name__ == "__main__":
    setup(
        distclass=PlatformDistribution,
        cmdclass={"build_py": BuildWithLibrary, "bdist_wheel": Wheel},
    )
