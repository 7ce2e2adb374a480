# SPDX-License-Identifier: Apache-2.0
"""Packages that only some studies need, imported when they are used."""

from __future__ import annotations

from typing import Any

from loopcal import optional_packages
from loopcal.errors import StudyError


def import_optional(module: str, extra: str) -> Any:
    """Return a module of an optional package, see `loopcal.optional_packages.import_optional`.

    Raises
    ------
    StudyError : it is not installed.
    """
    return optional_packages.import_optional(module, extra, StudyError)
