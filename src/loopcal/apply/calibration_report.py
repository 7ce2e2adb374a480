# SPDX-License-Identifier: Apache-2.0
"""The result of a calibration: everything that text, JSON and run folder show; its findings with
their severity for the whole, the verdict, and the next step.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from loopcal.apply.calibration_options import CalibrationOptions, DataSplit
from loopcal.apply.height_errors import (
    PREFIX,
    SHIFT_UNDECIDED,
    TILT_UNDECIDED,
    HeightErrors,
    measures_only_heights,
)
from loopcal.apply.validation import FEW_ROWS, Validation, store_differences
from loopcal.apply.volume_accuracy import VolumeAccuracy
from loopcal.diagnose.conventions.convention_check import ConventionCheck
from loopcal.diagnose.fit_examination import FitExamination, ReadingError, StartCheck, StartVerdict
from loopcal.diagnose.gauge_freedoms import report_undetermined
from loopcal.diagnose.value_comparison import ValueComparison
from loopcal.errors import DataError
from loopcal.estimate.residual_test import LEVEL, SIGNIFICANCE, ResidualTest
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Severity, report_finding
from loopcal.findings.catalog import find_entry
from loopcal.findings.wording import name_count
from loopcal.measure.kinds.joints import Closure
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import InstrumentRecord, list_instruments
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.statistics import find_distinct
from loopcal.results.deferred import DeferredFields, deferred
from loopcal.results.description import Field, Records, fields
from loopcal.results.result import TableResult
from loopcal.results.serialization import json_fields, to_json
from loopcal.results.storage import store_arrays
from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.apply.error_budget import ErrorBudget
    from loopcal.apply.repeatability import Repeatability
    from loopcal.diagnose.cross_validation import ModelChoice
    from loopcal.diagnose.identifiable_parameters import MeasurementSuggestion
    from loopcal.estimate.recalibration import Change

TOP = 3  # findings that a summary shows
# Findings that ask for more or other held-out poses.
TOO_FEW_HELD_OUT = {
    "workflow.few-held-out-poses",
    "workflow.held-out-setup",
    "workflow.nothing-to-validate",
}
BLUNDER = "validation.blunder"  # finding on held-out poses that do not fit
# Findings that leave the verdict open.
TOO_LITTLE_VALIDATION = {
    "workflow.no-held-out-poses",
    *TOO_FEW_HELD_OUT,
    "validation.blunders-dominate",
}
ALL_POSES = "outliers.all-poses"  # finding on outliers before poses were held out
FAR_OFF = "conventions.rows-far-off"  # finding on rows far off the others before the fit
LEAVE_OUT = "values.leave-out"  # recommendation to calibrate without a wrong pose
CHECK_FIRST = "values.check-first"  # recommendation to check what heights do not show
# Findings that values are beyond their stated expected spreads, and the factor from which another
# unit or order of readings is as probable.
BEYOND_SPREADS, FAR = {"prior.tolerances-inflated", "prior.tolerances-too-narrow"}, 10.0
# Number of poses up to which one that is wrong changes the values by more than their uncertainty.
FEW_POSES = 50
SEARCH_LEVEL = 0.001  # probability of excluding a pose of all where none is wrong
# Finding that a limit was stated for something that no row measures.
LIMIT_NOT_MEASURED = "gates.limit-not-measured"
# Findings that a limit is not met: a statement beside the verdict, which is about the geometry.
LIMIT_MISSED = {"conformity.fails", "gates.limit-exceeded", LIMIT_NOT_MEASURED}
LIMIT_OPEN = "conformity.undecided"  # finding that noise leaves open whether a limit is kept
# Finding that heights fit with either sign: the wrong one leads to the wrong geometry.
SIGN_UNDECIDED = "conventions.height-sign-undecided"
# Next step of a good calibration whose values are not recommended.
NEXT_WITH_VALUES = {
    "values.keep-undecided": "workflow.next-state-noise",
    "values.keep-within-noise": "workflow.next-keep-values",
    "values.keep-not-confirmed": "workflow.next-keep-values",
}
# Findings that an instrument or a target on the base moved.
BASE_MOVED = {"residuals.frame-moved", "residuals.base-targets-moved"}
# Findings that residuals are not independent: a cause of large residuals other than sigma.
DEPENDENT = {
    "residuals.drift",
    "residuals.trend",
    "residuals.sessions-differ",
    "residuals.shared-errors",
    "residuals.depend-on-temperature",
    "residuals.depend-on-reading",
    "residuals.correlated",
    "residuals.model-discrepancy",
}
# Finding that a calibration is not expected to improve on the spreads.
NO_GAIN = "model.no-expected-gain"
ON_BASE = (*BASE_MOVED, "data.base-session-unused")  # findings on targets on the base
# Factor on sigma from which an estimated noise is no property of an instrument.
UNUSUAL_NOISE = 10.0


def report_fit(fit: Identification) -> list[Finding]:
    """Return the findings of the fit, with the severity that they have for a calibration.

    A contradiction with the stated noise is a failure. Single open combinations are worth knowing;
    whether they affect accuracy is reported once for all of them, see `report_freedoms`.
    """
    severities = {
        "noise.residuals-too-large": Severity.FAILURE,
        "fit.unidentifiable": Severity.INFO,
    }
    return [replace(f, severity=severities.get(f.code, f.severity)) for f in fit.findings]


def explains_residuals(fit: Identification) -> bool:
    """Return whether the covariance of a fit is that of its errors: not where the residuals
    contradict the noise, and no discrepancy of the model explains that, and not where they are
    doubtful.
    """
    test = fit.residual_test
    return (fit.posterior.discrepancy is not None or not test.failed) and not test.is_doubtful


def report_unexplained(fit: Identification, examined: Iterable[Finding]) -> list[Finding]:
    """Return whether an estimated noise takes in the whole of measurements that do not fit.

    Residuals contradict no noise that they determine themselves.
    """
    test = fit.residual_test
    is_unusual = test.noise != "given" and test.sigma_scale >= UNUSUAL_NOISE
    if not is_unusual or all(finding.code != NO_GAIN for finding in examined):
        return []
    return [report_finding("fit.explains-nothing", scale=test.sigma_scale)]


def report_validation(errors: Validation | None, is_held_out: bool) -> list[Finding]:
    """Return the findings of the validation, and whether it supports a verdict.

    Errors on fitted poses prove nothing; of these only the poses that are out of reach are listed.
    """
    if not is_held_out:
        missed = () if errors is None else errors.findings
        unreachable = [f for f in missed if f.code == "validation.unreachable-poses"]
        return [report_finding("workflow.no-held-out-poses"), *unreachable]
    if errors is None:
        return []
    own = [f for f in errors.findings if f.code not in ON_BASE]  # reported once for all rows
    checked = errors.checked
    if checked.judged < FEW_ROWS:
        few = report_finding("workflow.few-held-out-poses", count=checked.judged, needed=FEW_ROWS)
        return [*own, few]
    if checked.values_left < FEW_ROWS:
        values, setup = checked.kinds[-1].count, checked.setup_count
        return [*own, report_finding("workflow.held-out-setup", values=values, setup=setup)]
    return own + [
        report_finding("gates.errors-grew", quantity=quantity, times=change.growth)
        for quantity, change in checked.changes().items()
        if change.has_grown
    ]


def report_heights(
    fit: Identification, data: Measurements, heights: HeightErrors | None
) -> list[Finding]:
    """Return what heights alone do not test: the fixed lengths from which x and y have their scale,
    and by their errors the zero of the probe and the bed.
    """
    if not fit.converged or not measures_only_heights(data):
        return []
    table = fit.robot.parameters
    columns = zip(table.names, table.dimensions, table.free, strict=True)
    names = tuple(n for n, d, is_free in columns if not is_free and d is Dimension.LENGTH)
    findings = [] if heights is None else heights.report_alternatives(len(fit.names))
    scale = [report_finding("workflow.undetermined-scale", names=names)] if names else []
    return [*findings, *scale]


def list_checks(findings: Iterable[Finding]) -> dict[str, Any]:
    """Return which causes of heights beside the machine explain them as well: the zero of the
    probe, the bed; empty without any.
    """
    data = {finding.code: finding.data for finding in findings}
    is_tilted = bool(data.get(TILT_UNDECIDED, {}).get("alone"))
    checks = {"is_shifted": SHIFT_UNDECIDED in data, "is_tilted": is_tilted}
    return checks if any(checks.values()) else {}


def report_freedoms(fit: Identification, data: Measurements) -> list[Finding]:
    """Return whether open combinations are harmless, or change poses."""
    if not fit.converged or not fit.unidentifiable:
        return []
    codes = ("workflow.frame-freedoms", "workflow.undetermined-combinations")
    alone = is_readings_alone(data)
    free = replace(fit.free_parameters, robot=fit.robot)
    return report_undetermined(free, fit.unidentifiable, codes, alone)[0]


def is_readings_alone(data: Measurements) -> bool:
    """Return whether measurements have no measured column."""
    return all(isinstance(rows.kind, Closure) for rows in data.observations)


MOST_ACTIONS = 2  # actions at most that the next step states where there are several warnings


class Verdict(Enum):
    """Whether the calibrated geometry can be used; the value is how people read it."""

    CALIBRATED = "calibrated"
    RESERVATIONS = "calibrated with reservations"
    NOT_CALIBRATED = "not calibrated"
    UNDECIDED = "undecided"


def decide_verdict(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict that findings lead to.

    1. Not calibrated: any failure but that of a limit. Failures are a fit that did not converge, a
       geometry that reaches no held-out pose, residuals that contradict the stated noise and its
       uncertainty, an estimated noise that explains everything, and errors on held-out poses that
       grew by more than 10 % and beyond noise (without poses that do not fit).
    2. Undecided: no pose was held out, or too few to judge an error, or the setup parameters that
       were fitted to them leave no measured value to check, or poses that do not fit dominate the
       errors.
    3. Calibrated with reservations: any warning, such as outliers, a prior that the data
       contradict, or undetermined parameter combinations that change poses; or a missed limit.
    4. Calibrated: everything else.

    The first rule that applies decides.
    """
    findings = tuple(findings)
    severities, codes = {f.severity for f in findings}, {f.code for f in findings}
    if list_failures(findings) - LIMIT_MISSED:
        return Verdict.NOT_CALIBRATED
    if codes & TOO_LITTLE_VALIDATION:
        return Verdict.UNDECIDED
    if severities & {Severity.WARNING, Severity.FAILURE}:
        return Verdict.RESERVATIONS
    return Verdict.CALIBRATED


def list_failures(findings: Iterable[Finding]) -> AbstractSet[str]:
    """Return the codes of quality gates that are not met."""
    return {f.code for f in findings if f.severity is Severity.FAILURE}


def choose_next_step(
    verdict: Verdict,
    findings: Sequence[Finding],
    outliers: Sequence[str],
    recommendation: str,
    repeatability: Mapping[str, float] | None = None,
) -> Finding:
    """Return the step that helps most now, as a suggestion.

    findings : of the calibration. outliers : labels of poses that do not fit the others.
    recommendation : code of the finding that recommends the identified or the current values.
    repeatability : its share of the variance of the expected error, by quantity.
    """
    codes = {finding.code for finding in findings}
    if recommendation == CHECK_FIRST:
        return report_finding("workflow.next-check-heights", **list_checks(findings))
    is_applied = verdict is not Verdict.NOT_CALIBRATED and recommendation.startswith("values.apply")
    if is_applied and SIGN_UNDECIDED in codes:
        return report_finding("workflow.next-check-height-sign")
    failed = list_failures(findings)
    warned = {f.code for f in findings if f.severity is Severity.WARNING}
    if failed | warned and failed <= LIMIT_MISSED and warned <= {LIMIT_OPEN}:
        return _choose_limit_step(failed, findings, repeatability or {})
    if verdict is Verdict.CALIBRATED:
        return report_finding(NEXT_WITH_VALUES.get(recommendation, "workflow.next-use-result"))
    if codes & BASE_MOVED:
        return report_finding("workflow.next-check-base-targets")
    wrong = dict.fromkeys(label for f in findings if f.code == BLUNDER for label in f.data["poses"])
    if wrong and (failed or verdict is not Verdict.RESERVATIONS):
        poses = tuple(f"pose {label}" for label in wrong)
        return report_finding("workflow.next-check-held-out", poses=poses)
    if verdict is Verdict.UNDECIDED:
        more = "hold-out-more" if codes & TOO_FEW_HELD_OUT else "hold-out"
        # too few poses to hold any out
        is_doubtful = recommendation == "values.keep-doubtful-residuals"
        return report_finding(f"workflow.next-{'measure-more' if is_doubtful else more}")
    if outliers:
        poses = tuple(f"pose {label}" for label in outliers)
        return report_finding("workflow.next-check-outliers", poses=poses)
    if verdict is Verdict.RESERVATIONS:
        actions = dict.fromkeys(f.action for f in findings if f.code in warned)
        stated = " ".join(list(actions)[:MOST_ACTIONS])
        return report_finding("workflow.next-resolve-warnings", actions=stated)
    if any(code.startswith("fit.") for code in failed) or "gates.poses-unreachable" in failed:
        return report_finding("workflow.next-check-data")
    if any(code.startswith("noise.") for code in failed):
        if codes & DEPENDENT:
            return report_finding("workflow.next-check-residuals")
        return report_finding("workflow.next-check-noise")
    return report_finding("workflow.next-measure-more")


def _choose_limit_step(
    failed: AbstractSet[str], findings: Sequence[Finding], repeatability: Mapping[str, float]
) -> Finding:
    """Return the next step where nothing but limits is missed or open.

    failed : codes of the failures. repeatability : see `choose_next_step`.
    """
    step, codes = "less-noise", {LIMIT_OPEN}
    if failed:
        is_measured = failed != {LIMIT_NOT_MEASURED}
        step = "improve-accuracy" if is_measured else "measure-quantity"
        codes = failed - {LIMIT_NOT_MEASURED} if is_measured else failed
    quantities = dict.fromkeys(str(f.data["quantity"]) for f in findings if f.code in codes)
    for quantity in quantities:
        share = repeatability.get(quantity, 0.0)
        if step == "improve-accuracy" and share > 0.5:
            return report_finding("workflow.next-improve-machine", share=share, quantity=quantity)
    return report_finding(f"workflow.next-{step}", quantity=" and ".join(quantities))


# Whether a machine is given the identified values or keeps its current ones.


def recommend_values(
    verdict: Verdict,
    start: StartCheck,
    residual_test: ResidualTest,
    errors: Validation | None,
    findings: Iterable[Finding] = (),
) -> Finding:
    """Return the recommendation to apply the identified values or to keep the current ones.

    Values are applied that are better beyond the noise at the fitted poses, and at the held-out
    ones with the probability `LEVEL`. Slow errors that neighboring poses share make both uncertain:
    where they explain the gain at the fitted poses, the held-out ones decide alone.

    start : the current values against the fit. residual_test : of the fit, for the scale of the
        noise. errors : at held-out poses; None without any. findings : of the calibration.
    """
    if verdict is Verdict.NOT_CALIBRATED:
        return report_finding("values.keep-not-calibrated")
    if start.verdict in (StartVerdict.BEST, StartVerdict.WITHIN_NOISE):
        return report_finding("values.keep-within-noise")
    is_open = start.verdict is StartVerdict.OPEN
    checked = None if errors is None else errors.checked
    if checked is None or min(checked.judged, checked.values_left) < FEW_ROWS:
        if is_open:
            return report_finding("values.keep-undecided")
        if start.verdict is StartVerdict.WITHIN_ERRORS:  # only other regions could show a gain
            return report_finding("values.keep-within-noise")
        if residual_test.is_doubtful:
            return report_finding("values.keep-doubtful-residuals")
        is_gain = all(finding.code != NO_GAIN for finding in findings)
        return report_finding("values.apply-fitted" if is_gain else "values.keep-no-gain")
    known = (0.0, 0.0) if is_open else (checked.noise.scale, checked.noise.degrees)
    every = checked.kinds[-1]
    probability = every.compute_better_probability(*known, checked.values_left)
    if is_open:
        # nothing but the held-out poses speaks for the values
        code = "apply-held-out" if 1.0 - probability < SIGNIFICANCE else "keep-undecided"
    else:
        code = "apply" if probability >= LEVEL else "keep-not-confirmed"
    stated: dict[str, Any] = {"probability": probability, "needed": LEVEL}
    stated["is_slow"] = every.slow > 0.0
    return report_finding(f"values.{code}", poses=checked.judged, **stated)


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
    if fit.robot.redundancy is not None:
        return data.n_poses - len(fit.excluded_poses)
    is_measured = np.zeros(data.n_poses, dtype=bool)
    for rows in data.observations:
        counted = (rows.weight > 0.0) & rows.present.any(axis=1)
        is_measured[rows.rows[counted]] = True
    return int(is_measured.sum())


@dataclass(frozen=True, eq=False, repr=False)
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
        all is well, or that another one counts.
        """
        notable = tuple(f for f in self.findings if not find_entry(f.code).routine)
        return notable[: max(TOP, len(self.failures))]

    def list_outliers(self, level: float = 1.0) -> tuple[str, ...]:
        """Return labels of poses that do not fit the other fitted poses, or all other poses.

        level : probability, of all tests of the fitted poses, below which one is listed.
        """
        named = {f.code: f.data for f in self.findings}
        labels = [*named[ALL_POSES]["poses"]] if ALL_POSES in named else []
        if self.examination is not None:
            check = self.examination.outliers
            clear = (o.poses for o in check.outliers if o.p_value * check.blocks < level)
            labels += [label for poses in clear for label in poses]
        elif FAR_OFF in named:  # why the fit did not converge
            fitted = self.split.fitted.labels
            labels += [label for label in named[FAR_OFF]["poses"] if label in fitted]
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
        open_codes = (*NEXT_WITH_VALUES, "values.apply", "values.keep-not-calibrated")
        is_open = advice.code.startswith(open_codes)
        if is_open and outliers and fitted <= FEW_POSES:
            return report_finding(LEAVE_OUT, poses=outliers)
        if advice.code.startswith("values.apply") and (checks := list_checks(self.findings)):
            return report_finding(CHECK_FIRST, **checks)
        ratios = (f.data["ratio"] for f in self.findings if f.code in BEYOND_SPREADS)
        if advice.code.startswith("values.apply") and (far := max(ratios, default=0.0)) > FAR:
            return report_finding("values.check-nominal", ratio=far)
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
            **({} if heights is None else store_arrays(heights, PREFIX)),
        }

    def records(self) -> Records:
        """Return the numbers of the fit."""
        return self.identification.records()

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON values by name, SI; a number that is not finite is None."""
        return to_json(json_fields(self))
