# SPDX-License-Identifier: Apache-2.0
"""How results are shown in notebooks: as HTML, as tables of pandas and xarray, and as figures.

A result inherits from a class of this module. The code that writes and draws is in `loopcal.report`
and is imported when it is first used, so that results depend on no package for tables or figures.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw(name: str, *arguments: object) -> Figure:
    """Return the figure that `module.function` of `loopcal.report.figures` draws."""
    module, _, function = name.partition(".")
    return getattr(import_module(f"loopcal.report.figures.{module}"), function)(*arguments)


class HtmlResult:
    """Base of results that notebooks show as text and tables."""

    def _repr_html_(self) -> str:
        """Return the result as HTML, with at most some 30 rows of each table."""
        return import_module("loopcal.report.notebook").render_result(self)


class TableResult(HtmlResult):
    """Base of results with numbers for pandas and xarray."""

    def to_frame(self) -> Any:
        """Return the main table as a pandas DataFrame; headings state the units.

        Raises
        ------
        MissingPackageError : pandas is not installed.
        """
        return import_module("loopcal.report.notebook").build_frame(self)

    def to_dataset(self) -> Any:
        """Return the arrays as an xarray Dataset; the attribute `units` of each states its unit.

        Raises
        ------
        MissingPackageError : xarray is not installed.
        """
        return import_module("loopcal.report.notebook").build_dataset(self)


class FitFigures:
    """The figures of a fit.

    Parameters
    ----------
    fit : an `Identification`.
    """

    def __init__(self, fit: object) -> None:
        self._fit = fit

    def __repr__(self) -> str:
        return "<FitFigures: residuals(), parameters(), correlation(), convergence()>"

    def residuals(self) -> Figure:
        """Draw the residuals by pose and component, as histogram and normal plot, and against
        actuator readings, time and temperatures.
        """
        return draw("fit_figures.draw_residuals", self._fit)

    def parameters(self) -> Figure:
        """Draw the shift of each parameter in tolerances with its 95 % interval."""
        return draw("fit_figures.draw_parameters", self._fit)

    def correlation(self) -> Figure:
        """Draw the correlations of the parameters as a matrix of colors."""
        return draw("fit_figures.draw_correlation", self._fit)

    def convergence(self) -> Figure:
        """Draw the sum of squares and the parameters by step of the iteration."""
        return draw("fit_figures.draw_convergence", self._fit)
