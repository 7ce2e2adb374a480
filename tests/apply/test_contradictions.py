# SPDX-License-Identifier: Apache-2.0
"""No sentence of a report contradicts another: verdict, findings, recommendation, limits, exit.

Machines, noises, stated sigmas and their uncertainties, limits, wrong poses and errors that no
geometry has are drawn. Each predicate is true where two statements of a report contradict.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.calibration_report import LIMIT_MISSED, CalibrationReport, Verdict
from loopcal.apply.conformity import Conformity
from loopcal.diagnose.fit_examination import StartVerdict
from loopcal.estimate.residual_test import LEVEL, SIGNIFICANCE
from loopcal.findings import Severity
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.workspace import sample_workspace
from loopcal.units import Dimension
from tests.estimate.problems import noise

KINDS = {
    "linear-delta": Component(("x", "y", "z")),
    "five-bar": Component(("x", "y")),
    "3-prs": Pose(),
}


def list_codes(report: CalibrationReport) -> set[str]:
    """Return the codes of findings of a report."""
    return {f.code for f in report.findings}


def compute_held_out_probability(report: CalibrationReport) -> float:
    """Return the probability that the values predict held-out poses better; NaN without any."""
    errors = report.validation
    if errors is None or min(errors.checked.judged, errors.checked.values_left) < 5:
        return np.nan
    known = (errors.noise.scale, errors.noise.degrees)
    every = errors.checked.kinds[-1]
    return every.compute_better_probability(*known, errors.checked.values_left)


def says(report: CalibrationReport, beginning: str) -> bool:
    """Return whether the recommendation begins so."""
    return report.recommendation.code.startswith(f"values.{beginning}")


def list_decisions(report: CalibrationReport) -> dict[str, Conformity]:
    """Return the decisions on limits by quantity at held-out poses, and for the volume."""
    judged = {} if report.validation is None else dict(report.validation.conformity)
    stated = None if report.volume is None else report.volume.conformity
    return judged if stated is None else judged | {"volume": stated}


def list_limits(report: CalibrationReport, decision: str) -> set[str]:
    """Return the quantities of which a conformity is decided so, and `volume`."""
    judged = list_decisions(report)
    return {quantity for quantity, c in judged.items() if c.decision.name == decision}


CONTRADICTIONS: dict[str, Callable[[CalibrationReport], bool]] = {
    "the exit code is 2 without a failure, or 0 with one": lambda r: (
        (r.exit_code == 2) != any(f.severity is Severity.FAILURE for f in r.findings)
    ),
    "a limit is kept and missed": lambda r: bool(
        list_limits(r, "CONFORMS")
        & {
            f.data["quantity"]
            for f in r.findings
            if f.code in {*LIMIT_MISSED, "conformity.undecided"} and not f.data.get("is_volume")
        }
    ),
    "a volume states an error that the fit does not state": lambda r: (
        r.volume is not None and not r.states_expected_error
    ),
    "no volume is stated, and nothing says why": lambda r: (
        r.volume is None and not list_codes(r) & {"accuracy.volume-open", "fit.out-of-iterations"}
    ),
    "a limit is kept in a volume, and missed at held-out poses": lambda r: (
        "position" in list_limits(r, "FAILS") and "volume" in list_limits(r, "CONFORMS")
    ),
    "a limit is missed, and the exit code is 0": lambda r: (
        bool(list_limits(r, "FAILS")) and (r.exit_code != 2 or "fails" not in r.headline)
    ),
    "a limit that is kept or open is a failure": lambda r: (
        not list_limits(r, "FAILS") and bool({f.code for f in r.failures} & LIMIT_MISSED)
    ),
    "nothing but a limit is missed, and the calibration failed": lambda r: (
        (r.verdict is Verdict.NOT_CALIBRATED) != bool({f.code for f in r.failures} - LIMIT_MISSED)
    ),
    "a limit is missed, and better values are kept": lambda r: (
        bool(list_limits(r, "FAILS"))
        and r.verdict is not Verdict.NOT_CALIBRATED
        and r.start.verdict is StartVerdict.NOT_CALIBRATED
        and compute_held_out_probability(r) >= LEVEL
        and says(r, "keep")
    ),
    "values are applied that failed": lambda r: (
        r.verdict is Verdict.NOT_CALIBRATED and says(r, "apply")
    ),
    "values are applied whose held-out errors grew": lambda r: (
        says(r, "apply")
        and ("gates.errors-grew" in list_codes(r) or compute_held_out_probability(r) < LEVEL)
    ),
    "values are applied that are within the uncertainty of the current ones": lambda r: (
        says(r, "apply") and r.start.verdict in (StartVerdict.WITHIN_NOISE, StartVerdict.BEST)
    ),
    "values are kept as equally good that match worse": lambda r: (
        says(r, "keep-within-noise") and "residuals.start-not-calibrated" in list_codes(r)
    ),
    "held-out errors grew and probably fell": lambda r: (
        "gates.errors-grew" in list_codes(r) and compute_held_out_probability(r) >= LEVEL
    ),
    "the residuals fail, although the uncertainty of sigma allows them": lambda r: (
        (r.identification.residual_test.p_value < SIGNIFICANCE)
        != ("noise.residuals-too-large" in {f.code for f in r.failures})
    ),
    "the next step uses values that are kept": lambda r: (
        r.next_step.code == "workflow.next-use-result" and not says(r, "apply")
    ),
    "the next step keeps values that are applied": lambda r: (
        r.next_step.code in ("workflow.next-keep-values", "workflow.next-state-noise")
        and says(r, "apply")
    ),
    "calibrated beside a warning": lambda r: (
        r.verdict is Verdict.CALIBRATED
        and any(f.severity in (Severity.WARNING, Severity.FAILURE) for f in r.findings)
    ),
    "a decision is not the one of its probability": lambda r: any(
        (c.decision.name == "CONFORMS") != (c.bound <= c.limit * (1.0 + 1e-5))
        or (c.decision.name == "FAILS") != (c.floor >= c.limit * (1.0 - 1e-5))
        for c in list_decisions(r).values()
        if abs(c.probability - LEVEL) > 1e-3 and abs(c.most_probable - 1.0 + LEVEL) > 1e-3
    ),
}


def draw_report(name: str, seed: int) -> CalibrationReport:
    """Calibrate a drawn machine with drawn noise, and test a drawn limit."""
    rng, nominal = np.random.default_rng(seed), lc.load_robot(name)
    sigma = 10.0 ** rng.uniform(-6.0, -4.5)  # [m]
    kind = KINDS[name]
    scale = [
        sigma if c.dimension is Dimension.LENGTH else sigma / nominal.size
        for c in kind.noise_columns
    ]
    truth = nominal.with_values(
        nominal.values
        + 10.0 ** rng.uniform(-2.0, 0.0) * (sample_truth(nominal, 1, seed=seed)[0] - nominal.values)
    )
    poses = sample_workspace(nominal, int(rng.integers(12, 40)), seed).coordinates
    instrument = Instrument((Sensor(kind, noise(*scale)),))
    data = simulate(truth, poses, instrument, seed, controller=nominal)
    (rows,) = data.observations
    measured = rows.measured.copy()
    if rng.random() < 0.2:  # a wrong pose
        measured[rng.integers(len(measured)), -1] += 30.0 * sigma
    if rng.random() < 0.2:  # errors that no geometry has
        measured[:, -1] += 3.0 * sigma * np.sin(np.linspace(0.0, 9.0, len(measured)))
    stated = rows.covariance / rng.choice([0.8, 1.0, 1.0, 1.25, 2.0, 4.0]) ** 2
    changed = replace(rows, measured=measured, covariance=stated)
    data = replace(data, observations=(changed,))
    options = lc.CalibrationOptions(
        hold_out=float(rng.choice([0.2, 0.4])),
        seed=seed,
        limit_position=sigma * 10.0 ** rng.uniform(-0.5, 1.0),
        volume=sample_workspace(nominal, 20, seed).coordinates,
        check_conventions=False,
        fit=lc.FitOptions(sigma_uncertainty=float(rng.choice([0.0, 0.1, 0.25, 0.5]))),
    )
    return lc.calibrate(nominal, data, options)


def find_contradictions(report: CalibrationReport) -> list[str]:
    """Return the contradictions of a report."""
    return [words for words, is_there in CONTRADICTIONS.items() if is_there(report)]


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize(
    "seeds", [range(2), pytest.param(range(2, 60), marks=pytest.mark.evidence)], ids=["few", "many"]
)
def test_no_sentence_of_a_report_contradicts_another(name: str, seeds: range) -> None:
    found = {seed: find_contradictions(draw_report(name, seed)) for seed in seeds}
    assert not {seed: words for seed, words in found.items() if words}
