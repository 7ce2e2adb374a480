# SPDX-License-Identifier: Apache-2.0
"""The environment of a program: optional packages, and settings of libraries."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from loopcal.errors import LoopcalError, MissingPackageError

# Variables by which libraries of linear algebra choose their threads, before numpy is imported. One
# thread makes the last digits of results independent of the machine's settings. It is also the
# fastest, because the matrices are small and threads wait for each other (5000 poses on two cores:
# 0.3 s with one thread, 5 s and more with two).
THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "GOTO_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


# Variables of this process and of those that it starts, and their values. Without the last two,
# Python imports modules from the current folder where it runs a module, as workers do, and Windows
# looks for programs there.
PINNED = dict.fromkeys(THREADS, "1") | {
    "PYTHONSAFEPATH": "1",
    "NoDefaultCurrentDirectoryInExePath": "1",
}

# Beginnings of the names of variables at which numpy and matplotlib fail, or print something.
REMOVED = ("MPLBACKEND", "NPY_PROMOTION_STATE", "NUMPY_", "OPENBLAS_VERBOSE", "SOURCE_DATE_EPOCH")


def pin_settings() -> None:
    """Let libraries of this process read settings from nowhere but their own packages.

    Variables are pinned or removed. matplotlib looks for `matplotlibrc` in the current folder
    first, then at MATPLOTLIBRC, then in the folder of the user: it gets its own file. Where the
    current folder has such a file, matplotlib is imported in another one.
    """
    os.environ.update(PINNED)
    for name in [name for name in os.environ if name.startswith(REMOVED)]:
        del os.environ[name]
    # what matplotlib says about a folder for its list of fonts is not the user's concern
    logging.getLogger("matplotlib").addHandler(logging.NullHandler())
    package = find_spec("matplotlib")
    if package is None or package.origin is None:
        return
    defaults = Path(package.origin).with_name("mpl-data")
    os.environ["MATPLOTLIBRC"] = str(defaults)
    if os.path.lexists("matplotlibrc") and "matplotlib" not in sys.modules:
        folder = Path.cwd()
        os.chdir(defaults)
        import_module("matplotlib")
        os.chdir(folder)


@contextmanager
def pin_processes() -> Iterator[None]:
    """Give processes that the body starts the pinned variables."""
    before = {name: os.environ.get(name) for name in PINNED}
    os.environ.update(PINNED)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def import_optional(
    module: str, extra: str, error: type[LoopcalError] = MissingPackageError
) -> Any:
    """Return a module of an optional package, which the extra of this name installs.

    MissingPackageError or `error` : it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as cause:
        raise error.of("workers.package-missing", package=module, extra=extra) from cause
