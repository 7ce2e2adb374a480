# SPDX-License-Identifier: Apache-2.0
"""The run folder of a calibration: a view of its report, and what can be read back from it.

result.json    made_by    see `run_folder.MADE_BY`
others     `CalibrationReport.to_dict()`: `fit`, `start`, `split`, `validation`
and more; parameters in the units of the robot file, the rest in SI
arrays.npz     `CalibrationReport.arrays()`: estimates, the geometry before the calibration, and
the fitted rows
robot.yaml     the corrected robot file
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.errors import DataError, FileError
from loopcal.findings import report_finding
from loopcal.io.core.text_file import as_path, sha256
from loopcal.io.data.measurement_file import Paths, list_measurement_files, load_measurements
from loopcal.io.robot.robot_file import format_robot, list_shipped_robots, load_robot
from loopcal.io.runs.run_folder import (
    collect_provenance,
    find_fitted_file,
    list_inputs,
    read_run_folder,
    write_run_folder,
)
from loopcal.mechanism import Mechanism

if TYPE_CHECKING:
    from loopcal.estimate import Posterior
    from loopcal.measure import Measurements
    from loopcal.workflow import CalibrationReport


@dataclass(frozen=True)
class Run:
    """A calibration read from its run folder, or a robot file as if it were one.

    Parameters
    ----------
    path : of the folder or file. result : content of result.json, empty for a robot file.
    robot : the corrected robot. initial_robot : the robot before the calibration.
    nuisance_values : name -> estimate of frames, targets and surfaces, such as `tracker.x` [SI].
    initial_nuisance_values : the same with the geometry before the calibration.
    arrays : content of arrays.npz, SI.
    """

    path: Path
    result: dict[str, Any]
    robot: Mechanism
    initial_robot: Mechanism
    nuisance_values: Mapping[str, float] = field(default_factory=dict)
    initial_nuisance_values: Mapping[str, float] = field(default_factory=dict)
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def held_out(self) -> tuple[str, ...]:
        """Labels of the poses that were held out for validation."""
        return tuple((self.result.get("split") or {}).get("held_out", ()))

    @property
    def excluded(self) -> tuple[str, ...]:
        """Labels of the poses that were excluded from the fit."""
        return tuple(self.result.get("fit", {}).get("dropped") or ())

    def load_posterior(self) -> Posterior:
        """Return estimates and uncertainties, as a prior for new data or for `accuracy_map`.

        Raises
        ------
        EstimationError : the run does not contain them, or its robot file was changed.
        """
        from loopcal.estimate.inference.posterior import posterior_from_arrays

        return posterior_from_arrays(self.robot, self.arrays)

    def load_measurements(self, **allowed: bool) -> tuple[Measurements, Measurements | None]:
        """Return the fitted and the held-out measurements, from the unchanged input files.

        Parameters
        ----------
        allowed : see `loopcal.load_measurements`.

        Returns
        -------
        fitted : without excluded poses. held_out : None where no pose was held out.

        Raises
        ------
        FileError : the run names no data, or a file is missing or was changed since.
        """
        roles = ("data", "poses")
        files = {r: f for r, f in list_inputs(self.result).items() if r.partition("-")[0] in roles}
        if not files:
            sentence = "this run names no measurement files; load them by load_measurements"
            raise FileError(sentence, self.path)
        for file in files.values():
            if sha256(file["path"]) != file["sha256"]:
                sentence = f"this file was changed since the run in {self.path}; restore it"
                raise FileError(sentence, file["path"])
        data = load_measurements([f["path"] for f in files.values()], self.robot, **allowed)
        fitted = [label not in (*self.held_out, *self.excluded) for label in data.labels]
        held_out = [label in self.held_out for label in data.labels]
        return data.take(fitted), data.take(held_out) if any(held_out) else None


def save_run(
    path: str | Path,
    report: CalibrationReport,
    inputs: Mapping[str, Path] | None = None,
    command: Sequence[str] = (),
    force: bool = False,
) -> Path:
    """Write the run folder of a calibration, and return it.

    Parameters
    ----------
    path : the folder to make. report : of `loopcal.calibrate`, with a robot from `load_robot`.
    inputs : role -> file, such as `{"robot": .., "data": ..}`; their names and digests are kept.
    command : the command line that made the report.
    force : replace an older run.

    Raises
    ------
    FileError : the folder is in use, or cannot be written; an input cannot be read.
    MechanismError : the robot was not loaded from a file.
    """
    document = build_document(report, inputs, command)
    text = format_robot(report.robot, report.identification.plus_minus)
    return write_run_folder(path, document, report.arrays(), text, force)


def build_document(
    report: CalibrationReport, inputs: Mapping[str, Path] | None = None, command: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the content of result.json; see `save_run`."""
    files = {role: as_path(file, "input") for role, file in (inputs or {}).items()}
    provenance = collect_provenance(command, files, report.provenance.seeds)
    return {"made_by": provenance, **report.to_dict()}


def load_run(path: str | Path) -> Run:
    """Read the run folder of a calibration.

    Raises
    ------
    FileError : not a run folder, damaged, or made by a newer loopcal.
    """
    run = read_run_folder(path)
    robot = load_robot(run.robot_path)
    initial = run.arrays.get("initial", robot.parameters.nominal)
    names = [row["name"] for row in run.result.get("fit", {}).get("local") or ()]
    values, initial_values = (
        dict(zip(names, array.tolist(), strict=True))
        if (array := run.arrays.get(key)) is not None and len(array) == len(names)
        else {}
        for key in ("local_estimate", "local_start")
    )
    before = robot.with_values(initial)
    return Run(run.path, run.result, robot, before, values, initial_values, run.arrays)


def load_run_or_robot(path: str | Path) -> Run:
    """Read a run folder, or a robot file (or a shipped robot by its name) as if it were a run.

    Raises
    ------
    FileError : neither of them.
    """
    path = as_path(path, "run folder or robot file")
    if path.is_dir() or (not path.exists() and str(path) not in list_shipped_robots()):
        return load_run(path)
    robot = load_robot(path)
    return Run(path, {}, robot, robot.nominal)


def load_posterior(path: str | Path) -> Posterior:
    """Read estimates and uncertainties of a run; raise as `load_run`, `Run.load_posterior`."""
    return load_run(path).load_posterior()


def load_prior(path: str | Path, data: Paths) -> Posterior:
    """Read the posterior of an earlier run, as a prior for new measurements.

    Raises
    ------
    FileError, EstimationError : see `load_posterior`.
    DataError : the run was fitted to these measurements, which would count twice.
    """
    run = load_run(path)
    reused = find_fitted_file(run.result, list_measurement_files(data))
    if reused is not None:
        raise DataError(report_finding("files.prior-data-reused", file=str(reused)))
    return run.load_posterior()


def load_posterior_or_robot(path: str | Path) -> Mechanism | Posterior:
    """Read a run folder with its uncertainties, or a robot file (or shipped robot) without any."""
    return load_posterior(path) if Path(path).is_dir() else load_run_or_robot(path).robot


def refuse_fitted_files(run: Run, data: Paths) -> None:
    """Raise DataError where a file for validation is one that the run was fitted to.

    `loopcal.apply.find_reused_rows` recognizes rows in other files.
    """
    reused = find_fitted_file(run.result, list_measurement_files(data))
    if reused is not None:
        raise DataError(report_finding("validation.file-reused", file=str(reused)))
