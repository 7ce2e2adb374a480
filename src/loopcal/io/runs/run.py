# SPDX-License-Identifier: Apache-2.0
"""A calibration that was read from its run folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.errors import DataError, FileError
from loopcal.findings import Finding, report_finding
from loopcal.io.core.text_file import sha256
from loopcal.io.data.measurement_file import load_measurements
from loopcal.io.runs.run_verdict import find_run_failure
from loopcal.mechanism import Mechanism
from loopcal.presentation import HtmlResult

if TYPE_CHECKING:
    from loopcal.estimate import Posterior
    from loopcal.estimate.inference.fit_uncertainty import FitUncertainty
    from loopcal.measure import FittedRows, Measurements


@dataclass(frozen=True, eq=False)
class Run(HtmlResult):
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

    def __repr__(self) -> str:
        verdict = self.result.get("verdict")
        verdict = f", {verdict.replace('_', ' ')}" if verdict else ""
        return f"<Run {str(self.path)!r}: {self.robot.name}{verdict}>"

    @property
    def failure(self) -> Finding | None:
        """Why the numbers of this run are not for a machine; None where they are."""
        return find_run_failure(self.path, self.result)

    @property
    def identified_robot(self) -> Mechanism:
        """The robot with only those parameters free that the run identified; its file leaves the
        others free, too.
        """
        from loopcal.estimate.free_parameters import free_only

        names = [row["name"] for row in self.result["fit"]["parameters"]]
        return free_only(self.robot, names)

    @property
    def fitted_rows(self) -> FittedRows | None:
        """The rows that the run, and those that are its prior, were fitted to; None for a robot
        file, and for run folders of older versions.
        """
        from loopcal.measure import fitted_rows_from_arrays

        return fitted_rows_from_arrays(self.arrays)

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

        return posterior_from_arrays(self.identified_robot, self.arrays)

    def load_uncertainty(self) -> FitUncertainty | None:
        """Return what the fit knows of machine and setup parameters together, to check other
        measurements; None for a robot file, or a run that does not contain it.
        """
        from loopcal.estimate.inference.fit_uncertainty import uncertainty_from_arrays

        if not self.result:
            return None
        scale, names = self.result["fit"].get("sigma_scale"), tuple(self.nuisance_values)
        return uncertainty_from_arrays(
            self.identified_robot, names, self.arrays, 1.0 if scale is None else scale
        )

    def load_budget(self) -> dict[str, Any]:
        """Return the uncertainty budget, see `ErrorBudget.to_dict`.

        Raises
        ------
        DataError : the run has no intervals, or was made by an earlier version.
        """
        budget = self.result.get("expected_error")
        if budget is None or budget.get("sources") is None:
            raise DataError(report_finding("files.no-budget", run=str(self.path)))
        return dict(budget)

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


def list_inputs(result: Mapping[str, Any]) -> dict[str, Mapping[str, str]]:
    """Return role -> `path` and `sha256` of the input files of a result."""
    return dict(result.get("made_by", {}).get("inputs", {}))
