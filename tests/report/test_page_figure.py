# SPDX-License-Identifier: Apache-2.0
"""Figures of pages show what figures of matplotlib show, at the place of its value."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text

import loopcal as lc
from loopcal.apply.conformity import Decision
from loopcal.report.figures.page_figure import (
    MINUS,
    PageFigure,
    choose_ticks,
    measure_text,
    word_ticks,
)
from loopcal.report.figures.result_figures import _draw_decision, draw_budget_sources
from loopcal.report.figures.robot_figure import draw_robot
from loopcal.report.figures.style import (
    COLORS,
    add_colorbar,
    add_legend,
    drawing_for_page,
    finish_figure,
    label_axes,
    label_poses,
    label_rows,
    make_handle,
    make_patch,
    scale_logarithmically,
    start_panels,
)
from loopcal.units import DISPLAY_UNITS, Dimension


def draw_everything() -> Any:
    """Draw what figures of documents contain, with words that occur once."""
    figure, panels = start_panels(9.0, 7.0, 2, 2, height_ratios=[2, 1])
    first, second, third, fourth = panels.ravel()
    first.plot([1, 2, 3], [1.0, 20.0, 300.0], "o-", color=COLORS[0])
    first.axhline(30.0, color="0.5", ls="--")
    scale_logarithmically(first.yaxis)
    label_axes(first, "", "error [um]", "by pose")
    label_poses(first, ["one", "two <b>", "three"])
    second.errorbar([0.0, 1.0], [0, 1], xerr=[0.5, 0.25], fmt="o", color=COLORS[1], capsize=2.0)
    second.axvspan(-1.0, 1.0, color="0.75", alpha=0.3, lw=0.0)
    label_rows(second, ["leg1.base.x", "leg1.base.y"])
    label_axes(second, "shift [tolerance]", "", "shift")
    points = third.scatter([0.0, 2.0], [0.0, 1.0], c=[1.0, 3.0], s=20.0, cmap="viridis")
    third.set_aspect("equal", adjustable="datalim")
    add_colorbar(figure, points, third, "uncertainty [mm]")
    fourth.hist([0.1, 0.2, 0.4], [0.0, 0.25, 0.5], density=True, color=COLORS[5], ec="white")
    fourth.bar([0.1], [2.0], 0.1, color=COLORS[2])
    fourth.annotate("note", (0.1, 2.0), (0, 2), textcoords="offset points", ha="center")
    label_axes(fourth, "size [1]", "density [1]", "histogram")
    add_legend(
        figure, [make_handle("series", color=COLORS[0], marker="o"), make_patch("area", "0.5")]
    )
    return finish_figure(figure, "A title\nof two lines")


def read_texts(figure: Any) -> set[str]:
    """Return the visible texts of a figure of either kind."""
    if isinstance(figure, PageFigure):
        return {element.text or "" for element in ET.fromstring(figure.write_svg("f")).iter("text")}
    figure.draw_without_rendering()
    shown = [t.get_text() for t in figure.findobj(Text) if isinstance(t, Text) if t.get_visible()]
    return {line for text in shown for line in text.split("\n")} - {""}


def for_page(draw: Any, *arguments: Any) -> Any:
    with drawing_for_page():
        return draw(*arguments)


def is_number(text: str) -> bool:
    return re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?", text.replace(MINUS, "-")) is not None


def test_words_are_those_of_matplotlib() -> None:
    words = [
        {text for text in read_texts(figure) if not is_number(text)}
        for figure in (for_page(draw_everything), draw_everything())
    ]
    assert words[0] == words[1]
    assert "two <b>" in words[0]


@pytest.mark.parametrize("name", ["hexapod-42", "five-bar", "linear-delta"])
def test_a_robot_has_the_words_of_matplotlib(name) -> None:
    robot = lc.load_robot(name)
    drawn = [read_texts(figure) for figure in (for_page(draw_robot, robot), draw_robot(robot))]
    words = [{text.strip() for text in texts if not is_number(text)} for texts in drawn]
    assert words[0] == words[1]


def write(figure: Any) -> str:
    return figure.write_svg("f")


def read_dots(svg: str, color: str) -> np.ndarray:
    """Return the places of round markers of a color [pt]."""
    (path,) = re.findall(rf'<path d="([^"]*)" stroke="{color}"[^>]*linecap="round"', svg)
    return np.array(re.findall(r"M([\d.]+) ([\d.]+)h", path), dtype=float)


@pytest.mark.parametrize("is_logarithmic", [False, True])
def test_markers_are_at_their_values(is_logarithmic) -> None:
    x, y = np.array([0.0, 5.0, 10.0]), np.array([1.0, 10.0, 100.0])
    with drawing_for_page():
        figure, ((axes,),) = start_panels(5.0, 4.0, 1, 1)
        axes.plot(x, y, "o", color="#123456")
        if is_logarithmic:
            scale_logarithmically(axes.yaxis)
        axes.set_xlim(-10.0, 10.0)
        axes.set_ylim(100.0, 1.0)  # upside down
    dots = read_dots(write(figure), "#123456")
    left, top, width, height = axes.box
    up = np.log10(y) / 2.0 if is_logarithmic else (y - 1.0) / 99.0
    np.testing.assert_allclose(dots[:, 0], left + width * (x + 10.0) / 20.0, atol=0.01)
    np.testing.assert_allclose(dots[:, 1], top + height * up, atol=0.01)


def test_equal_scales_have_equal_lengths() -> None:
    with drawing_for_page():
        figure, ((axes,),) = start_panels(6.0, 3.0, 1, 1)
        axes.plot([0.0, 1.0], [0.0, 1.0], "o", color="#123456")
        axes.set_aspect("equal", adjustable="datalim")
    (a, b) = read_dots(write(figure), "#123456")
    assert b[0] - a[0] == pytest.approx(a[1] - b[1], abs=0.02)


def test_words_stay_inside_of_the_figure() -> None:
    figure = for_page(draw_everything)
    width, height = (72.0 * inches for inches in figure.get_size_inches())
    for element in ET.fromstring(figure.write_svg("f")).iter("text"):
        x, y, size = (float(element.get(key, "0")) for key in ("x", "y", "font-size"))
        long = measure_text(element.text or "", size)
        left = x - {"middle": 0.5, "end": 1.0}.get(element.get("text-anchor", ""), 0.0) * long
        if element.get("transform") is None:
            assert left >= 0.0
            assert left + long <= width
        assert 0.0 <= y <= height


@pytest.mark.parametrize(
    ("low", "high", "most", "expected"),
    [
        (0.0, 1.0, 5, ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]),
        (-3.1, 2.9, 6, ["-3", "-2", "-1", "0", "1", "2"]),
        (0.0, 0.0013, 5, ["0.0000", "0.0005", "0.0010"]),
        (1e6, 3e6, 2, ["1e+06", "2e+06", "3e+06"]),
        (2.0, 2.0, 5, ["2"]),
    ],
)
def test_numbers_at_axes_are_round(low, high, most, expected) -> None:
    assert [
        text.replace(MINUS, "-") for text in word_ticks(choose_ticks(low, high, most))
    ] == expected


def test_decision_and_budget_are_drawn_for_pages() -> None:
    numbers = {"low": 1e-6, "estimate": 2e-6, "high": 3e-6, "limit": 4e-6}
    ends = SimpleNamespace(
        **numbers, acceptance_limit=3.5e-6, rejection_limit=5e-6, decision=Decision.CONFORMS
    )
    with drawing_for_page():
        figure, ((axes,),) = start_panels(6.0, 2.0, 1, 1)
        conformity: Any = ends
        _draw_decision(axes, "position", conformity, DISPLAY_UNITS[Dimension.LENGTH])
    assert {"conforms", "undecided"} <= read_texts(figure)
    line = {"words": "instrument", "position": 4e-12, "orientation": 0.0, "halved": None}
    budget = {"position": {"rms": 2e-6}, "orientation": {"rms": 0.0}, "sources": [line]}
    shown = read_texts(for_page(draw_budget_sources, {**budget, "over": "workspace", "poses": 9}))
    assert {"instrument", "position: 2 um in all"} <= shown


def test_what_has_no_number_is_left_out() -> None:
    nothing, holes = np.zeros(0), np.array([np.nan, 1.0, np.inf])
    with drawing_for_page():
        figure, ((empty, full),) = start_panels(6.0, 3.0, 1, 2)
        empty.plot(nothing, nothing, "o")
        empty.axhline(0.0)
        scale_logarithmically(empty.yaxis)
        full.plot(holes, holes, "o-", color="#123456")
        full.bar([0.0, 1.0], [np.nan, 2.0], color="#654321")
        full.errorbar(holes[:2], [0.0, 1.0], xerr=holes[:2], fmt="s", color="#123456")
        full.annotate("nowhere", (np.nan, 1.0))
    svg = write(figure)
    ET.fromstring(svg)
    assert re.search("nan|inf|nowhere", svg) is None
    assert len(read_dots(svg, "#123456")) == 1
    assert svg.count('fill="#654321"') == 1


def test_many_markers_are_short() -> None:
    x = np.random.default_rng(0).uniform(size=(2, 20_000))
    with drawing_for_page():
        figure, ((axes,),) = start_panels(6.0, 4.0, 1, 1)
        axes.plot(*x, "^", color="#123456")
    assert len(write(figure)) < 20 * x.shape[1]
