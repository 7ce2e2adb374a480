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
from concurrent.futures import ThreadPoolExecutor
from functools import partial
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
LINK_OPTIONS = {"linux": ("-Wl,--strip-all", "-Wl,-z,relro,-z,now"), "darwin": ("-Wl,-x",)}
"""No symbols but those of the interface, so that the library names no file of the build machine."""
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
    # GCC for Windows puts vectors of 32 bytes at addresses of 16 on the stack (its bug 54412)
    names = ("clang++",) if sys.platform == "win32" else ("g++", "clang++", "c++")
    found = next((name for name in names if shutil.which(name)), None)
    if found is None:
        sys.exit(f"loopcal-native needs one of {', '.join(names)}; install it, or name one in CXX.")
    return [found]


def compile_library(target: Path, work: Path) -> None:
    """Compile the library; every instruction set by a call of its own."""
    sets = SETS["x86" if build_machine() in ("x86_64", "amd64") else "other"]
    compiler = find_compiler()
    about = subprocess.run([*compiler, "--version"], check=True, capture_output=True, text=True)
    compiler += OPTIONS if "clang" in about.stdout else (*OPTIONS, *GCC_OPTIONS)
    compiler += [*list_architecture(), *shlex.split(os.environ.get("CXXFLAGS", ""))]
    if sys.platform != "win32":
        compiler.append("-fPIC")
    work.mkdir(parents=True, exist_ok=True)
    target.parent.mkdir(parents=True, exist_ok=True)
    calls = [("dispatch", "dispatch.cpp", [f"-DWITH_{name.upper()}" for name in sets])]
    for name, (lanes, options) in sets.items():
        words = [f"-DINSTRUCTION_SET={name}", f"-DLANES={lanes}", *options]
        calls.append((name, "kernels.cpp", words))
    run = partial(subprocess.run, check=True, cwd=SOURCES)  # relative names: no path gets inside
    objects = [str((work / f"{name}.o").resolve()) for name, _, _ in calls]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        pairs = zip(calls, objects, strict=True)
        words = [[*compiler, *own, "-c", file, "-o", out] for (_, file, own), out in pairs]
        list(pool.map(run, words))
    link = () if os.environ.get("CXXFLAGS") else LINK_OPTIONS.get(sys.platform, ())
    run([*compiler, "-shared", *objects, *link, "-o", str(target.resolve())])


def list_architecture() -> list[str]:
    """Return the options that name the processor to build for, where it may be another one."""
    # on macOS cibuildwheel sets ARCHFLAGS="-arch x86_64" also on a machine with an ARM processor
    return shlex.split(os.environ.get("ARCHFLAGS", "")) if sys.platform == "darwin" else []


def build_machine() -> str:
    """Return the name of the processor to build for."""
    return (list_architecture() or [platform.machine()])[-1].lower()


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
