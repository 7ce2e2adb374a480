# SPDX-License-Identifier: Apache-2.0
"""What commands print: tables for people, one JSON document for programs."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click

from loopcal.units import DISPLAY_UNITS, Dimension, Unit, find_unit

if TYPE_CHECKING:
    from loopcal.apply import Validation
    from loopcal.diagnose import ReadingError
    from loopcal.mechanism import Mechanism

ROUNDING = 1e-12
"""What is smaller than this, in whatever unit is shown, is rounding and shown as 0."""

WIDEST = 1000
"""Characters in a line of a table; more than any has."""

ALIKE = 5e-3
"""Share by which two errors may differ and still be called the same."""


def say(text: str = "") -> None:
    """Print a line of the result."""
    click.echo(text)


def progress(text: str) -> None:
    """Print a line of progress on standard error, for somebody who watches."""
    if sys.stderr.isatty():
        click.echo(text, err=True)


def json_document(document: Mapping[str, Any]) -> None:
    """Print one JSON document; see `loopcal.io.core.json_text`."""
    from loopcal.io.core.json_text import to_json

    click.echo(to_json(document), nl=False)


def table(
    title: str, headers: Sequence[str], rows: Iterable[Sequence[str]], text_columns: int = 1
) -> None:
    """Print a table; the first `text_columns` columns are left-aligned, the others right-aligned."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    shown = Table(
        title=title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False
    )
    for i, header in enumerate(headers):
        shown.add_column(header, justify="left" if i < text_columns else "right", no_wrap=True)
    for row in rows:
        shown.add_row(*row)
    say()
    # wide enough for everything: a number that is cut short is a wrong number
    console = Console(width=WIDEST, highlight=False, markup=False, color_system=None)
    with console.capture() as captured:
        console.print(shown)
    for line in captured.get().splitlines():
        say(line.rstrip())


def units_of(robot: Mechanism) -> dict[Dimension, Unit]:
    """Return the units in which a robot's numbers are shown: those of its file."""
    return {
        **DISPLAY_UNITS,
        **{dimension: find_unit(symbol) for dimension, symbol in robot.units.items()},
    }


def number(value: float, plus_minus: float | None = None, digits: int = 6) -> str:
    """Return a number to the digits that its uncertainty leaves, or to `digits` significant ones.

    Two digits of the uncertainty are kept; what is not finite is a dash.
    """
    if not math.isfinite(value):
        return "-"
    if abs(value) < ROUNDING:
        value = 0.0
    if plus_minus is not None and math.isfinite(plus_minus) and plus_minus > 0:
        decimals = 1 - math.floor(math.log10(plus_minus))
        return f"{value:.{min(max(decimals, 0), 12)}f}"
    return f"{value:.{digits}g}"


def uncertainty(plus_minus: float) -> str:
    """Return an uncertainty to two digits, or in a word why there is none: not determined, or no
    interval possible.
    """
    if math.isnan(plus_minus):
        return "not given"
    return "unknown" if math.isinf(plus_minus) else number(plus_minus, plus_minus)


def parameters(title: str, rows: Iterable[Mapping[str, Any]]) -> None:
    """Print identified parameters: rows of `Identification.to_dict()["parameters"]`."""
    table(
        title,
        ("name", "nominal", "estimate", "+/- (95 %)", "unit"),
        [
            (
                row["name"],
                number(row["nominal"], row["plus_minus"], 9),
                number(row["estimate"], row["plus_minus"], 9),
                uncertainty(row["plus_minus"]),
                row["unit"],
            )
            for row in rows
        ],
    )


def reading_errors(robot: Mechanism, errors: Sequence[ReadingError]) -> None:
    """Print how far recorded readings are from those found: as readings, and as what the actuators
    move.
    """
    units = units_of(robot)
    cells = []
    for error in errors:
        read, moved = units[error.reading_dimension], units[error.joint_dimension]
        numbers = [error.joint / moved.factor_to_si, error.largest / moved.factor_to_si]
        cells.append(
            (
                error.name,
                number(error.reading / read.factor_to_si, digits=3),
                read.symbol,
                *(number(x, digits=3) for x in numbers),
                moved.symbol,
                error.pose,
            )
        )
    headers = ("reading", "rms", "unit", "rms of what it moves", "largest", "unit", "at")
    table(
        f"Readings, recorded minus found, of up to {max(e.count for e in errors)} poses",
        headers,
        cells,
    )


def validation(found: Validation, poses: str, before: bool = True) -> None:
    """Print errors before and after calibration, or of one geometry alone.

    Errors after commanding are left out where they are those of the prediction because nothing is
    out of the actuators' reach.
    """
    rows = _error_rows(found)
    same = all(max(four) < ROUNDING for title, _, _, _, *four in rows if title == "not compensable")
    if same:
        rows = [row for row in rows if row[0].startswith("predicted")]
    if not before:
        rows = [("predicted", *row[1:]) for row in rows if row[0] == "predicted after"]
    cells = [(title, index.replace("_", " "), str(count), *(number(x, digits=4) for x in four), symbol)
             for title, index, symbol, count, *four in rows]  # fmt: skip
    headers = ("error", "of", "rows", "max", "rms", "mean", "sd", "unit")
    table(f"Errors on {len(found.poses)} {poses} rows", headers, cells, text_columns=2)
    if found.has_several_kinds:
        _kinds(found, before)
    if same and before:
        say(
            "poses after commanding have these same errors: what was measured can be corrected by "
            "the actuators in full"
        )
    for name, times in found.improvements().items() if before else ():
        say(f"{name} (rms): {_compared(times)}")
    if found.unreachable:
        say(f"left out, out of reach: poses {', '.join(found.unreachable)}")
    for finding in found.findings:
        if finding not in found.failures:
            say(f"note: {finding}")


def _error_rows(found: Validation) -> list[tuple[str, str, str, int, float, float, float, float]]:
    """Return error, quantity, unit, count, and max, rms, mean, sd in that unit."""
    rows = []
    for title, errors in found.errors().items():
        for quantity in found.quantities:
            s, shown = errors.statistics(quantity), find_unit(found.unit_of(quantity))
            four = (x / shown.factor_to_si for x in (s.max, s.rms, s.mean, s.sd))
            rows.append((title, quantity, shown.symbol, s.count, *four))
    return rows


def _kinds(found: Validation, before: bool) -> None:
    """Print errors of every kind in units of its sigma."""
    if before:
        headers = ("kind", "values", "before", "after")
        cells = [
            (k.kind, str(k.count), number(k.before, digits=3), number(k.after, digits=3))
            for k in found.kinds
        ]
    else:
        headers = ("kind", "values", "predicted")
        cells = [(k.kind, str(k.count), number(k.after, digits=3)) for k in found.kinds]
    table("Errors divided by sigma (rms)", headers, cells)


def _compared(improvement: float) -> str:
    """Return in words how many times smaller an error became."""
    if abs(improvement - 1.0) < ALIKE:
        return "the same before and after calibration"
    if improvement > 1.0:
        return f"{improvement:.3g} times smaller after calibration"
    return (
        f"{1.0 / improvement:.3g} times LARGER after calibration"
        if improvement > 0.0
        else "LARGER after calibration"
    )


def gates(reasons: Iterable[str]) -> int:
    """Print why quality gates are not met, on standard error; return the exit code, 0 or 2."""
    sentences = list(reasons)
    for sentence in sentences:
        click.echo(f"loopcal: quality gate not met: {sentence}", err=True)
    return 2 if sentences else 0
