# SPDX-License-Identifier: Apache-2.0
"""What a calibration leaves behind: its result as one document, and the run folder that keeps it.

result.json    made_by    how (see `loopcal.io.runs.run_folder.MADE_BY`)
               fit        `Identification.to_dict()`: parameters in the units of the robot's file, the rest in SI
               start      `StartCheck.to_dict()`: the geometry of the robot file against the fit, on the fitted rows
               split      share and labels of the poses that were held out; null where none were
               validation `Validation.to_dict()` on those poses, SI; null where none were
arrays.npz     `Identification.arrays()`, `initial`: the values before calibration of all parameters [SI], and the rows that
               were fitted (see `loopcal.apply.reused_rows`)
robot.yaml     the corrected robot file
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.errors import DataError
from loopcal.findings import Finding, report_finding
from loopcal.apply.reused_rows import collect_fitted_rows, find_reused_rows
from loopcal.io.data.measurement_file import Paths, list_measurement_files
from loopcal.io.robot.robot_file import load_robot, format_robot, list_shipped_robots
from loopcal.io.runs.run_folder import find_fitted_file, read_run_folder, write_run_folder

if TYPE_CHECKING:
    import numpy as np

    from loopcal.estimate import Identification
    from loopcal.apply import Validation
    from loopcal.measure import Measurements
    from loopcal.mechanism import Mechanism


@dataclass(frozen=True)
class CalibratedRun:
    """A calibration read back: the corrected robot, and the one it started from."""

    path: Path
    result: dict[str, Any]
    robot: Mechanism
    before: Mechanism
    local: Mapping[str, float] = field(default_factory=dict)
    """Frames, targets and surfaces as the run found them: values by name, such as `tracker.x` [SI].
    """
    local_before: Mapping[str, float] = field(default_factory=dict)
    """The same with the geometry before calibration, on the rows that were fitted."""
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Arrays of the run, among them those of `loopcal.apply.reused_rows`."""


def build_result_document(
    fit: Identification, validation: Validation | None, origin: Mapping[str, Any], split: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the content of result.json; see the module."""
    from loopcal.diagnose import check_start_values

    shown = None if validation is None else validation.to_dict()
    start = check_start_values(fit).to_dict()
    return {"made_by": dict(origin), "fit": fit.to_dict(), "start": start, "split": split, "validation": shown}


def save_run(
    path: str | Path, fit: Identification, document: Mapping[str, Any], force: bool = False, fitted: Measurements | None = None
) -> Path:
    """Write the run folder of a calibration.

    Parameters
    ----------
    path : str or Path
        The folder to make.
    fit : Identification
        Of a robot that came from a file.
    document : mapping
        What `build_result_document` returned.
    force : bool
        Replace a run that is there.
    fitted : Measurements, optional
        What was fitted, to be known again.

    Raises
    ------
    FileError
        The folder is in use, or cannot be written.
    MechanismError
        The robot did not come from a file.
    """
    rows = {} if fitted is None else collect_fitted_rows(fitted, fit.dropped)
    arrays = {**fit.arrays(), "initial": fit.initial.values, **rows}
    return write_run_folder(path, document, arrays, format_robot(fit.robot, fit.plus_minus), force)


def load_run(path: str | Path) -> CalibratedRun:
    """Read the run folder of a calibration.

    Raises
    ------
    FileError
        Not a run folder, damaged, or made by a newer loopcal.
    """
    run = read_run_folder(path)
    robot = load_robot(run.robot_path)
    initial = run.arrays.get("initial", robot.parameters.nominal)
    names = [row["name"] for row in run.result.get("fit", {}).get("local") or ()]
    local, start = (
        dict(zip(names, found.tolist(), strict=True)) if found is not None and len(found) == len(names) else {}
        for found in (run.arrays.get("local_estimate"), run.arrays.get("local_start"))
    )
    return CalibratedRun(run.path, run.result, robot, robot.with_values(initial), local, start, run.arrays)


def load_calibrated(path: str | Path) -> CalibratedRun:
    """Read a run folder, or a robot file (or the name of a shipped robot) as if a run had made it.

    Raises
    ------
    FileError
        Neither.
    """
    path = Path(path)
    if path.is_dir() or (not path.exists() and str(path) not in list_shipped_robots()):
        return load_run(path)
    robot = load_robot(path)
    return CalibratedRun(path, {}, robot, robot.nominal)


def check_reused_data(run: CalibratedRun, data: Paths, measured: Measurements) -> Finding | None:
    """Refuse to validate a run with measurements that it was fitted to, as files or row by row.

    Returns
    -------
    Finding or None
        A warning where fewer than half of the rows were fitted.

    Raises
    ------
    DataError
        A file is the same to the last byte, or half of the rows or more were fitted.
    """
    reused = find_fitted_file(run.result, list_measurement_files(data))
    if reused is not None:
        raise DataError(report_finding("validation.file-reused", file=str(reused)))
    return find_reused_rows(run.arrays, measured)
