# SPDX-License-Identifier: Apache-2.0
"""What the report of a calibration shows: the content of a run, as numbers and objects.

A report in memory and a run folder give the same record, so that both give the same document.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from loopcal.apply import HeightErrors, Validation
from loopcal.apply.height_errors import restore_heights
from loopcal.apply.stored_validation import restore_validation
from loopcal.estimate import Posterior
from loopcal.estimate.inference.posterior import posterior_from_arrays
from loopcal.estimate.residuals import KindResiduals, residuals_from_arrays
from loopcal.mechanism import Mechanism
from loopcal.serialization import restore_numbers
from loopcal.workflow import Verdict


@dataclass(frozen=True)
class ControllerValues:
    """Identified values as a controller reads them.

    Parameters
    ----------
    format : name of the format. what : a line about it. text : of the file. notes : what it cannot
        express, and what it changes.
    """

    format: str
    what: str
    text: str = field(repr=False)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class CalibrationRecord:
    """Content of a run.

    Attributes
    ----------
    source : name of the run folder; empty for a report in memory.
    result : content of result.json, with numbers that are not finite.
    arrays : content of arrays.npz [SI].
    robot : the corrected robot, of which the identified parameters are free. initial : the robot
        before the calibration.
    posterior : of a fit that converged; None where the run has none.
    validation : errors at held-out poses; None without any, or where an older version wrote the
        run.
    heights : errors of measured heights; None without any.
    residuals : of every kind; none where an older version wrote the run.
    controllers : the values for controllers that can store them.
    """

    source: str
    result: Mapping[str, Any] = field(repr=False)
    arrays: Mapping[str, np.ndarray] = field(repr=False)
    robot: Mechanism
    initial: Mechanism
    posterior: Posterior | None
    validation: Validation | None
    heights: HeightErrors | None
    residuals: tuple[KindResiduals, ...]
    controllers: tuple[ControllerValues, ...]

    @property
    def verdict(self) -> Verdict:
        """The verdict; runs of early versions state none and are undecided."""
        return Verdict[str(self.result.get("verdict") or "undecided").upper()]

    @property
    def converged(self) -> bool:
        """Whether the fit converged."""
        return self.result["fit"]["status"] == "converged"

    @property
    def findings(self) -> tuple[Mapping[str, Any], ...]:
        """The findings, the most important first."""
        return tuple(self.result.get("findings") or ())

    @property
    def fitted_labels(self) -> tuple[str, ...]:
        """Labels of the fitted poses, without those that options excluded; none where an older
        version wrote the run.
        """
        labels = self.arrays.get("poses")
        excluded = self.result["fit"].get("dropped") or ()
        return () if labels is None else tuple(n for n in labels.tolist() if n not in excluded)

    @property
    def held_out_labels(self) -> tuple[str, ...]:
        """Labels of the held-out poses."""
        return tuple((self.result.get("split") or {}).get("held_out", ()))

    @property
    def readings(self) -> np.ndarray | None:
        """(n, a) readings of the fitted poses; None where the run does not contain them."""
        return self.arrays.get("frames_readings")


def build_record(
    result: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    robot: Mechanism,
    initial: Mechanism,
    source: str = "",
    controllers: tuple[ControllerValues, ...] = (),
) -> CalibrationRecord:
    """Return the record of a run.

    Parameters
    ----------
    result : content of result.json. arrays : of arrays.npz. robot : see `Run.identified_robot`.
    """
    content = restore_numbers(result)
    stored = content.get("validation")
    return CalibrationRecord(
        source=source,
        result=content,
        arrays=arrays,
        robot=robot,
        initial=initial,
        posterior=posterior_from_arrays(robot, arrays) if "posterior_unit" in arrays else None,
        validation=None if stored is None else restore_validation(stored, arrays, robot),
        heights=restore_heights(arrays, robot),
        residuals=residuals_from_arrays(arrays),
        controllers=controllers,
    )
