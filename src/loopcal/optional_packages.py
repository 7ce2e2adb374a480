# SPDX-License-Identifier: Apache-2.0
"""Packages that only some users need, imported when they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from loopcal.errors import LoopcalError, MissingPackageError
from loopcal.findings import report_finding


def import_optional(
    module: str, extra: str, error: type[LoopcalError] = MissingPackageError
) -> Any:
    """Return a module of an optional package.

    Parameters
    ----------
    module : its name. extra : of loopcal, which installs the package. error : what to raise.

    Raises
    ------
    MissingPackageError or `error` : it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as cause:
        finding = report_finding("workers.package-missing", package=module, extra=extra)
        raise error(finding) from cause
