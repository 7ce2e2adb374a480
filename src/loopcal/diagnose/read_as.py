# SPDX-License-Identifier: Apache-2.0
"""Measurements read in one way, or in many ways at once, against a robot free within its
tolerances.

Ways that differ in measured values share poses and sensitivities and are the trials of one set of
rows; a way to read the readings has poses of its own. Every way has its own frames, targets and
surfaces, and its own blunders left out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal import engine
from loopcal.diagnose.interpretations import Interpretation
from loopcal.errors import DataError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import Linearization
from loopcal.estimate.nuisance import plan_elimination
from loopcal.estimate.observation_rows import ObservationRows, Residuals
from loopcal.estimate.problem import Problem, problem_of
from loopcal.estimate.start import Start
from loopcal.measure import Measurements, NuisanceParameters
from loopcal.measure.initial_values import guess_nuisance_values_batch
from loopcal.mechanism import find_directly_reachable, forward, forward_trials
from loopcal.numerics.gauss_newton import Halving
from loopcal.typing import FloatArray

FEWEST = 8
"""Equations beyond those that unknown frames take up, without which nothing is said."""

FAR, MOST_LEFT_OUT = 5.0, 0.25
"""Rows this many times the median row away are blunders, up to this share of the rows: their own
check names them.
"""

LARGEST = 30.0
"""Tolerances a parameter may be off while the steps below are taken; beyond, the first-order misfit
stands.
"""

CANDIDATES, STEPS = 2, 8
"""Candidates for unknown frames and steps of their descents by which many ways are compared before
a few are judged.
"""

FOLLOWED = 8
"""Poses that Newton does not reach from home at once that are tried along a path before all of them
are.
"""

LONGEST = 30
"""Steps of the descents where a few ways are judged."""

SETTLING, SETTLING_QUICKLY = (8, 6), (3, 2)
"""Steps, and halvings of each, to the best frames from where they begin; a way that fits takes two
or three steps.
"""

ROUNDS = 3
"""Gauss-Newton steps by which the stated convention and the best other one are compared in the end.
"""


def quick_misfit(free: FreeParameters, data: Measurements) -> float:
    """The misfit of measurements as written, unknown frames sought from their nominal values only:
    an upper bound.

    It costs one step of a fit. Infinite where a pose is out of reach; NaN where too few rows are
    left.
    """
    if not find_directly_reachable(free.robot, free.robot.values[None], data.readings[None]).all():
        return np.inf
    problem = problem_of(free, data)
    z = free.deviation(free.robot.values[None])
    with np.errstate(all="ignore"):
        at = problem.linearize(z, problem.start(z, seek=False))
        found = (
            _rms(_cost(at.factor, np.zeros_like(z)), at.equations)
            if np.isfinite(at.cost[0])
            else np.full(1, np.inf)
        )
    return float(found[0])


class InterpretedData:
    """Measurements read in one way, or in t ways that share readings: their rows at the robot's own
    values.

    Parameters
    ----------
    free : the robot's parameters. data : the measurements under the (first) reading; poses out of
        reach are left out.
    ways : hypotheses about the values of `data`, one for each trial; default: as written.
    hypothesis : what `data` supposes already, where it is not what was written.
    quick : whether frames need only be near their best. begin : (t, U) frames to begin with;
        default: sought.
    """

    def __init__(
        self,
        free: FreeParameters,
        data: Measurements,
        ways: tuple[Interpretation, ...] = (),
        hypothesis: Interpretation | None = None,
        quick: bool = False,
        begin: FloatArray | None = None,
    ) -> None:
        self.free, self.hypothesis, self.found, self.quick = free, hypothesis, float("nan"), quick
        solved, tried = _reached(free, data, follow=hypothesis is None)
        fewest = (1.0 - MOST_LEFT_OUT) * tried
        self.reached, self.poses = int(solved.sum()), tried
        self.enough = self.reached >= fewest
        self.whole = data
        self.data = data if solved.all() or not self.enough else data.take(solved)
        self.t = max(len(ways), 1)
        self.seen = [i for i, o in enumerate(self.data.observations) if len(o)]
        self.local = self.data.nuisance_parameters
        self.sensed = self._sensed(ways)
        self.z = np.repeat(free.deviation(free.robot.values[None]), self.t, axis=0)
        self.begin = begin
        self.failed = False
        self.left_out: tuple[str, ...] = ()
        self.problem = self._make_problem(self.sensed)
        self.at: Linearization | None = None

    def misfit(self) -> float:
        """The misfit of the first way; infinite where poses are out of reach, NaN where too few
        rows are left.
        """
        return float(self.misfits()[0])

    def misfits(self) -> FloatArray:
        """The misfit of every way, to first order about the robot's values; all NaN if one cannot
        be evaluated (`failed`).
        """
        if not self.enough:
            return np.full(self.t, np.inf)
        try:
            if self.begin is None and len(self.local):
                self._start()
            self.at = self.problem.linearize(self.z, self._warm_start())
        except (
            DataError
        ):  # where something is cannot be found from these rows: the fit says it in its own words
            self.failed = True
            return np.full(self.t, np.nan)
        return _rms(_cost(self.at.factor, np.zeros_like(self.z)), self.at.equations)

    def leave_out(self) -> None:
        """Leave out the rows of each way that stand far from its others; to be called after
        `misfits`.

        `left_out` then has the labels of those of the first way.
        """
        if not self.enough or self.failed:
            return
        every = np.arange(self.t)
        sd = self.allowed()
        weights = []
        ratios = [_row_rms(r.whitened, a) for r, a in zip(self.residuals(), sd, strict=True)]
        together = np.concatenate(ratios, axis=1)
        middle = np.nanmedian(together, axis=1)
        limit = np.maximum(FAR * middle, np.nanquantile(together, 1.0 - MOST_LEFT_OUT, axis=1))
        if not np.any(together > limit[:, None]):
            return
        for s, ratio in zip(self.sensed, ratios, strict=True):
            kept = ~(ratio > limit[:, None])
            far = s.poses.reshape(len(kept[0]), -1)[~kept[0]]
            self.left_out += tuple("/".join(self.data.labels[i] for i in poses) for poses in far)
            weights.append(replace(s, whitener=s.take_trials(every)[1] * kept[..., None, None]))
        if self.nuisance is not None:
            self.begin = None if self.t == 1 and not self.quick else self.nuisance
        self.problem, self.at = self._make_problem(tuple(weights)), None

    def residuals(self) -> tuple[Residuals, ...]:
        """Residuals of every way with the frames that `misfits` found."""
        assert self.at is not None
        solution = self.problem.solve(self.z, self.at.next_start, self.nuisance)
        return self.problem.residuals(self.z, solution)

    @property
    def nuisance(self) -> FloatArray | None:
        """Nuisance parameters (t, U) of every way after `misfits`; None without any."""
        at = self.at
        return None if at is None or at.nuisance is None else at.nuisance.values

    def allowed(self) -> list[FloatArray]:
        """Standard deviations (r, m) [1] of whitened residuals by tolerances and noise, after
        `misfits`.
        """
        found = [np.ones(s.whitener.shape[1:3]) for s in self.sensed]
        assert self.at is not None
        first = np.arange(1)
        given = self.problem.take(first).leverage_rows(self.at.take(first))
        for block, parts in zip(self.problem.poses.blocks, given, strict=True):
            for part in parts:
                A = part.rows[..., -len(self.free) - 1 : -1]
                chosen = block.row_numbers[part.kind][part.numbers]
                found[part.kind][chosen] = np.sqrt(1.0 + (A**2).sum(axis=-1))
        return found

    def _sensed(self, ways: tuple[Interpretation, ...]) -> tuple[ObservationRows, ...]:
        """Rows of every kind; a row that another way of reading leaves without some of its
        residuals is absent there.
        """
        made = []
        for i in self.seen:
            o = self.data.observations[i]
            measured = (
                np.stack([way.measured(self.data)[i] for way in ways]) if ways else o.measured[None]
            )
            same = (o.kind.detect_present(measured) == o.present).all(axis=-1)
            white = o.whitener * same[..., None, None]
            made.append(ObservationRows(o.kind, o.rows, measured, white, self.local.indices[i]))
        return tuple(made)

    def _start(self) -> None:
        """Find frames for every way, to begin with; blunders that were left out have no say where
        there is one way.
        """
        T = forward_trials(
            self.free.robot, self.free.robot.values[None], self.data.readings[None]
        ).T
        observations = list(self.data.observations)
        measured = [np.broadcast_to(o.measured, (self.t, *o.measured.shape)) for o in observations]
        for i, s in zip(self.seen, self.sensed, strict=True):
            measured[i] = np.broadcast_to(s.measured, measured[i].shape)
            if self.t == 1:
                observations[i] = observations[i].with_weights(
                    np.any(s.whitener[0] != 0.0, axis=(1, 2)) * observations[i].weight
                )
        most, steps = (CANDIDATES, STEPS) if self.quick else (None, LONGEST)
        data = replace(self.data, observations=tuple(observations))
        self.begin = guess_nuisance_values_batch(
            data, measured, T, self.local, most=most, steps=steps
        )

    def _warm_start(self) -> Start:
        """Where the next linearization begins."""
        if self.at is not None:
            return self.at.next_start
        start = self.problem.start(self.z, seek=False)
        return start if self.begin is None else start.with_nuisance(self.begin)

    def _make_problem(self, rows: tuple[ObservationRows, ...]) -> Problem:
        local = NuisanceParameters(self.local.table, tuple(r.nuisance for r in rows))
        steps, attempts = SETTLING_QUICKLY if self.quick else SETTLING
        return Problem(
            self.free,
            self.data.readings[None],
            rows,
            np.arange(self.t),
            plan_elimination(local, rows),
            lambda _: self.data,
            control=Halving(steps, attempts),
        )


def begun(
    free: FreeParameters, data: Measurements, readings: FloatArray, solved: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Frames (h, U) for h sets of readings (h, n, a) of the same measured values, and what they
    leave.

    Parameters
    ----------
    solved : (h, n) which poses the robot reaches; the others are taken at home.

    Returns
    -------
    begin : (h, U)
    left : (h,) median over rows of the size of whitened residuals [1], the robot as it is.
    """
    robot, local, h = free.robot, data.nuisance_parameters, len(readings)
    T = np.broadcast_to(robot.home_state.T.reshape(-1, 4, 4)[0], (*solved.shape, 4, 4)).copy()
    T[solved] = forward_trials(robot, robot.values[None], readings[solved][None]).T[0]
    measured = [np.broadcast_to(o.measured, (h, *o.measured.shape)) for o in data.observations]
    begin = guess_nuisance_values_batch(data, measured, T, local, most=CANDIDATES, steps=STEPS)
    sizes = [np.zeros((h, 0))]
    for o, places in zip(data.observations, local.indices, strict=True):
        if len(o) and not o.kind.sensed_joints:
            seen = o.kind.evaluate(T[:, o.rows], o.measured[None], begin[:, places]).residual
            sizes.append(np.linalg.norm(np.matmul(o.whitener, seen[..., None])[..., 0], axis=-1))
    every = np.concatenate(sizes, axis=1)
    return begin, np.median(every, axis=1) if every.shape[1] else np.zeros(h)


def _reached(free: FreeParameters, data: Measurements, *, follow: bool) -> tuple[np.ndarray, int]:
    """Which poses (n,) the robot reaches with the readings, and how many were tried.

    Few poses that are not reached at once are followed along a path before all of them are: failing
    takes longest.
    """
    robot, q = free.robot, data.readings
    solved = find_directly_reachable(robot, robot.values[None], q[None])[0]
    if not follow or solved.sum() >= (1.0 - MOST_LEFT_OUT) * len(q):
        return solved, len(q)
    hard = np.flatnonzero(~solved)
    some = hard[np.unique(np.linspace(0, len(hard) - 1, FOLLOWED).astype(np.intp))]
    solved[some] = forward(robot, q[some]).converged
    if len(some) < len(hard) and solved[some].mean() >= 1.0 - MOST_LEFT_OUT:
        rest = np.setdiff1d(hard, some)
        solved[rest] = forward(robot, q[rest]).converged
        return solved, len(q)
    return solved, len(q) - len(hard) + len(some)


def _cost(factor: FloatArray, moved: FloatArray) -> FloatArray:
    """Smallest |R z + r|^2 + |moved + z|^2 (t,) of factors (t, p + 1, p + 1)."""
    t, p = moved.shape
    prior = np.concatenate([np.broadcast_to(np.eye(p), (t, p, p)), moved[..., None]], axis=-1)
    return engine.fold(factor, prior)[:, -1, -1] ** 2 if p else factor[:, -1, -1] ** 2


def _rms(cost: FloatArray, rows: np.ndarray) -> FloatArray:
    return np.where(rows >= FEWEST, np.sqrt(cost / np.maximum(rows, 1)), np.nan)


def _row_rms(whitened: FloatArray, sd: FloatArray) -> FloatArray:
    """Root mean square (t, r) of the present residuals (t, r, m) over their sd (r, m); NaN for
    absent rows.
    """
    there = whitened != 0.0
    count = there.sum(axis=-1)
    total = ((whitened / sd) ** 2).sum(axis=-1)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def refined(way: InterpretedData) -> float:
    """The misfit of the first way after Gauss-Newton steps within the tolerances; infinite where it
    cannot be found.
    """
    if not way.enough or not np.isfinite(way.misfit()):
        return np.inf
    z, moved, best = way.z[:1], np.zeros_like(way.z[:1]), np.inf
    p = z.shape[1]
    problem, at = way.problem.take(np.arange(1)), way.at
    assert at is not None
    start = at.next_start.take(np.arange(1))
    for _ in range(ROUNDS + 1):
        at = problem.linearize(z + moved, start)
        if not np.isfinite(at.cost[0]):
            break
        now = float(_rms(at.cost + (moved**2).sum(axis=1), at.equations)[0])
        if p == 0 or not now < best:
            best = min(best, now)
            break
        best, start = now, at.next_start
        way.at = at
        whole = engine.fold(at.factor, np.concatenate([np.eye(p), moved.T], axis=1)[None])[0]
        moved = moved - np.linalg.solve(whole[:p, :p], whole[:p, p])[None]
        if np.abs(moved).max() > LARGEST:
            break
    return best
