# SPDX-License-Identifier: Apache-2.0
"""A matplotlib figure that notebooks show, also where pyplot was never imported."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure  # noqa: TID253  # only functions that draw import this module
from matplotlib.layout_engine import ConstrainedLayoutEngine  # noqa: TID253  # only functions that draw import this module
from matplotlib.transforms import Bbox  # noqa: TID253  # only functions that draw import this module

from loopcal.report.pictures import render_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class FigureLayout(ConstrainedLayoutEngine):
    """The constrained layout of matplotlib in half of the time.

    matplotlib measures all labels, places the axes, and repeats both, because axes of another size
    can have other ticks. Here the second time measures only axes whose ticks have changed.
    """

    def execute(self, fig: Figure) -> Any:
        """Place the axes of a figure."""
        with _remembered_margins(fig.axes):
            return super().execute(fig)


@contextmanager
def _remembered_margins(all_axes: list[Axes]) -> Iterator[None]:
    """Let axes answer with the margins that were measured, as long as their ticks are the same.

    Always measured are color bars, axes in space, and axes with a fixed aspect, whose limits change
    with their size.
    """
    free = [
        axes
        for axes in all_axes
        if axes.name == "rectilinear"
        and axes.get_aspect() == "auto"
        and axes.get_axes_locator() is None
    ]
    for axes in free:
        remembering = partial(_measure, axes, axes.get_tightbbox, {})
        setattr(axes, "get_tightbbox", remembering)  # noqa: B010  # a method of this one object
    try:
        yield
    finally:
        for axes in free:
            delattr(axes, "get_tightbbox")


def _measure(
    axes: Axes,
    measure: Callable[..., Bbox | None],
    known: dict[tuple[float | None, ...], Any],
    renderer: Any = None,
    **options: Any,
) -> Bbox | None:
    """Return the box around axes and their labels [pixels].

    measure : the method of matplotlib. known : the margins by positions of ticks; gets new ones.
    renderer, options : of `measure`.
    """
    ticks = (*axes.xaxis.get_majorticklocs(), None, *axes.yaxis.get_majorticklocs())
    figure = axes.get_figure()
    assert figure is not None
    box = axes.get_position(original=True).transformed(figure.transSubfigure)
    place = np.asarray(box.extents)
    if ticks not in known:
        measured = measure(renderer, **options)
        known[ticks] = None if measured is None else np.asarray(measured.extents) - place
    margins = known[ticks]
    return None if margins is None else Bbox.from_extents(*(place + margins))


PIXELS = 96  # pixels of an inch on a page


class NotebookFigure(Figure):
    """A figure that is shown as a picture where it is the result of a cell."""

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        """Return the picture, and its size on the page [pixels]."""
        width, height = (round(PIXELS * float(inches)) for inches in self.get_size_inches())
        return render_figure(self, ".png"), {"width": width, "height": height}
