# SPDX-License-Identifier: Apache-2.0
"""Measurements in one interpretation, or many at once, against a robot free within its tolerances.

Interpretations that differ in measured values share poses and sensitivities: they are the trials of
one problem. An interpretation of the readings has its own poses. Every interpretation has its own
nuisance parameters (frames, targets, surfaces) and its own excluded rows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal import engine
from loopcal.diagnose.conventions.interpretations import Interpretation
from loopcal.errors import DataError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import Linearization
from loopcal.estimate.nuisance.elimination import plan_elimination
from loopcal.estimate.observation_rows import ObservationRows, Residuals
from loopcal.estimate.problem import Problem, problem_of
from loopcal.estimate.start import Start
from loopcal.measure import Measurements, NuisanceParameters
from loopcal.measure.initial_values import guess_nuisance_values_batch
from loopcal.mechanism import find_directly_reachable, forward, forward_trials
from loopcal.numerics.gauss_newton import Halving
from loopcal.typing import BoolArray, FloatArray, IntArray

FEWEST = 8
"""Smallest number of equations beyond those of unknown frames that gives a misfit."""

FAR, MOST_EXCLUDED = 5.0, 0.25
"""Rows this many times the median row away are excluded, up to this share of the rows; the check
for outliers names them.
"""

LARGEST_STEP = 30.0
"""Tolerances that a parameter may leave nominal in the steps below; beyond, the first-order misfit
stays.
"""

CANDIDATES, STEPS = 2, 8
"""Candidates for unknown frames, and steps of their descents, where many interpretations are
compared before a few are judged.
"""

MOST_STEPS = 30
"""Steps of the descents where a few interpretations are judged."""

FOLLOWED = 8
"""Number of poses that Newton's method does not reach from home at once, and that are tried along a
path before all others.
"""

FRAME_STEPS, QUICK_FRAME_STEPS = (8, 6), (3, 2)
"""Steps, and halvings of each, to the best frames; an interpretation that fits needs two or three.
"""

ROUNDS = 3
"""Gauss-Newton steps by which the stated convention and the best other one are compared finally."""


class InterpretedData:
    """Measurements in t interpretations of their values that share readings, at the robot's values.

    Parameters
    ----------
    free : the robot's parameters. data : the measurements in the (first) interpretation; poses out
        of reach are omitted.
    interpretations : of the values of `data`, one for each trial; default: as written.
    applied : what `data` already assume, where they are not as written.
    is_quick : whether frames need only be near their best values. start : (t, U) nuisance
        parameters to start from; default: guessed from the data.

    Attributes
    ----------
    n_reached, n_tested : poses that the robot reaches, and that were tried. has_enough : whether
        enough poses are reached.
    excluded : labels of the rows of the first interpretation that are far off the others.
    has_failed : whether nuisance parameters cannot be found from these rows.
    """

    def __init__(
        self,
        free: FreeParameters,
        data: Measurements,
        interpretations: tuple[Interpretation, ...] = (),
        applied: Interpretation | None = None,
        is_quick: bool = False,
        start: FloatArray | None = None,
    ) -> None:
        self.free, self.applied, self.is_quick = free, applied, is_quick
        reached, self.n_tested = _find_reached(free, data, follow=applied is None)
        self.n_reached = int(reached.sum())
        self.has_enough = self.n_reached >= (1.0 - MOST_EXCLUDED) * self.n_tested
        self.whole = data
        self.data = data if reached.all() or not self.has_enough else data.take(reached)
        self.t = max(len(interpretations), 1)
        self.used = [i for i, o in enumerate(self.data.observations) if len(o)]
        self.nuisance = self.data.nuisance_parameters
        self.all_rows = self._interpret_rows(interpretations)
        self.z = np.repeat(free.deviation(free.robot.values[None]), self.t, axis=0)
        self.start = start
        self.has_failed = False
        self.excluded: tuple[str, ...] = ()
        self.problem = self._build_problem(self.all_rows)
        self.at: Linearization | None = None

    @property
    def values(self) -> FloatArray:
        """(U,) nuisance parameters of the first interpretation, after `misfits`."""
        values = self._nuisance_values()
        return self.nuisance.values() if values is None else values[0]

    def misfit(self) -> float:
        """Return the misfit of the first interpretation; infinite where poses are out of reach, NaN
        with too few rows.
        """
        return float(self.misfits()[0])

    def misfits(self) -> FloatArray:
        """Return the misfit (t,) of every interpretation, to first order about the robot's values;
        all NaN if one cannot be evaluated (`has_failed`).
        """
        if not self.has_enough:
            return np.full(self.t, np.inf)
        try:
            if self.start is None and len(self.nuisance):
                self._guess_start()
            self.at = self.problem.linearize(self.z, self._warm_start())
        except DataError:  # these rows do not locate a target; the fit words the reason
            self.has_failed = True
            return np.full(self.t, np.nan)
        cost = _smallest_cost(self.at.factor, np.zeros_like(self.z))
        return _misfit_of_cost(cost, self.at.equations)

    def exclude_far_rows(self) -> None:
        """Exclude the rows of each interpretation that are far off its others; call it after
        `misfits`. `excluded` then has the labels of those of the first one.
        """
        if not self.has_enough or self.has_failed:
            return
        trials = np.arange(self.t)
        sd = self.expected_sd()
        ratios = [_row_rms(r.whitened, a) for r, a in zip(self.residuals(), sd, strict=True)]
        together = np.concatenate(ratios, axis=1)
        median = np.nanmedian(together, axis=1)
        limit = np.maximum(FAR * median, np.nanquantile(together, 1.0 - MOST_EXCLUDED, axis=1))
        if not np.any(together > limit[:, None]):
            return
        kept_rows = []
        for rows, ratio in zip(self.all_rows, ratios, strict=True):
            kept = ~(ratio > limit[:, None])
            far = rows.poses.reshape(len(kept[0]), -1)[~kept[0]]
            self.excluded += tuple("/".join(self.data.labels[i] for i in poses) for poses in far)
            whitener = rows.take_trials(trials)[1] * kept[..., None, None]
            kept_rows.append(replace(rows, whitener=whitener))
        values = self._nuisance_values()
        if values is not None:
            self.start = None if self.t == 1 and not self.is_quick else values
        self.problem, self.at = self._build_problem(tuple(kept_rows)), None

    def residuals(self) -> tuple[Residuals, ...]:
        """Return the residuals of every interpretation, after `misfits`."""
        assert self.at is not None
        solution = self.problem.solve(self.z, self.at.next_start, self._nuisance_values())
        return self.problem.residuals(self.z, solution)

    def expected_sd(self) -> list[FloatArray]:
        """Return the standard deviations (r, m) [1] of whitened residuals by tolerances and noise,
        after `misfits`.
        """
        assert self.at is not None
        result = [np.ones(rows.whitener.shape[1:3]) for rows in self.problem.rows]
        first = np.arange(1)
        blocks = self.problem.take(first).leverage_rows(self.at.take(first))
        for block, parts in zip(self.problem.poses.blocks, blocks, strict=True):
            for part in parts:
                A = part.rows[..., -len(self.free) - 1 : -1]
                chosen = block.row_numbers[part.kind][part.numbers]
                result[part.kind][chosen] = np.sqrt(1.0 + (A**2).sum(axis=-1))
        return result

    def _interpret_rows(
        self, interpretations: tuple[Interpretation, ...]
    ) -> tuple[ObservationRows, ...]:
        """Rows of every kind; a row that another interpretation leaves without some of its
        residuals is absent there.
        """
        rows = []
        for i in self.used:
            o = self.data.observations[i]
            if interpretations:
                measured = np.stack([one.measured(self.data)[i] for one in interpretations])
            else:
                measured = o.measured[None]
            same = (o.kind.detect_present(measured) == o.present).all(axis=-1)
            whitener = o.whitener * same[..., None, None]
            nuisance = self.nuisance.indices[i]
            rows.append(ObservationRows(o.kind, o.rows, measured, whitener, nuisance))
        return tuple(rows)

    def _guess_start(self) -> None:
        """Guess nuisance parameters for every interpretation; absent rows do not count where there
        is one interpretation.
        """
        robot = self.free.robot
        T = forward_trials(robot, robot.values[None], self.data.readings[None]).T
        observations = list(self.data.observations)
        measured = [np.broadcast_to(o.measured, (self.t, *o.measured.shape)) for o in observations]
        for i, rows in zip(self.used, self.all_rows, strict=True):
            measured[i] = np.broadcast_to(rows.measured, measured[i].shape)
            if self.t == 1:
                present = np.any(rows.whitener[0] != 0.0, axis=(1, 2))
                observations[i] = observations[i].with_weights(present * observations[i].weight)
        most, steps = (CANDIDATES, STEPS) if self.is_quick else (None, MOST_STEPS)
        data = replace(self.data, observations=tuple(observations))
        self.start = guess_nuisance_values_batch(
            data, measured, T, self.nuisance, most=most, steps=steps
        )

    def _nuisance_values(self) -> FloatArray | None:
        """Nuisance parameters (t, U) of every interpretation after `misfits`; None without any."""
        at = self.at
        return None if at is None or at.nuisance is None else at.nuisance.values

    def _warm_start(self) -> Start:
        """Start values of the next linearization."""
        if self.at is not None:
            return self.at.next_start
        start = self.problem.start(self.z, seek=False)
        return start if self.start is None else start.with_nuisance(self.start)

    def _build_problem(self, rows: tuple[ObservationRows, ...]) -> Problem:
        nuisance = NuisanceParameters(self.nuisance.table, tuple(r.nuisance for r in rows))
        return Problem(
            self.free,
            self.data.readings[None],
            rows,
            np.arange(self.t),
            plan_elimination(nuisance, rows),
            lambda _: self.data,
            control=Halving(*(QUICK_FRAME_STEPS if self.is_quick else FRAME_STEPS)),
        )


def compute_quick_misfit(free: FreeParameters, data: Measurements) -> float:
    """Return an upper bound of the misfit of measurements as written, in one step of a fit.

    Unknown frames start only from their nominal values. The result is infinite where a pose is out
    of reach, and NaN with too few rows.
    """
    if not find_directly_reachable(free.robot, free.robot.values[None], data.readings[None]).all():
        return np.inf
    problem = problem_of(free, data)
    z = free.deviation(free.robot.values[None])
    with np.errstate(all="ignore"):
        at = problem.linearize(z, problem.start(z, seek=False))
        if not np.isfinite(at.cost[0]):
            return np.inf
        return float(_misfit_of_cost(_smallest_cost(at.factor, np.zeros_like(z)), at.equations)[0])


def refine_misfit(interpreted: InterpretedData) -> float:
    """Return the misfit of the first interpretation after Gauss-Newton steps within the tolerances;
    infinite where it cannot be computed.
    """
    if not interpreted.has_enough or not np.isfinite(interpreted.misfit()):
        return np.inf
    z, step, best = interpreted.z[:1], np.zeros_like(interpreted.z[:1]), np.inf
    p, first, at = z.shape[1], np.arange(1), interpreted.at
    assert at is not None
    problem, start = interpreted.problem.take(first), at.next_start.take(first)
    for _ in range(ROUNDS + 1):
        at = problem.linearize(z + step, start)
        if not np.isfinite(at.cost[0]):
            break
        misfit = float(_misfit_of_cost(at.cost + (step**2).sum(axis=1), at.equations)[0])
        if p == 0 or not misfit < best:
            best = min(best, misfit)
            break
        best, start, interpreted.at = misfit, at.next_start, at
        whole = engine.fold(at.factor, np.concatenate([np.eye(p), step.T], axis=1)[None])[0]
        step = step - np.linalg.solve(whole[:p, :p], whole[:p, p])[None]
        if np.abs(step).max() > LARGEST_STEP:
            break
    return best


def guess_setups(
    free: FreeParameters, data: Measurements, readings: FloatArray, reached: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Guess nuisance parameters (h, U) for h sets of readings (h, n, a) of one set of values.

    Parameters
    ----------
    reached : (h, n) poses that the robot reaches; the others are taken at home.

    Returns
    -------
    start : (h, U)
    misfit : (h,) median over rows of the size of whitened residuals [1], the robot as it is.
    """
    robot, nuisance, h = free.robot, data.nuisance_parameters, len(readings)
    T = np.broadcast_to(robot.home_state.T.reshape(-1, 4, 4)[0], (*reached.shape, 4, 4)).copy()
    T[reached] = forward_trials(robot, robot.values[None], readings[reached][None]).T[0]
    measured = [np.broadcast_to(o.measured, (h, *o.measured.shape)) for o in data.observations]
    start = guess_nuisance_values_batch(data, measured, T, nuisance, most=CANDIDATES, steps=STEPS)
    sizes = [np.zeros((h, 0))]
    for o, places in zip(data.observations, nuisance.indices, strict=True):
        if len(o) and not o.kind.sensed_joints:
            residual = o.kind.evaluate(T[:, o.rows], o.measured[None], start[:, places]).residual
            whitened = np.matmul(o.whitener, residual[..., None])[..., 0]
            sizes.append(np.linalg.norm(whitened, axis=-1))
    size = np.concatenate(sizes, axis=1)
    return start, np.median(size, axis=1) if size.shape[1] else np.zeros(h)


def _find_reached(
    free: FreeParameters, data: Measurements, *, follow: bool
) -> tuple[BoolArray, int]:
    """Poses (n,) that the robot reaches with the readings, and how many were tried.

    A few poses that are not reached at once are followed along a path before all others are,
    because failures take longest.
    """
    robot, q = free.robot, data.readings
    reached = find_directly_reachable(robot, robot.values[None], q[None])[0]
    if not follow or reached.sum() >= (1.0 - MOST_EXCLUDED) * len(q):
        return reached, len(q)
    hard = np.flatnonzero(~reached)
    sampled = hard[np.unique(np.linspace(0, len(hard) - 1, FOLLOWED).astype(np.intp))]
    reached[sampled] = forward(robot, q[sampled]).converged
    if len(sampled) < len(hard) and reached[sampled].mean() >= 1.0 - MOST_EXCLUDED:
        rest = np.setdiff1d(hard, sampled)
        reached[rest] = forward(robot, q[rest]).converged
        return reached, len(q)
    return reached, len(q) - len(hard) + len(sampled)


def _smallest_cost(factor: FloatArray, step: FloatArray) -> FloatArray:
    """Smallest |R z + r|^2 + |step + z|^2 (t,) of factors (t, p + 1, p + 1)."""
    t, p = step.shape
    prior = np.concatenate([np.broadcast_to(np.eye(p), (t, p, p)), step[..., None]], axis=-1)
    return engine.fold(factor, prior)[:, -1, -1] ** 2 if p else factor[:, -1, -1] ** 2


def _misfit_of_cost(cost: FloatArray, rows: IntArray) -> FloatArray:
    """Root mean square (t,) over the equations; NaN with too few."""
    return np.where(rows >= FEWEST, np.sqrt(cost / np.maximum(rows, 1)), np.nan)


def _row_rms(whitened: FloatArray, sd: FloatArray) -> FloatArray:
    """Root mean square (t, r) of the present residuals (t, r, m) over their sd (r, m); NaN for
    absent rows.
    """
    present = whitened != 0.0
    count = present.sum(axis=-1)
    total = ((whitened / sd) ** 2).sum(axis=-1)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))
