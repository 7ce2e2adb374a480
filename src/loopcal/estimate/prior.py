# SPDX-License-Identifier: Apache-2.0
"""An earlier calibration as the prior of the next one: its whitened rows join the new rows.

A posterior e ~ N(mean, C), C = diag(unit) V diag(var) V' diag(unit), equals the rows B (e - mean)
of unit variance with B = diag(var)^(-1/2) V^-1 diag(1 / unit); a direction of infinite variance has
no row. Least squares over these and the new rows is the joint estimate of both calibrations. To
free a limb that was repaired, its columns are eliminated from B by an orthogonal reduction, which
is the marginal distribution of the others. V is well conditioned (orthonormal, if all parameters
have a prior); neither J'J nor C is inverted. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from loopcal import engine
from loopcal.errors import DataError, EstimationError, suggest_names
from loopcal.estimate.linearization import Linearization, Start
from loopcal.estimate.posterior import Posterior
from loopcal.estimate.problem import Problem
from loopcal.measure.fitted_rows import FittedRows
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import find_null_space, intersect_spaces
from loopcal.plain_text import represent
from loopcal.typing import FloatArray, IntArray

ELIMINATED = 1e-11
"""Share of the largest singular value below which an eliminated column depends on the others."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Rows B (e - mean) with independent errors of unit variance.

    Attributes
    ----------
    names : (p,) parameters. mean, unit : (p,) [SI]; `unit` makes columns comparable.
    rows : (r, p) B [1 / SI].
    unfixed : (12, k) motions of frames that the earlier measurements do not determine, see
        `FrameKnowledge`; None where it is not known.
    fitted_rows : the measured rows that it comes from; None where they are not known.
    """

    names: tuple[str, ...]
    mean: FloatArray
    unit: FloatArray
    rows: FloatArray
    unfixed: FloatArray | None = None
    fitted_rows: FittedRows | None = None

    __repr__ = represent

    def added(self, problem: Problem, errors: FloatArray | None = None) -> WithPrior:
        """Return the problem of these rows and the rows of the prior, for the descent.

        `errors` (t, r) are added to the rows of the prior, as errors drawn for resamples.
        """
        return WithPrior(problem, self, errors)

    def without(self, names: Sequence[str]) -> Prior:
        """Return the marginal prior of the other parameters, without information on these."""
        freed = np.isin(self.names, names)
        u, s, _ = np.linalg.svd((self.rows * self.unit)[:, freed], full_matrices=True)
        rank = int((s > ELIMINATED * s[0]).sum()) if len(s) else 0
        rows = u[:, rank:].T @ self.rows
        rows[:, freed] = 0.0
        return replace(self, rows=rows)

    def toleranced(self, names: Sequence[str], mean: FloatArray, tolerance: FloatArray) -> Prior:
        """Return this prior with independent rows (e - mean) / tolerance for some parameters of
        which it knows nothing.
        """
        places = [self.names.index(name) for name in names]
        more, center = np.zeros((len(names), len(self.names))), self.mean.copy()
        more[np.arange(len(names)), places] = 1.0 / tolerance
        center[places] = mean
        return replace(self, mean=center, rows=np.concatenate([self.rows, more]))


class WithPrior:
    """Rows of measurements followed by those of a prior; a `Problem` of the descent.

    A direction that neither calibration determines must stay unknown. Both have the same null
    direction, but each at its own linearization; the small angle between the two would count as
    information. Null directions of the measured rows that are parallel to one of the prior's are
    therefore removed from the rows of the prior.
    """

    parameters: int
    slope: FloatArray
    center: FloatArray
    constant: FloatArray
    unknown: FloatArray

    def __init__(self, problem: Problem, prior: Prior, errors: FloatArray | None = None) -> None:
        free = problem.free
        table = free.robot.parameters
        places = np.array([table.index(name) for name in prior.names], dtype=np.int64)
        B = np.zeros((len(prior.rows), len(table)))
        B[:, places] = prior.rows
        mean = free.robot.values.copy()
        mean[places] = prior.mean
        self.measured = problem
        self.parameters = problem.parameters
        self.slope = np.zeros((len(B), len(free)))
        self.slope[:, : len(free.places)] = B[:, free.places] * free.tolerance
        self.center = free.deviation(mean[None])
        # parameters that are no longer free contribute their difference from the mean
        self.constant = np.atleast_2d(B @ (free.values(self.center)[0] - mean))
        if errors is not None:
            self.constant = self.constant + errors
        self.unknown = find_null_space(self.slope)

    def start(self, deviation: FloatArray) -> Start:
        """Return the warm start of the measurements."""
        return self.measured.start(deviation)

    def take(self, trials: IntArray) -> WithPrior:
        """Return the problem of some trials."""
        other = copy(self)
        other.measured = self.measured.take(trials)
        if len(self.constant) > 1:
            other.constant = self.constant[trials]
        return other

    def residuals(self, deviation: FloatArray) -> FloatArray:
        """Return the residuals (t, r) of the rows of the prior at deviations (t, p)."""
        change = np.matmul(self.slope, (deviation - self.center)[..., None])[..., 0]
        return change + self.constant

    def linearize(self, deviation: FloatArray, start: Start) -> Linearization:
        """Linearize the measurements and append the rows of the prior."""
        return self.append(self.measured.linearize(deviation, start))

    def append(self, measured: Linearization) -> Linearization:
        """Return the linearized measurements with the rows of the prior."""
        if not len(self.slope):
            return measured
        slope = self.list_slopes(measured)
        change = measured.deviation - self.center
        residual = np.matmul(slope, change[..., None])[..., 0] + self.constant
        rows = np.concatenate([slope, residual[..., None]], axis=2)
        return replace(
            measured,
            factor=engine.fold(measured.factor, rows),
            cost=measured.cost + (residual**2).sum(axis=1),
            equations=measured.equations + len(self.slope),
        )

    def list_slopes(self, measured: Linearization) -> FloatArray:
        """Return the rows (t, r, p) of the prior, without the null directions of the measured rows
        that it does not know either.
        """
        slopes = np.repeat(self.slope[None], len(measured.deviation), axis=0)
        for i, triangle in enumerate(measured.factor[:, :-1, :-1]):
            if self.unknown.shape[1] and np.isfinite(triangle).all():
                common = intersect_spaces(find_null_space(triangle), self.unknown)
                slopes[i] -= (slopes[i] @ common) @ common.T
        return slopes


def prior_from(earlier: Posterior) -> Prior:
    """Return an earlier calibration as a prior: a full Gaussian over all directions that it knows.

    Raises
    ------
    EstimationError : the earlier calibration has no intervals.
    """
    if np.isnan(earlier.variance).any():
        raise EstimationError.of("prior.no-uncertainty")
    known = np.isfinite(earlier.variance)
    whitening = np.diag(1.0 / np.sqrt(np.where(known, earlier.variance, 1.0)))[known]
    rows = np.linalg.solve(earlier.directions.T, whitening.T).T / earlier.unit
    unfixed = None if earlier.frames is None else earlier.frames.unfixed
    estimate, fitted = np.array(earlier.estimate), earlier.fitted_rows
    return Prior(earlier.names, estimate, earlier.unit, rows, unfixed, fitted)


def refuse_reused_rows(earlier: Prior | Posterior | None, data: Measurements) -> None:
    """Refuse measurements of which an earlier calibration has used rows: they would count twice.

    Raises DataError `prior.rows-reused`, with the labels of the poses to exclude.
    """
    if earlier is None or earlier.fitted_rows is None:
        return
    reused = earlier.fitted_rows.find_in(data)
    if reused.count:
        others = reused.total - reused.count
        raise DataError.of("prior.rows-reused", **reused._asdict(), others=others)


def limb_parameters(robot: Mechanism, limb: str) -> tuple[str, ...]:
    """Return the free parameters of a limb: those whose names begin with its name and a point.

    EstimationError : the limb has no free parameter; the text names the limbs that have.
    """
    free = [p.name for p in robot.parameters.entries if p.free]
    names = tuple(name for name in free if name.startswith(f"{limb}."))
    if not names:
        limbs = list(dict.fromkeys(name.split(".")[0] for name in free if "." in name))
        raise EstimationError(
            f"{robot.name} has no limb {limb!r} with free parameters{suggest_names(limb, limbs)}; "
            f"limbs with free parameters are {', '.join(limbs)}"
        )
    return names
