# SPDX-License-Identifier: Apache-2.0
"""Tables of corrections as files: CSV, height maps of Klipper and RepRapFirmware, LinuxCNC.

Klipper: a profile of [bed_mesh], `[bed_mesh loopcal]`, whose heights are added to z. With `direct`
its mesh consists of these points, between which it interpolates linearly. RepRapFirmware:
heightmap.csv with a line of labels, one of the grid, and rows of heights by y, which are added to
z; a firmware reads lines of 8 characters for each height. LinuxCNC: a compensation file for each
joint has `nominal forward reverse` in a line, at most 256 of them. With COMP_FILE_TYPE = 1 the last
two are what is added to the motor's position in each direction, in the machine's unit. Source:
Klipper's "Bed mesh" and its module bed_mesh; RepRapFirmware's Grid; LinuxCNC's "INI configuration"
(COMP_FILE) and usrmotintf.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from loopcal.io.formats.c_kinematics import note_lost_terms
from loopcal.io.formats.program_format import (
    MM,
    Exported,
    ExportSource,
    Format,
    format_number,
    format_short,
)
from loopcal.mechanism.platform_coordinates import get_dimension
from loopcal.results.tables import Column, make_table
from loopcal.typing import FloatArray
from loopcal.units import UNITS, Dimension

if TYPE_CHECKING:
    from loopcal.apply.compensation import What

Writer = Callable[[ExportSource], Exported]
PROFILE = "loopcal"
DIGITS = 9  # significant digits of a CSV file: of a meter, a nanometer


def write_grid(source: ExportSource) -> Exported:
    """Return one row for each node: where it is, and what to add there."""
    (table,), robot = source.tables, source.robot
    units = {name: robot.get_unit(get_dimension(name)) for name in (*table.axes, *table.values)}
    parts = (("", table.axes), ("add ", table.values))
    titles = [Column(f"{add}{name}", str(units[name])) for add, of in parts for name in of]
    places = np.meshgrid(*table.axes.values(), indexing="ij")
    columns = [*zip(table.axes, places, strict=True), *table.values.items()]
    cells = [(values / units[name].factor_to_si).ravel() for name, values in columns]
    rows = ([f"{0.0 + number:.{DIGITS}g}" for number in row] for row in zip(*cells, strict=True))
    return Exported(make_table("", titles, rows).to_csv())


def _get_heights(source: ExportSource) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the nodes along x and y, and the heights (y, x) [mm]."""
    (table,) = source.tables
    return table.axes["x"] / MM, table.axes["y"] / MM, table.values["z"].T / MM


def write_mesh(source: ExportSource) -> Exported:
    """Return a profile of Klipper, a file to include."""
    x, y, heights = _get_heights(source)
    lines = [
        f"# Load it by BED_MESH_PROFILE LOAD={PROFILE}. Set split_delta_z of [bed_mesh] to 0.01.",
        *(f"[bed_mesh {PROFILE}]", "version: 1", "points:"),
        *("    " + ", ".join(map(format_number, row)) for row in heights.tolist()),
    ]
    for name, nodes in (("x", x), ("y", y)):
        ends = zip(("min", "max"), (nodes[0], nodes[-1]), strict=True)
        lines += [f"{end}_{name}: {format_number(number)}" for end, number in ends]
        lines += [f"{name}_count: {len(nodes)}", f"mesh_{name}_pps: 0"]
    return Exported("\n".join([*lines, "algo: direct", "tension: 0.2"]) + "\n")


def write_height_map(source: ExportSource) -> Exported:
    """Return a heightmap.csv, in the form of RepRapFirmware 3.3 and later."""
    x, y, heights = _get_heights(source)
    decimals = 4 if np.abs(heights).max() < 10.0 else 3
    numbers = [x[0], x[-1], y[0], y[-1], -1.0, x[1] - x[0], y[1] - y[0]]
    low, high, mean, sd = heights.min(), heights.max(), heights.mean(), heights.std()
    head = f"min error {low:.3f}, max error {high:.3f}, mean {mean:.3f}, deviation {sd:.3f}"
    lines = [f"RepRapFirmware height map file v2 by loopcal, {head}"]
    lines += ["axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1"]
    grid = ",".join(format_short(number, 6) for number in numbers)
    lines += [f"X,Y,{grid},{len(x)},{len(y)}"]
    lines += [",".join(f"{0.0 + h:.{decimals}f}" for h in row) for row in heights.tolist()]
    return Exported("\n".join(lines) + "\n")


def write_compensation(source: ExportSource) -> Exported:
    """Return the lines of the INI file, and a compensation file for each joint."""
    robot, lines, files = source.robot, list[str](), dict[str, str]()
    dimensions = {actuator.name: actuator.dimension for actuator in robot.actuators}
    for joint, table in enumerate(source.tables):
        (name, nodes), (trims,) = *table.axes.items(), table.values.values()
        is_length = dimensions[name] is Dimension.LENGTH
        unit = robot.get_unit(Dimension.LENGTH) if is_length else UNITS["deg"]
        rows = 0.0 + np.column_stack([nodes, trims, trims]) / unit.factor_to_si
        file = f"{source.stem}-joint{joint}.comp"
        files[file] = "".join(" ".join(map(format_number, row)) + "\n" for row in rows.tolist())
        lines += [f"# {name}", f"[JOINT_{joint}]", f"COMP_FILE = {file}", "COMP_FILE_TYPE = 1"]
    notes = note_lost_terms(robot, COMPENSATION.name)
    if source.is_for_people:
        lines += [f"# {file}\n{text.rstrip()}" for file, text in files.items()]
    return Exported("\n".join(lines) + "\n", notes, files)


def write_skew(source: ExportSource) -> Exported:
    """Return a profile of Klipper's [skew_correction], and factors of rotation_distance."""
    values = {name: float(value) for name, value in source.tables[0].values.items()}
    lines = [
        f"# Add [skew_correction] to printer.cfg, and load this by SKEW_PROFILE LOAD={PROFILE}.",
        *(f"# Multiply rotation_distance of [stepper_{n}] by {values[n]:.9f}." for n in "xyz"),
        f"[skew_correction {PROFILE}]",
        *(f"{plane}_skew: {values[plane]:.9f}" for plane in ("xy", "xz", "yz")),
    ]
    return Exported("\n".join(lines) + "\n")


def _describe(name: str, what: str, write: Writer, table: tuple[What, int, int]) -> Format:
    """Return the format of a table, which is written without another file."""
    kept = {"takes_file": False, "table": table}
    return Format(name, what, (), None, lambda source, into: write(source), **kept)


GRID = _describe("grid", "corrections over a grid, as CSV", write_grid, ("commands", 20000, 500))
KLIPPER = _describe("grid-klipper", "height map of Klipper", write_mesh, ("height", 10000, 99))
SKEW = _describe("klipper-skew", "[skew_correction] of Klipper", write_skew, ("skew", 0, 0))
REPRAP = _describe("grid-reprap", "heightmap.csv", write_height_map, ("height", 441, 41))
COMPENSATION = _describe(
    "grid-linuxcnc", "LinuxCNC COMP_FILE", write_compensation, ("readings", 256, 256)
)
