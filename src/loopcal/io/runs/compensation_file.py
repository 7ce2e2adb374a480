# SPDX-License-Identifier: Apache-2.0
"""Files of compensation: targets as CSV with units, and the readings or commands for them.

pose,z [mm],phi [deg],theta [deg]        targets: one column for each controlled coordinate; `pose` names the rows
pose,q1 [mm],..,note before x [mm],..    readings, or `commanded.z [mm],..` for a closed controller; what begins with
                                         `note` says what to expect, so the file is the start of a
                                         measurement file
"""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.errors import (DataError, suggest_names)
from loopcal.io.runs.calibration_run import load_calibrated
from loopcal.io.core.csv_table import read_table, require_columns
from loopcal.io.data.measurement_file import Paths, list_measurement_files
from loopcal.io.core.numbers import format_scaled
from loopcal.io.data.columns import COMMANDED, get_dimension
from loopcal.io.robot.robot_file import load_robot
from loopcal.io.runs.run_folder import find_fitted_file, read_run_folder
from loopcal.units import (DISPLAY_UNITS, Dimension, Unit, find_unit)

if TYPE_CHECKING:
    import numpy as np

    from loopcal.apply.compensation import Compensation
    from loopcal.estimate.inference.posterior import Posterior
    from loopcal.mechanism import Mechanism

NAMES = ("rx", "ry", "rz", "x", "y", "z")
DIGITS = 6


def load_posterior(path: str | Path) -> Posterior:
    """Read what the run in a folder knows of the parameters.

    Raises
    ------
    FileError
        Not a run folder, damaged, or made by a newer loopcal.
    EstimationError
        It does not hold this knowledge, or its robot file was changed.
    """
    from loopcal.estimate.inference.posterior import posterior_from_arrays

    run = read_run_folder(path)
    return posterior_from_arrays(load_robot(run.robot_path), run.arrays)


def load_prior(path: str | Path, data: Paths) -> Posterior:
    """Read what an earlier run knows, as a prior for new measurements.

    Raises
    ------
    FileError, EstimationError
        See `load_posterior`.
    DataError
        The run was fitted to these very measurements, which would count twice.
    """
    again = find_fitted_file(read_run_folder(path).result, list_measurement_files(data))
    if again is not None:
        raise DataError(
            f"{again}: the earlier run was fitted to these very measurements, which would count "
            "twice; give new ones"
        )
    return load_posterior(path)


def load_calibrated_or_posterior(path: str | Path) -> Mechanism | Posterior:
    """Read a run folder with its uncertainties, or a robot file (or a shipped robot) without any.

    Raises
    ------
    FileError, EstimationError
        See `load_posterior`.
    """
    return load_posterior(path) if Path(path).is_dir() else load_calibrated(path).robot


def load_targets(path: str | Path, robot: Mechanism) -> tuple[np.ndarray, tuple[str, ...]]:
    """Read targets: a CSV file with one column, and its unit, for each controlled coordinate.

    Returns
    -------
    targets : (n, c) [m, rad], in the robot's order.
    labels : (n,) cells of the column `pose`; "1", "2", ... without it.

    Raises
    ------
    FileError
        What does not fit, at its line.
    """
    import numpy as np

    table = read_table(path)
    known = ("pose", *robot.controlled)
    require_columns(table, robot.controlled, f"is a coordinate that {robot.name} is commanded in")
    for name in table.names:
        if name not in known and not name.startswith("note"):
            raise table.header_error(
                f"column {name!r} is unknown{suggest_names(name, known)}; columns of targets are "
                f"{', '.join(known)}; call it "
                f"'note {name}' to ignore it"
            )
    columns = [table.numbers(name, get_dimension(name), empty=False) for name in robot.controlled]
    labels = table.text("pose") if "pose" in table.units else tuple(str(i + 1) for i in range(len(table.rows)))
    for i, label in enumerate(labels):
        if not label or label in labels[:i]:
            problem = f"stands here for the second time ({label!r})" if label else "is empty"
            raise table.row_error(i, f"the name of this target {problem}; give each target a name "
                                     "of its own")
    return np.column_stack(columns), labels


def format_compensation(found: Compensation) -> str:
    """Return the result as CSV text, units in the header."""
    robot = found.robot
    if found.commands is None:
        told = [(a.name, _unit(robot, a.dimension)) for a in robot.actuators]
        values = found.readings
    else:
        told = [(COMMANDED + name, _unit(robot, get_dimension(name))) for name in found.controller.controlled]
        values = found.commands
    notes = [("before", found.before), ("remaining", found.remaining)]
    if found.uncertainty is not None:
        notes.append(("U", found.uncertainty.expanded))
    shown = [_unit(robot, Dimension.LENGTH if name in "xyz" else Dimension.ANGLE) for name in NAMES]
    text = io.StringIO()
    write = csv.writer(text, lineterminator="\n").writerow
    header = ["pose", *(f"{name} [{symbol}]" for name, symbol in told)]
    header += [f"note {title} {name} [{symbol}]" for title, _ in notes for name, symbol in zip(NAMES, shown, strict=True)]
    write([*header, "note status"])
    for i, label in enumerate(found.labels):
        cells = [format_scaled(float(v), u.factor_to_si) if found.usable[i] else "" for v, (_, u) in zip(values[i], told, strict=True)]
        for _, errors in notes:
            cells += [_number(float(v) / u.factor_to_si) for v, u in zip(errors[i], shown, strict=True)]
        write([label, *cells, str(found.findings[i])])
    return text.getvalue()


def _unit(robot: Mechanism, dimension: Dimension) -> Unit:
    """Return the unit in which the robot's file has this dimension."""
    return find_unit(robot.units.get(dimension, DISPLAY_UNITS[dimension].symbol))


def _number(value: float) -> str:
    """Return a number; nothing where there is none, `inf` where nothing is known."""
    return "" if value != value else f"{value:.{DIGITS}g}"  # noqa: PLR0124
