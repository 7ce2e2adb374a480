# SPDX-License-Identifier: Apache-2.0
"""Versions of what determines the last digits of a result."""

from __future__ import annotations

from loopcal.engine.selection import get_current_engine


def collect_versions() -> dict[str, str]:
    """Return the versions of loopcal, numpy, scipy and Python, and the engine of this process."""
    import platform

    import numpy
    import scipy

    import loopcal

    # in place of importlib.metadata, whose import takes a third of the time of that of numpy
    versions = {package.__name__: package.__version__ for package in (loopcal, numpy, scipy)}
    return versions | {"python": platform.python_version(), "engine": str(get_current_engine())}
