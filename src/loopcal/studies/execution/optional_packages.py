# SPDX-License-Identifier: Apache-2.0
"""Packages that only some users need, imported when they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from loopcal.errors import StudyError
from loopcal.findings import report_finding


def import_optional(module: str, extra: str) -> Any:
    """Return a module of an optional package.

    Parameters
    ----------
    module : its name. extra : of loopcal, which installs the package.

    Raises
    ------
    StudyError : it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        finding = report_finding("workers.package-missing", package=module, extra=extra)
        raise StudyError(finding) from error
