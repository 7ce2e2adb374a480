# SPDX-License-Identifier: Apache-2.0
"""Versions of what determines the last digits of a result."""

from __future__ import annotations

from loopcal.engine.selection import get_current_engine


def collect_versions() -> dict[str, str]:
    """Return the versions of loopcal, numpy, scipy and Python, and the engine of this process."""
    import platform
    from importlib.metadata import version

    versions = {name: version(name) for name in ("loopcal", "numpy", "scipy")}
    return versions | {"python": platform.python_version(), "engine": str(get_current_engine())}
