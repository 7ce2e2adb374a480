# SPDX-License-Identifier: Apache-2.0
"""Geometric calibration of robots with closed kinematic loops.

The public API is what `__init__.pyi` lists; every other module may change. A name is imported when
it is first used, so that `import loopcal` costs nothing. docs/api.md lists the names with their
purpose.
"""

import sys
from types import FunctionType
from typing import Any

import lazy_loader

from loopcal.results.presenters import name_presenters
from loopcal.version import __version__ as __version__

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Import a public name; a function then also names wrong arguments."""
    value = _load(name)
    if isinstance(value, FunctionType) and not hasattr(value, "__wrapped__"):
        from loopcal.measure.array_checks import name_wrong_arguments

        package = sys.modules[__name__]
        value = name_wrong_arguments(value, package)
        value.__module__ = __name__  # where pickle finds it
        setattr(package, name, value)
    return value


name_presenters(
    page=["loopcal.report.calibration_view", "loopcal.report.validation_view"],
    figure=[
        f"loopcal.report.{module}"
        for module in ("figures.fit_figures", "figures.result_figures", "scene.scene")
    ],
)
