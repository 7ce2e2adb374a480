# SPDX-License-Identifier: Apache-2.0
"""Axes stand where the constrained layout of matplotlib puts them, and are measured less often."""

from collections import Counter
from typing import Any
from unittest import mock

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from loopcal.report.figures.notebook_figure import FigureLayout
from loopcal.report.figures.style import add_legend, finish_figure, label_axes, label_poses


def _draw_everything(layout: ConstrainedLayoutEngine) -> Figure:
    """Draw long labels, a logarithm, equal scales, color bars, space, a legend and a title."""
    figure = Figure(figsize=(9.0, 8.0), layout=layout)
    grid = figure.add_gridspec(3, 3, height_ratios=[2, 3, 2])
    by_pose = figure.add_subplot(grid[0, :])
    by_pose.plot(np.arange(1, 31), np.logspace(-4, 2, 30), label="a series of errors")
    by_pose.set_yscale("log")
    label_axes(by_pose, "", "error [mm]", "by pose")
    label_poses(by_pose, [f"corner-{i}" for i in range(30)])
    panels = [figure.add_subplot(grid[1, i]) for i in range(2)]
    for i, axes in enumerate(panels):
        axes.scatter([0.0, 60.0], [0.0, 47.0 + i], c=[0.001, 0.002])
        axes.set_aspect("equal", adjustable="datalim")
        label_axes(axes, "x [mm]", "y [mm]", "slice")
    points = panels[0].collections[0]
    figure.colorbar(points, ax=panels, aspect=22, pad=0.02).ax.set_ylabel("uncertainty [mm]")
    figure.add_subplot(grid[1, 2], projection="3d").plot([0, 1], [0, 1], [0, 1])
    matrix = figure.add_subplot(grid[2, 0])
    matrix.imshow(np.eye(4))
    matrix.set_yticks(range(4), ["leg1.platform.x", "b", "c", "d"])
    right = figure.add_subplot(grid[2, 1])
    right.yaxis.tick_right()
    right.plot([0, 1], [-12345.0, 6789.0])
    add_legend(figure)
    return finish_figure(figure, "A title\nof two lines")


def _place(figure: Figure) -> np.ndarray:
    """Return the positions of all axes after the layout, as shares of the figure."""
    layout = figure.get_layout_engine()
    assert layout is not None
    layout.execute(figure)
    return np.array([axes.get_position(original=True).bounds for axes in figure.axes])


def test_axes_are_where_matplotlib_puts_them_but_are_measured_again_only_if_ticks_change() -> None:
    expected = _place(_draw_everything(ConstrainedLayoutEngine()))
    measured: Counter[Axes] = Counter()
    measure = Axes.get_tightbbox

    def count(axes: Axes, *args: Any, **options: Any) -> Any:
        measured[axes] += 1
        return measure(axes, *args, **options)

    figure = _draw_everything(FigureLayout())
    with mock.patch.object(Axes, "get_tightbbox", count):
        places = _place(figure)
    # 0.003 of 9 inches are 2 points: the box of labels moves by less when axes are resized
    np.testing.assert_allclose(places, expected, atol=0.003)
    by_pose, slice_of_map = figure.axes[:2]
    assert (measured[by_pose], measured[slice_of_map]) == (1, 2)


def test_a_figure_is_measured_anew_after_the_layout() -> None:
    figure = Figure(figsize=(4.0, 3.0), layout=FigureLayout())
    axes = figure.add_subplot()
    before = _place(figure)
    axes.set_ylabel("a label\nof three\nlines")
    assert _place(figure)[0, 0] > before[0, 0] + 0.05
    assert "get_tightbbox" not in vars(axes)
