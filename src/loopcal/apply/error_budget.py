# SPDX-License-Identifier: Apache-2.0
"""The uncertainty budget of a calibration: parameters and poses by the sources of their errors.

The roots by source of `split_covariance` are taken to every parameter and, by the error model D, to
poses over the workspace, in the frame of `loopcal.diagnose.error_frames`. Poses have three more
errors: those of the frame itself (setup), those of the readings in use, where the actuators have a
sigma (repeatability), and what a model discrepancy leaves beyond the parameters. The squares of all
sources add up to the variance. What half a sigma would gain is computed from a covariance with all
weights changed, not from the part of the source. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from loopcal.apply.covariance_sources import (
    EARLIER,
    INSTRUMENT,
    READINGS,
    REPEATABILITY,
    SETUP,
    CovarianceSplit,
    Source,
    halve_sigma,
    split_covariance,
)
from loopcal.diagnose.error_frames import BASE, FITTED, RELATIVE
from loopcal.diagnose.fit_checks.expected_errors import ROUNDING
from loopcal.diagnose.tool_errors import ToolErrors, linearize_tool_errors, locate_measured_poses
from loopcal.errors import MechanismError
from loopcal.estimate.fit_input import check_fitted_data, exclude_poses
from loopcal.estimate.fit_linearization import FitLinearization, linearize_fit
from loopcal.estimate.frame_freedoms import find_measured_frames
from loopcal.estimate.inference.covariance_parts import TOLERANCES
from loopcal.estimate.inference.model_discrepancy import DISCREPANCY
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.findings.wording import round_to_digits
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.mechanism import Solution, sample_workspace
from loopcal.presentation import TableResult, draw
from loopcal.typing import FloatArray
from loopcal.units import Dimension

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POSES, SEED = 200, 0
"""Number of poses that are drawn from the workspace, and the seed of their draw."""

NEGLIGIBLE = 0.01
"""Share of an expected error below which the sentence leaves out a source."""

_LENGTHS = ("position", "orientation")
_OF_ROWS = (INSTRUMENT, READINGS, SETUP, TOLERANCES, EARLIER)
"""Kinds of sources whose errors the fit weighs against each other."""

PRIOR = "prior."
"""Beginning of the codes of findings on the tolerances, whose errors count as theirs."""


class ErrorSources(NamedTuple):
    """Variances [m^2 or rad^2] of the length of an error, mean over poses, by kind of source.

    `other` are the covariances that findings added, such as for correlated errors.
    """

    instrument: float
    setup: float
    tolerances: float
    repeatability: float
    readings: float = 0.0
    earlier: float = 0.0
    discrepancy: float = 0.0
    other: float = 0.0

    @property
    def rms(self) -> float:
        """Root mean square of the error from all sources [m or rad]."""
        return float(np.sqrt(sum(self)))


@dataclass(frozen=True, eq=False)
class SourceBudget:
    """What one source does, and what half its sigma would leave.

    Attributes
    ----------
    source : kind, name, type of evaluation and degrees of freedom.
    position, orientation : variances [m^2, rad^2] of the length of the error of a pose.
    parameters : (p,) variances [SI]; NaN for undetermined parameters.
    halved : root mean squares with half the sigma of this source; None where it has no sigma.
    """

    source: Source
    position: float
    orientation: float
    parameters: FloatArray
    halved: HalvedErrors | None


class HalvedErrors(NamedTuple):
    """Root mean squares of position [m] and orientation [rad] from all sources with one sigma
    halved, and the standard deviations (p,) of the parameters [SI].
    """

    position: float
    orientation: float
    parameters: FloatArray


@dataclass(frozen=True, eq=False)
class ErrorBudget(TableResult):
    """The uncertainty of the parameters and of poses over the workspace, by source.

    Attributes
    ----------
    position, orientation : variances of the tool's place and of the rotation, by kind of source.
    lines : every source. sd : (p,) standard deviations of the parameters `names` [SI]; infinite for
        undetermined ones. worst : name of the determined parameter with the largest standard
        deviation in tolerances; empty where none is determined.
    poses : number of poses. is_workspace : whether they are drawn from the workspace of the robot;
        otherwise they are those that were measured.
    finding : the errors of poses with their frame, in one sentence.
    """

    position: ErrorSources
    orientation: ErrorSources
    lines: tuple[SourceBudget, ...]
    names: tuple[str, ...]
    sd: FloatArray
    worst: str
    poses: int
    is_workspace: bool
    finding: Finding

    def plot(self) -> Figure:
        """Draw the part of each source in the expected error, and what half its sigma leaves."""
        return draw("draw_budget", self)

    def __str__(self) -> str:
        return str(self.finding)

    def __repr__(self) -> str:
        """Return the number of sources and the errors."""
        position, orientation = 1e3 * self.position.rms, 1e3 * self.orientation.rms
        return (
            f"<ErrorBudget: {len(self.lines)} sources; position {round_to_digits(position)} mm, "
            f"orientation {round_to_digits(orientation)} mrad>"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return root mean squares and variances by source for JSON, SI.

        `sources` has one entry for each source, with the variance of every parameter by name.
        """
        errors = {}
        for name in ("position", "orientation"):
            sources: ErrorSources = getattr(self, name)
            errors[name] = {"rms": sources.rms, "variances": sources._asdict()}
        place = "workspace" if self.is_workspace else "measured poses"
        return {
            **errors,
            "parameters": dict(zip(self.names, self.sd.tolist(), strict=True)),
            "worst_parameter": self.worst,
            "sources": [self._list_line(line) for line in self.lines],
            "poses": self.poses,
            "over": place,
            "frame": self.finding.data["frame"],
            "finding": self.finding,
        }

    def _list_line(self, line: SourceBudget) -> dict[str, Any]:
        """Return a source by name for JSON."""
        halved, worst_index = line.halved, self.names.index(self.worst) if self.worst else None
        source = line.source._asdict()
        if not np.isfinite(line.source.degrees):
            source["degrees"] = None
        return {
            **source,
            "position": line.position,
            "orientation": line.orientation,
            "parameters": dict(zip(self.names, line.parameters.tolist(), strict=True)),
            "halved": None
            if halved is None
            else {
                "position_rms": halved.position,
                "orientation_rms": halved.orientation,
                "worst_parameter_sd": None
                if worst_index is None
                else float(halved.parameters[worst_index]),
            },
        }


def compute_error_budget(
    fit: Identification, data: Measurements, frame: str = FITTED
) -> ErrorBudget | None:
    """Compute the uncertainty budget of a calibrated machine.

    Parameters
    ----------
    fit : an identification. data : the measurements it was made from.
    frame : in which the errors of poses are stated, see `loopcal.diagnose.choose_error_frame`;
        "relative" means relative to the home pose.

    Returns
    -------
    ErrorBudget; None where the fit has no intervals, or where no pose is reached.

    Raises
    ------
    EstimationError : no such frame.
    """
    check_fitted_data(fit, data)
    if not (fit.converged and fit.residual_test.intervals):
        return None
    data = exclude_poses(fill_in_reading_sigma(fit.robot, data), fit.options.excluded_poses)
    solution, is_workspace = _choose_poses(fit, data)
    if not len(solution.q):
        return None
    effects = linearize_tool_errors(fit.posterior, solution, frame)
    linear = linearize_fit(fit, data)
    split = split_covariance(fit, data, linear)
    lines = _list_sources(fit, split, effects, is_relative=frame == RELATIVE)
    sd = np.sqrt(sum(line.parameters for line in lines))
    sd = np.where(split.undetermined, np.inf, sd)
    places = _Places(solution, frame, effects)
    lines = [replace(each, halved=_halve(fit, data, linear, each, lines, places)) for each in lines]
    position, orientation = _add_kinds(lines)
    n = len(solution.q)
    finding = _word(fit, (position, orientation), n, is_workspace, effects.reference)
    shares = np.where(np.isfinite(sd), sd / fit.tolerance, -1.0)
    worst = fit.names[int(np.argmax(shares))] if shares.max(initial=-1.0) > 0.0 else ""
    return ErrorBudget(
        position, orientation, tuple(lines), fit.names, sd, worst, n, is_workspace, finding
    )


def _choose_poses(fit: Identification, data: Measurements) -> tuple[Solution, bool]:
    """Return poses from the workspace that the calibrated robot reaches, or the measured poses
    where it states no workspace; and which of the two.
    """
    try:
        solution = sample_workspace(fit.robot, POSES, SEED).solution
    except MechanismError:
        return locate_measured_poses(fit, data, POSES), False
    return solution.take(np.flatnonzero(solution.converged)), True


def _list_sources(
    fit: Identification, split: CovarianceSplit, effects: ToolErrors, *, is_relative: bool
) -> list[SourceBudget]:
    """Return every source with its variances.

    Errors of the frame itself are those of the set-up; those of the reference pose of relative
    errors are repeatability.
    """
    D = effects.by_parameters / fit.posterior.unit
    lines = []
    for source, root in zip(split.sources, split.roots, strict=True):
        twists = D @ root
        if source.kind == DISCREPANCY:
            twists = _select_discrepancy(effects.by_discrepancy, source.name)
        if source.kind == SETUP and not is_relative:
            twists = np.concatenate([twists, effects.by_frame], axis=2)
        variances = np.where(split.undetermined, np.nan, (root**2).sum(axis=1))
        angle, position = _mean_squares(twists)
        lines.append(SourceBudget(source, position, angle, variances, None))
    repeated = effects.by_readings
    if is_relative:
        repeated = np.concatenate([repeated, effects.by_frame], axis=2)
    if repeated.any():
        angle, position = _mean_squares(repeated)
        nothing = np.where(split.undetermined, np.nan, 0.0)
        source = Source(REPEATABILITY, "", "B", np.inf)
        lines.append(SourceBudget(source, position, angle, nothing, None))
    return lines


class _Places(NamedTuple):
    """Poses, the frame in which their errors are stated, and these errors by the parameters."""

    solution: Solution
    frame: str
    effects: ToolErrors


def _select_discrepancy(twists: FloatArray, name: str) -> FloatArray:
    """Return the twists (n, 6, k) of a model discrepancy that its position or orientation causes:
    columns are those of rotations and of places, then what is independent at each pose, likewise.
    """
    part = 1 if name == "position" else 0
    common, own = np.split(twists, [twists.shape[2] - 6], axis=2)
    return np.concatenate([np.split(each, 2, axis=2)[part] for each in (common, own)], axis=2)


def _halve(
    fit: Identification,
    data: Measurements,
    linear: FitLinearization,
    line: SourceBudget,
    lines: list[SourceBudget],
    places: _Places,
) -> HalvedErrors | None:
    """Return the errors from all sources with half the sigma of one."""
    solution, frame, effects = places
    position, orientation = (sum(getattr(each, name) for each in lines) for name in _LENGTHS)
    parameters = sum(each.parameters for each in lines)
    if line.source.kind in _OF_ROWS:
        halved = halve_sigma(fit, data, linear, line.source)
        if halved is None:
            return None
        root, linearization, problem = halved
        if frame not in (FITTED, BASE, RELATIVE):
            frames = find_measured_frames(
                problem,
                data,
                linearization.deviation,
                linearization.next_start,
                fit.options.prior,
                linearization,
                fit.residual_test.sigma_scale**2,
            )
            posterior = replace(fit.posterior, discrepancy=None, frames=frames)
            effects = linearize_tool_errors(posterior, solution, frame)
        D, own = effects.by_parameters / fit.posterior.unit, effects.by_frame
        own = own[..., :0] if frame == RELATIVE else own
        angle, place = _mean_squares(np.concatenate([D @ root, own], axis=2))
        kept = [each for each in lines if each.source.kind not in _OF_ROWS]
        place += sum(each.position for each in kept)
        angle += sum(each.orientation for each in kept)
        rest = sum((each.parameters for each in kept), np.zeros(len(root)))
        variances = rest + np.where(np.isnan(parameters), np.nan, (root**2).sum(axis=1))
    else:
        place, angle = position - 0.75 * line.position, orientation - 0.75 * line.orientation
        variances = parameters - 0.75 * line.parameters
    return HalvedErrors(float(np.sqrt(place)), float(np.sqrt(angle)), np.sqrt(variances))


def _add_kinds(lines: list[SourceBudget]) -> tuple[ErrorSources, ErrorSources]:
    """Return the variances of position and orientation by kind of source."""
    sums = [dict.fromkeys(ErrorSources._fields, 0.0) for _ in _LENGTHS]
    names = {DISCREPANCY: "discrepancy", EARLIER: "earlier"}
    for line in lines:
        kind = names.get(line.source.kind, line.source.kind)
        kind = TOLERANCES if kind.startswith(PRIOR) else kind
        for total, name in zip(sums, _LENGTHS, strict=True):
            total[kind if kind in total else "other"] += getattr(line, name)
    return ErrorSources(**sums[0]), ErrorSources(**sums[1])


def _mean_squares(twists: FloatArray) -> tuple[float, float]:
    """Return the mean over poses of the squares of rotations [rad^2] and displacements [m^2] of
    twists (n, 6, k) by independent errors of variance 1.
    """
    squares = (twists**2).sum(axis=2)
    return float(squares[:, :3].sum(axis=1).mean()), float(squares[:, 3:].sum(axis=1).mean())


def _word(
    fit: Identification,
    errors: tuple[ErrorSources, ErrorSources],
    poses: int,
    is_workspace: bool,
    reference: Finding,
) -> Finding:
    """Return the errors in one sentence."""
    stated: dict[str, Any] = {}
    dimensions = (("position", Dimension.LENGTH), ("orientation", Dimension.ANGLE))
    for (name, dimension), sources in zip(dimensions, errors, strict=True):
        size = fit.robot.size if dimension is Dimension.LENGTH else 1.0
        rms_by_source = {key: float(np.sqrt(value)) for key, value in sources._asdict().items()}
        stated[name] = None
        if sources.rms > ROUNDING * size:
            quantities = {
                key: fit.robot.to_quantity(value, dimension)
                for key, value in rms_by_source.items()
                if value > NEGLIGIBLE * sources.rms
            }
            stated[name] = (fit.robot.to_quantity(sources.rms, dimension), quantities)
    return report_finding(
        "accuracy.budget",
        **stated,
        poses=poses,
        is_workspace=is_workspace,
        tolerances_assumed=bool(fit.free_parameters.assumed.any()),
        repeatability_stated=any(actuator.sigma for actuator in fit.robot.actuators),
        **reference.data,
    )
