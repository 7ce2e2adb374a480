# SPDX-License-Identifier: Apache-2.0
"""Findings of a calibration: what its parts noticed, with their severity for the whole."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from loopcal.apply.height_errors import measures_only_heights
from loopcal.apply.validation import FEW_ROWS, Validation
from loopcal.apply.verdict import BASE_MOVED
from loopcal.diagnose.gauge_freedoms import GaugeFreedoms, find_gauge_freedoms
from loopcal.estimate.null_space import Combination
from loopcal.estimate.posterior import Posterior
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, Severity, report_finding
from loopcal.measure.kinds.joints import Closure
from loopcal.measure.measurements import Measurements
from loopcal.units import Dimension

# Finding that a calibration is not expected to improve on the tolerances.
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
    checked = errors.without_blunders or errors  # a wrong measurement says nothing of the geometry
    if checked.judged < FEW_ROWS:
        few = report_finding("workflow.few-held-out-poses", count=checked.judged, needed=FEW_ROWS)
        return [*own, few]
    if checked.values_left < FEW_ROWS:
        values, setup = checked.kinds[-1].count, checked.setup_count
        return [*own, report_finding("workflow.held-out-setup", values=values, setup=setup)]
    return own + [
        report_finding("gates.errors-grew", quantity=quantity, times=1.0 / change.times)
        for quantity, change in checked.changes().items()
        if change.has_grown
    ]


def report_scale(fit: Identification, data: Measurements) -> list[Finding]:
    """Return that heights do not test the fixed lengths from which x and y have their scale."""
    if not fit.converged or not measures_only_heights(data):
        return []
    table = fit.robot.parameters
    columns = zip(table.names, table.dimensions, table.free, strict=True)
    names = tuple(n for n, d, is_free in columns if not is_free and d is Dimension.LENGTH)
    return [report_finding("workflow.undetermined-scale", names=names)] if names else []


def report_freedoms(fit: Identification, data: Measurements) -> list[Finding]:
    """Return whether open combinations only move frames, or change poses."""
    if not fit.converged or not fit.unidentifiable:
        return []

    freedoms = sort_undetermined(fit.posterior, fit.unidentifiable, len(fit.names) - fit.rank)
    motions, count = freedoms.motions, freedoms.changing_count
    findings = [report_readings_gauge(motions, freedoms.count)] if is_readings_alone(data) else []
    if motions.count:
        moved: dict[str, Any] = {"count": motions.count, "frames": tuple(motions.frames)}
        findings.append(report_finding("workflow.frame-freedoms", **moved))
    if count > 0:
        changing: dict[str, Any] = {"count": count, "names": freedoms.names}
        findings.append(report_finding("workflow.undetermined-combinations", **changing))
    return findings


@dataclass(frozen=True)
class UndeterminedCombinations:
    """The combinations that data do not determine."""

    motions: GaugeFreedoms  # of frames by these combinations
    count: int  # of all
    changing: tuple[Combination, ...]  # combinations that may change poses
    names: tuple[str, ...]  # of the parameters in these

    @property
    def changing_count(self) -> int:
        """Number of combinations that change poses."""
        return self.count - self.motions.count


def sort_undetermined(
    posterior: Posterior, unidentifiable: tuple[Combination, ...], count: int
) -> UndeterminedCombinations:
    """Separate the combinations that only move frames from those that change poses.

    A combination with a meaning, such as the place of a frame, changes no pose. Where all have one,
    but they are more than the motions of frames, the parameters of all are named.
    """
    changing = tuple(c for c in unidentifiable if not c.meaning)
    names = dict.fromkeys(name for c in changing or unidentifiable for name in c.names)
    return UndeterminedCombinations(find_gauge_freedoms(posterior), count, changing, tuple(names))


def is_readings_alone(data: Measurements) -> bool:
    """Return whether measurements have no measured column."""
    return all(isinstance(rows.kind, Closure) for rows in data.observations)


def report_readings_gauge(motions: GaugeFreedoms, count: int) -> Finding:
    """Return what `count` open combinations are: the place of frames, the size, and others."""
    others = count - motions.count - motions.has_scale
    combinations = (
        {"what": "frames", "frames": motions.frames, "count": motions.count},
        {"what": "scale", "frames": (), "count": int(motions.has_scale)},
        {"what": "others", "frames": (), "count": others},
    )
    kept = tuple(part for part in combinations if part["count"])
    return report_finding("identifiability.readings-gauge", parts=kept)
