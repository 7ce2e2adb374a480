# SPDX-License-Identifier: Apache-2.0
"""The result of a calibration: everything that text, JSON and run folder show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from loopcal.apply import height_errors
from loopcal.apply.calibration_options import CalibrationOptions, DataSplit
from loopcal.apply.validation import store_differences
from loopcal.apply.verdict import (
    ALL_POSES,
    CHECK_FIRST,
    FEW_POSES,
    LEAVE_OUT,
    LIMIT_MISSED,
    SEARCH_LEVEL,
    Verdict,
    choose_next_step,
    decide_verdict,
    explains_residuals,
    list_checks,
    recommend_values,
)
from loopcal.errors import DataError
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Severity, report_finding
from loopcal.findings.catalog import find_entry
from loopcal.findings.wording import name_count
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import InstrumentRecord, list_instruments
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.statistics import find_distinct
from loopcal.results.deferred import DeferredFields, deferred
from loopcal.results.description import Field, Records, fields
from loopcal.results.result import TableResult
from loopcal.results.serialization import json_fields, to_json
from loopcal.results.storage import store_arrays

if TYPE_CHECKING:
    from loopcal.apply.error_budget import ErrorBudget
    from loopcal.apply.height_errors import HeightErrors
    from loopcal.apply.repeatability import Repeatability
    from loopcal.apply.validation import Validation
    from loopcal.apply.volume_accuracy import VolumeAccuracy
    from loopcal.diagnose.conventions.convention_check import ConventionCheck
    from loopcal.diagnose.cross_validation import ModelChoice
    from loopcal.diagnose.fit_examination import FitExamination, ReadingError, StartCheck
    from loopcal.diagnose.identifiable_parameters import MeasurementSuggestion
    from loopcal.diagnose.value_comparison import ValueComparison
    from loopcal.estimate.recalibration import Change

TOP = 3  # findings that a summary shows


@dataclass(frozen=True)
class Provenance:
    """Where a result comes from, as far as it is known without files."""

    versions: Mapping[str, str]  # of loopcal, numpy, scipy and python, and the engine that computed
    seeds: Mapping[str, int]  # by name
    options: Mapping[str, Any]  # as plain data


def _count_fitted_poses(fit: Identification, data: Measurements) -> int:
    """Return the number of poses that the fit uses: those with measured values; where actuators are
    redundant, all that are not excluded.
    """
    if fit.robot.program.sigma is not None:
        return data.n_poses - len(fit.excluded_poses)
    is_measured = np.zeros(data.n_poses, dtype=bool)
    for rows in data.observations:
        counted = (rows.weight > 0.0) & rows.present.any(axis=1)
        is_measured[rows.rows[counted]] = True
    return int(is_measured.sum())


@dataclass(frozen=True, eq=False)
class CalibrationReport(DeferredFields, TableResult):
    """The result of `calibrate`. Its budget is computed when it is first asked for.

    Attributes
    ----------
    options : as given. split : which poses were fitted, and which were held out.
    identification : the fit. start : the geometry before calibration against the fit.
    conventions : units, signs and columns of the data against the robot.
    validation : errors on held-out poses; None without held-out poses, or where they could not be
        predicted or the fit did not converge.
    fitted_errors : errors on the fitted poses where no pose was held out; they are optimistic. None
        where the fit did not converge.
    height_errors : errors of measured heights, fitted and held-out; None where the data measure
        none, the platform does more than translate, or the fit did not converge.
    findings : everything noticed, the most important first.
    budget : uncertainty of parameters and of poses over the workspace by source; None where there
        are no intervals.
    examination : outliers, lack of fit, correlations and expected gain; None where the fit did not
        converge.
    suggestions : further measurements that determine open parameter combinations.
    reading_errors : recorded actuator readings against the estimated ones; None for exact readings.
    model_choice : the comparison of parameter sets, where it was asked for.
    change : whether the machine changed since the earlier calibration that is the prior.
    comparison : the joint test of stored values, where they were given.
    volume : the largest position error in the volume of the options; None without one, or where the
        fit states no error.
    provenance : versions, seeds and options.
    """

    options: CalibrationOptions
    split: DataSplit
    identification: Identification
    start: StartCheck
    conventions: ConventionCheck
    validation: Validation | None
    fitted_errors: Validation | None
    height_errors: HeightErrors | None
    findings: tuple[Finding, ...]
    examination: FitExamination | None
    suggestions: tuple[MeasurementSuggestion, ...] | None
    reading_errors: tuple[ReadingError, ...] | None
    model_choice: ModelChoice | None
    change: Change | None
    comparison: ValueComparison | None
    volume: VolumeAccuracy | None
    provenance: Provenance
    budget: ErrorBudget | None = deferred()

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("verdict", "headline", "states_expected_error", "findings", "recommendation"),
        *fields("next_step", passed=lambda report: not report.failures),
        *fields(reasons=lambda report: list(map(str, report.failures)), fit="identification"),
        *fields("start", split=lambda report: report.split.to_dict()),
        *fields("instruments", "validation"),
        Field("change", is_optional=True),
        Field("expected_error", "budget", is_optional=True),
        Field("volume", is_optional=True),
        Field("repeatability", is_optional=True),
        Field("comparison", is_optional=True),
        Field("model_choice", is_optional=True),
        Field("examination", is_optional=True),
        Field("remedies", "suggestions", is_optional=True),
        Field("reading_errors", is_optional=True),
        Field("height_errors", is_optional=True),
        *fields(options="provenance.options"),
    )

    @property
    def robot(self) -> Mechanism:
        """The calibrated robot."""
        return self.identification.robot

    @cached_property
    def verdict(self) -> Verdict:
        """Whether the geometry can be used; the rules are those of `decide_verdict`."""
        return decide_verdict(self.findings)

    @property
    def has_failed(self) -> bool:
        """Whether the identified values are for no machine."""
        return self.verdict is Verdict.NOT_CALIBRATED

    @property
    def exit_code(self) -> int:
        """2 where a quality gate is not met, be it that of a limit, else 0."""
        return 2 if self.failures else 0

    @property
    def failures(self) -> tuple[Finding, ...]:
        """Findings of quality gates that are not met."""
        return tuple(f for f in self.findings if f.severity is Severity.FAILURE)

    @cached_property
    def repeatability(self) -> Repeatability | None:
        """Pose accuracy and repeatability by ISO 9283 of the calibrated robot where poses were
        visited several times: held-out poses, else fitted ones, whose accuracy is optimistic.
        """
        from loopcal.apply.repeatability import assess_repeatability

        fit = self.identification
        setup = {} if fit.nuisance is None else fit.nuisance.values
        for data in (self.split.held_out, self.split.fitted) if fit.converged else ():
            if data is not None and len(find_distinct(data.repeats)) < data.n_poses:
                try:
                    return assess_repeatability(self.robot, data, setup)
                except DataError:  # no positions or orientations
                    continue
        return None

    @property
    def instruments(self) -> tuple[InstrumentRecord, ...]:
        """The stated instruments of all measurements, each once."""
        return list_instruments(self.split.list_observations())

    @property
    def top_findings(self) -> tuple[Finding, ...]:
        """The two or three most important findings; all failures among them, none that says that
        all is well.
        """
        notable = tuple(f for f in self.findings if not find_entry(f.code).routine)
        return notable[: max(TOP, len(self.failures))]

    def list_outliers(self, level: float = 1.0) -> tuple[str, ...]:
        """Return labels of poses that do not fit the other fitted poses, or all other poses.

        level : probability, of all tests of the fitted poses, below which one is listed.
        """
        labels = [label for f in self.findings if f.code == ALL_POSES for label in f.data["poses"]]
        if self.examination is not None:
            check = self.examination.outliers
            clear = (o.poses for o in check.outliers if o.p_value * check.blocks < level)
            labels += [label for poses in clear for label in poses]
        return tuple(dict.fromkeys(labels))

    @cached_property
    def next_step(self) -> Finding:
        """The step that helps most now."""
        if self.recommendation.code == LEAVE_OUT:
            return report_finding("workflow.next-check-outliers", **self.recommendation.data)
        repeatability = {}
        if self.budget is not None and self.states_expected_error:
            sources = {"position": self.budget.position, "orientation": self.budget.orientation}
            repeatability = {
                quantity: errors.repeatability / sum(errors)
                for quantity, errors in sources.items()
                if sum(errors) > 0.0
            }
        return choose_next_step(
            self.verdict,
            self.findings,
            self.list_outliers(),
            self.recommendation.code,
            repeatability,
        )

    @cached_property
    def recommendation(self) -> Finding:
        """Whether to apply the identified values or to keep the current ones."""
        test = self.identification.residual_test
        advice = recommend_values(self.verdict, self.start, test, self.validation, self.findings)
        fitted = _count_fitted_poses(self.identification, self.split.fitted)
        outliers = tuple(f"pose {label}" for label in self.list_outliers(SEARCH_LEVEL))
        is_open = advice.code.startswith(("values.apply", "values.keep-not-calibrated"))
        if is_open and outliers and fitted <= FEW_POSES:
            return report_finding(LEAVE_OUT, poses=outliers)
        if advice.code.startswith("values.apply") and (checks := list_checks(self.findings)):
            return report_finding(CHECK_FIRST, **checks)
        return advice

    @property
    def states_expected_error(self) -> bool:
        """Whether the budget is the expected error of the machine, see `explains_residuals`."""
        return self.budget is not None and explains_residuals(self.identification)

    @property
    def headline(self) -> str:
        """The verdict in one sentence."""
        fit = self.identification
        fitted, verdict = _count_fitted_poses(fit, self.split.fitted), self.verdict.value
        missed = dict.fromkeys(
            str(f.data["quantity"]) for f in self.findings if f.code in LIMIT_MISSED
        )
        return (
            f"{verdict[0].upper()}{verdict[1:]}: {self.robot.name}, {len(fit.names)} parameters "
            f"from {name_count(fitted, 'pose')}."
            + (f" The limit of {' and '.join(missed)} fails." if missed else "")
        )

    __repr__ = TableResult.__str__

    def arrays(self) -> dict[str, np.ndarray]:
        """Return arrays to store [SI]: those of the fit, the `initial` values of all parameters,
        labels of the fitted `poses`, differences at held-out poses, and errors of heights.
        """
        fit, errors, heights = self.identification, self.validation, self.height_errors
        return {
            **fit.arrays(),
            "initial": fit.initial.values,
            "poses": np.array(self.split.fitted.labels, str),
            **({} if errors is None else store_differences(errors)),
            **({} if heights is None else store_arrays(heights, height_errors.PREFIX)),
        }

    def records(self) -> Records:
        """Return the numbers of the fit."""
        return self.identification.records()

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON values by name, SI; a number that is not finite is None."""
        return to_json(json_fields(self))
