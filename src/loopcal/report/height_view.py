# SPDX-License-Identifier: Apache-2.0
"""Errors of measured heights, as tables."""

from __future__ import annotations

import numpy as np

from loopcal.apply import HeightErrors
from loopcal.findings.wording import count_decimals
from loopcal.report.numbers import format_in
from loopcal.report.tables import Column, Table, build_table, word_column
from loopcal.report.text_page import Block

MOST_POINTS, MOST_LINES = 200, 25
"""Points that a table lists, and up to which the page of a calibration has this table."""


def build_height_summary(heights: HeightErrors) -> Table:
    """Return rms and largest error of the fitted and of the held-out heights."""
    unit = heights.unit
    rows = []
    for name, is_held_out in heights.list_sets():
        before, after = (heights.statistics(e, is_held_out) for e in ("before", "after"))
        for metric, key in (("rms", "rms"), ("largest", "max")):
            shown = (format_in(unit, getattr(s, key), 3) for s in (before, after))
            rows.append((name, metric, str(after.count), *shown, unit.symbol))
    columns = (word_column("points"), word_column("metric"))
    numbers = (Column("count"), Column("before"), Column("after"))
    caption = "Height errors (predicted - measured)"
    return Table(caption, (*columns, *numbers, word_column("unit")), tuple(rows))


def build_height_map(heights: HeightErrors) -> Table | str:
    """Return the error of each height with its place; of many heights a sentence."""
    unit, count = heights.unit, len(heights.poses)
    if count > MOST_POINTS:
        return f"The errors of {count:,} heights are too many for a table."

    def place(value: float) -> str:
        """Return a coordinate; 0.0 in place of -0.0."""
        return f"{round(value / unit.factor_to_si, 1) + 0.0:.1f}"

    rows = zip(
        heights.poses, heights.points, heights.before, heights.after, heights.is_held_out,
        strict=True,
    )  # fmt: skip
    return build_table(
        "Height errors by point (predicted - measured); x, y in the base frame",
        rows,
        (word_column("pose"), lambda row: row[0]),
        (Column("x", unit.symbol), lambda row: place(row[1][0])),
        (Column("y", unit.symbol), lambda row: place(row[1][1])),
        (Column("before", unit.symbol), lambda row: format_height(heights, row[2])),
        (Column("after", unit.symbol), lambda row: format_height(heights, row[3])),
        (word_column("used"), lambda row: "held out" if row[4] else "in the fit"),
    )


def format_height(heights: HeightErrors, error: float) -> str:
    """Return an error to the third digit of the largest error before or after."""
    largest = float(np.abs(np.concatenate([heights.before, heights.after])).max())
    factor = heights.unit.factor_to_si
    decimals = count_decimals(largest / factor) if largest > 0.0 else 0
    return f"{round(float(error) / factor, decimals) + 0.0:.{decimals}f}"


def view_heights(heights: HeightErrors | None, verbose: bool) -> list[Block]:
    """Return the tables of a page: each of few points, and rms and largest error of many."""
    if heights is None:
        return []
    if len(heights.poses) <= MOST_LINES:
        return [build_height_map(heights)]
    return [build_height_summary(heights), *([build_height_map(heights)] if verbose else [])]
