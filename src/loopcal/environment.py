# SPDX-License-Identifier: Apache-2.0
"""The environment of a program: optional packages, and threads of linear algebra."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from loopcal.errors import LoopcalError, MissingPackageError
from loopcal.findings import report_finding

THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "GOTO_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
"""Variables by which libraries of linear algebra choose their threads, before numpy is imported.

One thread makes the last digits of results independent of the machine's settings. It is also the
fastest, because the matrices are small and threads wait for each other (5000 poses on two cores:
0.3 s with one thread, 5 s and more with two).
"""


@contextmanager
def use_one_thread() -> Iterator[None]:
    """Give processes that the body starts one thread of linear algebra each."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
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

    Raises
    ------
    MissingPackageError or `error` : it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as cause:
        finding = report_finding("workers.package-missing", package=module, extra=extra)
        raise error(finding) from cause
