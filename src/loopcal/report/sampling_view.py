# SPDX-License-Identifier: Apache-2.0
"""Bootstrap, sampled posterior and joint regions as people read them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopcal.estimate import Identification
from loopcal.findings import Finding
from loopcal.mechanism import Mechanism
from loopcal.report.numbers import format_number, format_uncertainty, format_with_uncertainty
from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block, format_list
from loopcal.sampling import (
    Bootstrap,
    Intervals,
    JointRegion,
    PosteriorSample,
    SimultaneousIntervals,
)
from loopcal.typing import FloatArray


def view_bootstrap(result: Bootstrap, intervals: Intervals) -> list[Block]:
    """Return the page of a bootstrap: what was drawn, findings, intervals."""
    blocks, count = result.blocks, len(result.draws)
    drawn = f"{count} resamples of {blocks.count} {blocks.unit}s, scheme {result.scheme}"
    title = f"{result.fit.robot.name}: bootstrap, {drawn}, seed {result.seed}"
    return [title, "", *_view_findings(result.findings), _build_table(result.fit, intervals)]


def view_posterior(sample: PosteriorSample, intervals: Intervals) -> list[Block]:
    """Return the page of a sampled posterior: effective size, findings, intervals."""
    size = f"{len(sample.draws)} weighted draws worth {sample.effective_size:.0f}"
    title = f"{sample.fit.robot.name}: exact posterior, {size}, seed {sample.seed}"
    return [title, "", *_view_findings(sample.findings), _build_table(sample.fit, intervals)]


def view_region(
    region: JointRegion | None, intervals: SimultaneousIntervals, robot: Mechanism
) -> list[Block]:
    """Return the page of simultaneous intervals and, where there is one, of the joint region."""
    units = [
        robot.get_unit(robot.parameters.entries[robot.parameters.index(name)].dimension)
        for name in intervals.names
    ]
    level, count = f"{100 * intervals.level:.4g} %", len(intervals.names)
    together = f"all {count} parameters at once" if count > 1 else "1 parameter"
    rows = []
    for i, (name, unit) in enumerate(zip(intervals.names, units, strict=True)):
        value, single, half = (
            float(array[i]) / unit.factor_to_si
            for array in (intervals.center, intervals.single, intervals.half_widths)
        )
        cells = (format_uncertainty(single), format_uncertainty(half))
        rows.append((name, format_with_uncertainty(value, half), *cells, unit.symbol))
    columns = (
        word_column("name"),
        Column("estimate"),
        Column("+/- one at a time"),
        Column("+/- all at once"),
        word_column("unit"),
    )
    blocks: list[Block] = [
        f"{robot.name}: {level} intervals that hold for {together}",
        f"Rule: {intervals.rule}.",
        Table("Intervals", columns, tuple(rows)),
    ]
    if region is None:
        return blocks
    degrees = (
        "known noise"
        if np.isinf(region.degrees)
        else f"noise with {region.degrees:.3g} degrees of freedom"
    )
    text = f"Joint {level} region: squared distance up to {region.square:.4g} ({degrees})."
    return [*blocks, text, _build_axes(region)]


def _view_findings(findings: Sequence[Finding]) -> list[Block]:
    """Return findings with their severity."""
    return list(format_list([(f.severity.value, str(f)) for f in findings]))


def _build_table(fit: Identification, intervals: Intervals) -> Table:
    """Return the intervals beside the linear ones, in the units of the robot's file."""
    factor, symbols = fit.free_parameters.display()
    stated = fit.interval(intervals.level)
    is_off, rows = intervals.is_off, []
    for i, name in enumerate(intervals.names):
        lower, upper, half, value, own = (
            float(array[i]) / factor[i]
            for array in (
                intervals.lower,
                intervals.upper,
                0.5 * (intervals.upper - intervals.lower),
                fit.estimate,
                stated,
            )
        )
        cells = tuple(format_with_uncertainty(x, half) for x in (value, lower, upper))
        change = 100.0 * float(intervals.largest_shift[i])
        mark = "yes" if is_off[i] else ""
        shown = format_number(change, 2) if np.isfinite(lower) else "-"
        rows.append((name, *cells, format_uncertainty(own), shown, mark, symbols[i]))
    level = f"{100 * intervals.level:.4g} %"
    columns = (
        word_column("name"),
        Column("estimate"),
        Column("from"),
        Column("to"),
        Column("stated +/-"),
        Column("nonlinear", "%"),
        word_column("off"),
        word_column("unit"),
    )
    return Table(f"{level} intervals by {intervals.source}", columns, tuple(rows))


def _build_axes(region: JointRegion) -> Table:
    """Return the principal axes of a region in standard deviations of its parameters."""
    scaled: FloatArray = region.axes / region.standard_deviations
    columns = (word_column("name"), *(Column(f"axis {i + 1}") for i in range(len(scaled))))
    rows = [
        (name, *(format_number(float(axis[j]), 3) for axis in scaled))
        for j, name in enumerate(region.names)
    ]
    return Table("Principal axes, in standard deviations", columns, tuple(rows))
