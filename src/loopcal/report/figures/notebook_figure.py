# SPDX-License-Identifier: Apache-2.0
"""A matplotlib figure that notebooks show, also where pyplot was never imported."""

from __future__ import annotations

from matplotlib.figure import Figure  # noqa: TID253  # only functions that draw import this module

from loopcal.report.pictures import render_figure

PIXELS = 96
"""Pixels of an inch on a page."""


class NotebookFigure(Figure):
    """A figure that is shown as a picture where it is the result of a cell."""

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        """Return the picture, and its size on the page [pixels]."""
        width, height = (round(PIXELS * float(inches)) for inches in self.get_size_inches())
        return render_figure(self, ".png"), {"width": width, "height": height}
