# SPDX-License-Identifier: Apache-2.0
"""The rows of measurement files, as the page of `loopcal app` shows and corrects them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from loopcal.io.core.csv_table import Cells, format_header, format_row, read_template
from loopcal.io.core.text_file import read_text, write_text
from loopcal.results.tables import to_quantity
from loopcal.units import DISPLAY_UNITS

Residuals = dict[str, tuple[float, str]]
"""Pose -> its largest residual, in its standard deviation and as text."""


def read_residuals(run: Path) -> tuple[Residuals, Sequence[str]]:
    """Return the largest residual of each pose in a run folder, and its held-out poses."""
    from loopcal.estimate.result import residuals_from_arrays
    from loopcal.io.runs.run_folder import read_run_folder

    result, arrays = read_run_folder(run)
    excluded, found = result.get("fit", {}).get("dropped") or (), Residuals()
    for of in residuals_from_arrays(arrays):
        for label, raw, white in zip(of.poses, of.raw, abs(of.whitened), strict=True):
            i = int(white.argmax())
            text = f"{of.components[i]} {to_quantity(raw[i], DISPLAY_UNITS[of.dimensions[i]])}"
            found[label] = max(found.get(label, (0.0, "")), (float(white[i]), text))
    held_out = (result.get("split") or {"held_out": ()})["held_out"]
    return {label: of for label, of in found.items() if label not in excluded}, held_out


def list_rows(
    files: Mapping[str, Path], run: Path, most: int, is_sorted: bool
) -> tuple[list[dict[str, Any]], Sequence[str]]:
    """Return the first rows of measurement files, by their names, with the largest residual of each
    pose; sorted by it, after rows that the run lacks. With them the held-out poses.
    """
    has_run = (run / "result.json").is_file()
    found, held_out = read_residuals(run) if has_run else (Residuals(), ())
    known, none, tables = {*found, *held_out}, (0.0, ""), []
    for name, path in files.items():
        table = read_template(path)
        places = zip(table.lines, table.pose_names(), table.rows, strict=True)
        rows = [(*place, *found.get(place[1], (None, ""))) for place in places]
        if is_sorted:
            rows.sort(key=lambda row: -found.get(row[1], none)[0] if row[1] in known else -math.inf)
        facts = {"count": len(rows), "most": max([3.0, *(of[0] for of in found.values())])}
        facts |= {"file": name, "header": format_header(table.units), "rows": rows[:most]}
        tables.append(facts)
    return tables, held_out


def correct_cell(path: Path, line: int, column: int, text: str) -> None:
    """Replace a cell of a measurement file; FileError where it must be a number."""
    table, text = read_template(path), text.strip()
    row, name = list(table.lines).index(line), table.names[column]
    if table.units[name] is not None:
        one = replace(table, columns={name: Cells([text])}, lines=[line])
        one.scaled_numbers(name, 1.0)
    cells = list(list(table.rows)[row])
    cells[column] = text
    lines = read_text(path, "measurement file").split("\n")
    lines[line - 1] = format_row(cells) + "\r" * lines[line - 1].endswith("\r")
    write_text(path, "\n".join(lines))
