# SPDX-License-Identifier: Apache-2.0
"""Damage to the settings, the header and the rows of a CSV file."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Any

from tools.fuzz.trees import Tree, Trees, mutate_tree, write_yaml
from tools.fuzz.values import CELLS, WINDOWS_PATHS, change_number, draw_name

UNITS = (
    "mm",
    "m",
    "deg",
    "rad",
    "um",
    "urad",
    "in",
    "degC",
    "s",
    "1",
    "",
    "kg",
    "mm*mrad",
    "K",
    "mm2",
)
COLUMNS = (
    "use", "block", "kind", "session", "group", "time [s]", "time", "temperature [degC]", "note",
    "pose", "x [mm]", "temperature.room [K]", "commanded.x [mm]", "sigma.x [um]",
    "cov.x.y [mm*mm]", "measured.x [mm]",
)  # fmt: skip
"""Columns that a table may get, besides sigmas and covariances of its own columns."""
VALUES = ("a", "b", "1", "0.01", "20", "fit", "held-out", "2024-05-01T10:00:00", "inf", "")


@dataclass
class Table:
    """A CSV file: settings (parsed), header and rows of cells."""

    settings: Tree
    header: list[str]
    rows: list[list[str]]


def read_table(content: bytes, parse: Callable[[str], Tree]) -> Table:
    """Return the parts of a CSV file; `parse` reads the settings as YAML."""
    lines = content.decode("utf-8").splitlines()
    remarks = [line[2:] for line in lines if line.startswith("# ")]
    header, *rows = csv.reader(line for line in lines if not line.startswith("#"))
    return Table(parse("\n".join(remarks)), header, rows)


def mutate_table(table: Table, rng: Random, others: Trees) -> tuple[Table, str]:
    """Return a damaged copy of a table, and the name of the damage."""
    copied = Table(table.settings, list(table.header), [list(row) for row in table.rows])
    if isinstance(table.settings, dict) and rng.random() < 0.35:
        copied.settings, name = mutate_tree(table.settings, rng, others)
        return copied, f"setting-{name}"
    name = rng.choice(list(MUTATIONS))
    MUTATIONS[name](copied, rng)
    return copied, name


def write_table(table: Table, rng: Random) -> tuple[bytes, bytes | None]:
    """Return the bytes of a table, and of its settings where these get a file of their own."""
    settings = write_yaml(table.settings, rng) if table.settings else ""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerows([table.header, *table.rows])
    text = file.getvalue()
    if settings and rng.random() < 0.08:
        return _encode(text), _encode(settings)
    return _encode("".join(f"# {line}\n" for line in settings.splitlines()) + text), None


def _encode(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


def _pick(table: Table, rng: Random) -> tuple[int, int]:
    """Return the indices of a row and a column."""
    return rng.randrange(len(table.rows) or 1), rng.randrange(len(table.header) or 1)


def _set_cell(table: Table, rng: Random) -> None:
    i, j = _pick(table, rng)
    if table.rows and j < len(table.rows[i]):
        table.rows[i][j] = rng.choice([rng.choice(CELLS), draw_name(rng)])


def _scale_cells(table: Table, rng: Random) -> None:
    """Change the number of one cell, or of all cells of a column."""
    i, j = _pick(table, rng)
    seed, whole = rng.random(), rng.random() < 0.4
    for k, row in enumerate(table.rows):
        if (whole or k == i) and j < len(row):
            try:
                row[j] = repr(change_number(float(row[j]), Random(seed)))
            except ValueError:
                row[j] = rng.choice(VALUES)


def _fill_column(table: Table, rng: Random) -> None:
    """Write the same into all cells of a column."""
    _, j = _pick(table, rng)
    value = rng.choice([*CELLS, *VALUES])
    for row in table.rows:
        if j < len(row):
            row[j] = value


def _add_column(table: Table, rng: Random) -> None:
    names = [name.split(" [")[0] for name in table.header] or ["x"]
    one, other = rng.choice(names), rng.choice(names)
    unit = rng.choice(UNITS)
    name = rng.choice(
        [
            *COLUMNS,
            f"sigma.{one} [{unit}]",
            f"cov.{one}.{other} [mm*mm]",
            f"{draw_name(rng)} [{unit}]",
        ]
    )
    j, same = rng.randrange(len(table.header) + 1), rng.random() < 0.5
    table.header.insert(j, name)
    value = rng.choice(VALUES)
    for i, row in enumerate(table.rows):
        row.insert(j, value if same else rng.choice([str(i), *VALUES]))


def _delete_column(table: Table, rng: Random) -> None:
    _, j = _pick(table, rng)
    for row in (table.header, *table.rows):
        del row[j : j + 1]


def _double_column(table: Table, rng: Random) -> None:
    """Repeat a column beside itself or at the end, with its cells or with others."""
    _, j = _pick(table, rng)
    place, other = rng.choice([j, len(table.header)]), rng.choice([None, *VALUES])
    for row in (table.header, *table.rows):
        cell = row[j : j + 1] if row is table.header or other is None else [other]
        row[place:place] = cell


def _rename_column(table: Table, rng: Random) -> None:
    """Rename a column or change its unit."""
    _, j = _pick(table, rng)
    if table.header:
        name = table.header[j].split(" [")[0]
        table.header[j] = rng.choice(
            [
                draw_name(rng),
                f"{name} [{rng.choice(UNITS)}]",
                f"{draw_name(rng)} [mm]",
                rng.choice(table.header),
                name,
            ]
        )


def _edit_rows(table: Table, rng: Random) -> None:
    """Delete, repeat or move rows, or make one longer or shorter."""
    i, _ = _pick(table, rng)
    if not table.rows:
        return
    match rng.randrange(6):
        case 0:
            del table.rows[i]
        case 1:
            table.rows.append(list(table.rows[i]))
        case 2:
            rng.shuffle(table.rows)
        case 3:
            table.rows = table.rows[: rng.choice([0, 1, 2, 3])]
        case 4:
            table.rows[i].append(rng.choice(CELLS))
        case _:
            del table.rows[i][rng.randrange(len(table.rows[i]) or 1) :]


def _swap_columns(table: Table, rng: Random) -> None:
    """Swap two headers without their cells."""
    _, j = _pick(table, rng)
    _, k = _pick(table, rng)
    if table.header:
        table.header[j], table.header[k] = table.header[k], table.header[j]


def _add_setting(table: Table, rng: Random) -> None:
    """Add a setting that is seldom used."""
    settings: dict[str, Any] = dict(table.settings) if isinstance(table.settings, dict) else {}
    names = [name.split(" [")[0] for name in table.header]
    settings |= rng.choice(
        [
            {"reading_noise": "5 um"},
            {"reading_noise": {rng.choice(names or ["q1"]): "5 um"}},
            {"session_bias": {"*": "20 um"}},
            {"session_drift": "unknown"},
            {"unknowns": {"*": "fixed"}},
            {"unknowns": {"frame.x": {"start": "1 mm", "sd": "1 mm"}}},
            {"unknown": ["frame"]},
            {"unknown": ["frame", "targets"], "frame": draw_name(rng)},
            {"places": [["10 mm", "0 mm", "0 mm"]]},
            {"places": [["10 mm"], ["1 mm", "2 mm"]]},
            {"targets": [draw_name(rng), "b"]},
            {"T_base_frame": {"x": "1 m"}},
            {
                "noise": {
                    "*": rng.choice(["0 mm", "-1 mm", "1e-300 mm", "1e300 mm", "nan mm", "5 um"])
                }
            },
            {"noise_source": "assumed"},
            {
                "poses": rng.choice(
                    [*WINDOWS_PATHS, "poses.csv", "data.csv", "/dev/zero", "../x.csv", "."]
                )
            },
            {
                "controller": rng.choice(
                    ["robot.yaml", "data.csv", "../x.yaml", "/dev/zero", "five-bar"]
                )
            },
            {
                "kind": rng.choice(
                    [["position"], "plane", "line", "separation", None, "locked", "bearing"]
                )
            },
            {"session": draw_name(rng)},
            {"robot": draw_name(rng)},
            {"group": draw_name(rng)},
        ]
    )
    table.settings = settings


MUTATIONS: dict[str, Callable[[Table, Random], None]] = {
    "cell": _set_cell,
    "scale": _scale_cells,
    "fill-column": _fill_column,
    "add-column": _add_column,
    "delete-column": _delete_column,
    "double-column": _double_column,
    "rename-column": _rename_column,
    "rows": _edit_rows,
    "swap-columns": _swap_columns,
    "add-setting": _add_setting,
}
