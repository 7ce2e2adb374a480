# SPDX-License-Identifier: Apache-2.0
"""The rows of an identification: residuals of a robot against its measurements, whitened and scaled, block by block.

For a row with residual r = predicted - measured, whitener W and kind's derivative G by the platform's twist, and the
error model D = d twist / d parameter, the row is [W G D diag(tolerance) | W r]. Blocks of poses are folded into one
triangular factor by the engine, so the memory of a fit is its parameters squared plus one block. The rows are a
`Problem` of the descent: t machines that share readings and kinds, each with its own measured values.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal import engine, se3
from loopcal.calibrate.scaling import Unknowns
from loopcal.errors import EstimationError
from loopcal.linalg import FloatArray, IntArray, empty_factor
from loopcal.measure import Kind, Measurements, Trials
from loopcal.measure.simulate import rows_of as sensor_rows
from loopcal.measure.whitening import whitener
from loopcal.mechanism import Status
from loopcal.mechanism.implicit import sensitivity
from loopcal.mechanism.transmission import joint_values
from loopcal.mechanism.trials import forward_trials

BLOCK = 512
"""Poses (of all trials together) whose rows are made at once: large enough for NumPy, small enough for the cache."""


@dataclass(frozen=True, eq=False)
class Sensed:
    """Rows of one kind for t trials.

    Attributes
    ----------
    kind : what was measured. poses : (r,) the pose that each row saw.
    measured : (t | 1, r, c) [SI]. whitener : (t | 1, r, m, m), zero rows for what is absent.
    """

    kind: Kind
    poses: IntArray
    measured: FloatArray
    whitener: FloatArray

    def within(self, first: int, last: int) -> Sensed:
        """The rows that saw the poses first..last - 1, poses counted from `first`."""
        chosen = np.flatnonzero((self.poses >= first) & (self.poses < last))
        if len(chosen) == len(self.poses):
            return Sensed(self.kind, self.poses - first, self.measured, self.whitener)
        return Sensed(self.kind, self.poses[chosen] - first, self.measured[:, chosen], self.whitener[:, chosen])

    def trials(self, chosen: IntArray) -> tuple[FloatArray, FloatArray]:
        """Measured values and whiteners of some trials."""
        measured = self.measured if len(self.measured) == 1 else self.measured[chosen]
        return measured, self.whitener if len(self.whitener) == 1 else self.whitener[chosen]


class Residuals(NamedTuple):
    """Residuals (predicted - measured) of one kind's rows: raw (t, r, m) [SI] and whitened (t, r, m)."""

    raw: FloatArray
    whitened: FloatArray


@dataclass(frozen=True, eq=False)
class _Block:
    """Some consecutive poses: their places, readings and rows, and which of them any row needs."""

    poses: slice
    readings: FloatArray
    sensed: tuple[Sensed, ...]
    needed: np.ndarray


class Rows:
    """Whitened rows of t machines at the readings they share; a `Problem` of the descent.

    Where all poses fit into one block, each trial's kinematics begins where that trial's last solution ended: it saves
    Newton steps. Otherwise it begins at home, and nothing is kept from block to block.

    Parameters
    ----------
    unknowns : the free parameters and their units.
    readings : (n, a) [SI].
    sensed : what each kind measured.
    trials : number of machines t.
    located : (t | 1, n, 4, 4) poses [m], optional. With it closure is not solved but linearised at these poses: with its
        Newton step dx from there a row is [W G D diag(tolerance) | W (r + G dx)]. See `loopcal.calibrate.closure`.
    """

    def __init__(
        self,
        unknowns: Unknowns,
        readings: FloatArray,
        sensed: tuple[Sensed, ...],
        trials: int,
        located: FloatArray | None = None,
    ) -> None:
        self.unknowns = unknowns
        self.readings = readings
        self.sensed = sensed
        self.located = located
        self.parameters = len(unknowns)
        present = [np.einsum("trii->tri", s.whitener) != 0.0 for s in sensed]
        counted = sum((p.sum(axis=(1, 2)) for p in present), start=np.zeros(1, dtype=np.int64))
        self.rows: IntArray = np.broadcast_to(counted, (trials,)).astype(np.int64)
        n = len(readings)
        needed = np.zeros(n, dtype=bool)
        for s, p in zip(sensed, present, strict=True):
            needed[s.poses[p.any(axis=(0, 2))]] = True
        self.blocks = []
        for first in range(0, n, BLOCK):
            last = min(first + BLOCK, n)
            inside = tuple(s.within(first, last) for s in sensed)
            self.blocks.append(_Block(slice(first, last), readings[None, first:last], inside, needed[first:last]))
        self.last = _Last(unknowns.robot.home_state, trials, n) if n <= BLOCK else None

    def fold(self, deviation: FloatArray, trials: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return triangular factor (a, p + 1, p + 1) and sum of squares (a,); infinite where a pose is out of reach."""
        factor = empty_factor(len(trials), self.parameters)
        lost = np.zeros(len(trials), dtype=bool)
        shared = len(trials) > 1 and self.located is None and bool((deviation == deviation[0]).all())
        together = max(1, BLOCK // len(self.blocks[0].needed))
        moves = self._moves(self.blocks[0], deviation[:1], trials) if shared and len(self.blocks) == 1 else None
        for first in range(0, len(trials), together):
            some = slice(first, first + together)
            part = factor[some]
            for block in self.blocks:
                found = moves or self._moves(block, deviation[some], trials[some])
                rows = [self._kind_rows(s, found, trials[some]) for s in block.sensed if len(s.poses)]
                part = engine.accumulate(part, rows[0] if len(rows) == 1 else np.concatenate(rows, axis=1))
                lost[some] |= found.failed
            factor[some] = part
        cost = (factor[:, :, -1] ** 2).sum(axis=1)
        return factor, np.where(lost, np.inf, cost)

    def residuals(self, deviation: FloatArray) -> tuple[Residuals, ...]:
        """Return the residuals of every kind at deviations (t, p); NaN where a pose is out of reach."""
        robot, values = self.unknowns.robot, self.unknowns.values(deviation)
        trials = np.arange(len(deviation))
        parts: list[list[Residuals]] = [[] for _ in self.sensed]
        for block in self.blocks:
            state = forward_trials(robot, values, block.readings, self.last and self.last.take(trials, deviation))
            ok = _solved(state)
            T = np.where(ok[..., None, None], state.T, np.eye(4))
            for part, sensed in zip(parts, block.sensed, strict=True):
                measured, white = sensed.trials(trials)
                raw = sensed.kind.evaluate(T[:, sensed.poses], measured).residual
                raw = np.where(ok[:, sensed.poses, None], raw, np.nan)
                part.append(Residuals(raw, np.matmul(white, raw[..., None])[..., 0]))
        return tuple(_in_order(part, sensed.poses) for part, sensed in zip(parts, self.sensed, strict=True))

    def linearised(self, deviation: FloatArray) -> Iterator[list[tuple[IntArray, FloatArray]]]:
        """Give, block of poses by block, the poses (r,) and rows (r, m, p + 1) of every kind at deviation (1, p) of trial 0."""
        trial = np.arange(1)
        for block in self.blocks:
            found = self._moves(block, deviation, trial)
            seen = [s for s in block.sensed if len(s.poses)]
            rows = [self._kind_rows(s, found, trial).reshape(len(s.poses), -1, self.parameters + 1) for s in seen]
            yield [(s.poses + block.poses.start, part) for s, part in zip(seen, rows, strict=True)]

    def weighted(self, weight: FloatArray) -> Rows:
        """Return these rows with a factor (n,) on each pose's squares; 0 makes its rows absent. Kinematics goes on."""
        root = np.sqrt(weight)
        scaled = [dataclasses.replace(s, whitener=s.whitener * root[s.poses, None, None]) for s in self.sensed]
        other = Rows(self.unknowns, self.readings, tuple(scaled), self.rows.size, self.located)
        other.last = self.last
        return other

    def unreachable(self, deviation: FloatArray) -> IntArray:
        """Return the poses that some row needs and that cannot be reached at deviation (1, p)."""
        robot, values = self.unknowns.robot, self.unknowns.values(deviation)
        lost = [_solved(forward_trials(robot, values, b.readings))[0] | ~b.needed for b in self.blocks]
        return np.flatnonzero(~np.concatenate(lost))

    def _moves(self, block: _Block, deviation: FloatArray, trials: IntArray) -> _Moves:
        """Solve a block's poses and linearise them; one deviation (1, p) stands for all of the trials."""
        robot, values = self.unknowns.robot, self.unknowns.values(deviation)
        if self.located is not None:
            return self._closure(block, values, trials)
        begin = self.last and self.last.take(trials[: len(values)], deviation)
        state = forward_trials(robot, values, block.readings, begin)
        D, T = sensitivity(robot, values, block.readings, state).parameters, state.T
        ok = _solved(state) & np.isfinite(D).all(axis=(2, 3))
        failed = np.zeros(len(values), dtype=bool)
        if not ok.all():
            failed = np.any(~ok & block.needed, axis=1)
            T, D = np.where(ok[..., None, None], T, np.eye(4)), np.where(ok[..., None, None], D, 0.0)
        D = self._scaled(D)
        if self.last is not None:
            self.last.put(trials, state, ok, deviation, D)
        return _Moves(T, D, None, failed)

    def _closure(self, block: _Block, values: FloatArray, trials: IntArray) -> _Moves:
        """Linearise closure at the located poses of a block."""
        robot = self.unknowns.robot
        assert self.located is not None
        every = np.broadcast_to(self.located, (self.rows.size, *self.located.shape[1:]))
        T = every[trials, block.poses]
        e, tau = robot.slots(values)
        joints = joint_values(block.readings, tau, robot.slots.frequency)
        state = engine.solve(robot.program, e, joints, dataclasses.replace(robot.home_state, T=T), most=1)
        step = se3.difference(state.T, T)
        here = dataclasses.replace(state, T=T, status=np.zeros_like(state.status))
        D = sensitivity(robot, values, block.readings, here).parameters
        ok = np.asarray(np.isfinite(step).all(axis=2) & np.isfinite(D).all(axis=(2, 3)))
        step, D = np.where(ok[..., None], step, 0.0), np.where(ok[..., None, None], D, 0.0)
        return _Moves(T, self._scaled(D), step, np.any(~ok & block.needed, axis=1))

    def _scaled(self, D: FloatArray) -> FloatArray:
        """Columns of the free parameters in units of their tolerance."""
        free = D[..., self.unknowns.places] if len(self.unknowns.places) < D.shape[-1] else D
        return free * self.unknowns.tolerance

    def _kind_rows(self, sensed: Sensed, moves: _Moves, trials: IntArray) -> FloatArray:
        """Rows (a, r * m, p + 1) of one kind."""
        measured, white = sensed.trials(trials)
        T, D = moves.T, moves.D
        if not np.array_equal(sensed.poses, np.arange(T.shape[1])):
            T, D = T[:, sensed.poses], D[:, sensed.poses]
        found = sensed.kind.evaluate(np.broadcast_to(T, (len(trials), *T.shape[1:])), measured)
        residual = found.residual
        if moves.step is not None:
            residual = residual + np.matmul(found.jacobian, moves.step[:, sensed.poses, :, None])[..., 0]
        a, r, m = residual.shape
        rows = np.empty((a, r, m, self.parameters + 1))
        np.matmul(np.matmul(white, found.jacobian), D, out=rows[..., :-1])
        rows[..., -1] = np.matmul(white, residual[..., None])[..., 0]
        return rows.reshape(a, r * m, -1)


class _Moves(NamedTuple):
    """Poses of a block and how they move.

    T (a, n, 4, 4); D (a, n, 6, p) by the scaled unknowns; closure's step (a, n, 6) where it is not solved; failed (a,).
    """

    T: FloatArray
    D: FloatArray
    step: FloatArray | None
    failed: np.ndarray


class _Last:
    """The last solved state of every trial and pose, moved on by its sensitivities: where the next solution begins.

    The sensitivities only choose a start, so they are kept in single precision.
    """

    def __init__(self, home: engine.State, trials: int, poses: int) -> None:
        self.shape = (trials, poses)
        self.state = _mapped(self._spread, home)
        self.deviation: FloatArray | None = None
        self.moves = np.zeros(0, np.float32)

    def take(self, trials: IntArray, deviation: FloatArray) -> engine.State:
        """Return the states of some trials, as far as first order takes them to deviations (a, p)."""
        state = self.state if len(trials) == self.shape[0] else _mapped(lambda a: a[trials], self.state)
        if self.deviation is None:
            return state
        change = (deviation - self.deviation[trials]).astype(np.float32)
        twist = np.matmul(self.moves[trials], change[:, None, :, None])[..., 0]
        return dataclasses.replace(state, T=se3.exp_update(state.T, twist.astype(np.float64)))

    def put(self, trials: IntArray, state: engine.State, ok: np.ndarray, deviation: FloatArray, D: FloatArray) -> None:
        """Keep the states of poses that are solved; one state stands for all trials where there is one only."""
        if ok.all() and len(trials) == self.shape[0]:
            self.state = _mapped(self._spread, state)
        else:
            _mapped(lambda old, new: _overwrite(old, new, trials, ok), self.state, state)
        if self.deviation is None:
            self.deviation = np.zeros((self.shape[0], deviation.shape[1]))
            self.moves = np.zeros((*self.shape, 6, deviation.shape[1]), np.float32)
        self.deviation[trials], self.moves[trials] = deviation, D

    def _spread(self, array: np.ndarray) -> np.ndarray:
        return np.array(np.broadcast_to(array, (*self.shape, *array.shape[2:])))


def _overwrite(old: np.ndarray, new: np.ndarray, trials: IntArray, ok: np.ndarray) -> np.ndarray:
    """Write the solved poses (ok) of some trials into working memory."""
    solved = ok.reshape(*ok.shape, *[1] * (new.ndim - 2))
    old[trials] = np.where(solved, new, old[trials])
    return old


def rows_of(unknowns: Unknowns, data: Measurements) -> Rows:
    """Return the rows of one machine's measurements; raises EstimationError for kinds that cannot be fitted yet."""
    for kind in (observations.kind for observations in data.observations if len(observations)):
        if kind.links > 1 or kind.looks_at:
            what = "compare poses" if kind.links > 1 else "look at joints"
            raise EstimationError(f"rows of the kind {kind.name!r} {what}, which cannot be fitted yet; leave them out")
    sensed = tuple(Sensed(o.kind, o.rows, o.measured[None], o.whitener[None]) for o in data.observations if len(o))
    return Rows(unknowns, data.readings, sensed, 1)


def rows_of_trials(unknowns: Unknowns, trials: Trials) -> Rows:
    """Return the rows of t simulated machines."""
    sensed = []
    for sensor, measured in zip(trials.instrument.sensors, trials.measured, strict=True):
        kind = sensor.kind
        present = kind.present(measured)
        N = kind.noise_map(measured)
        covariance = (N * np.asarray(sensor.noise.sigma) ** 2) @ np.swapaxes(N, -1, -2)
        t, r, m = present.shape
        flat = whitener(np.broadcast_to(covariance, (t, r, m, m)).reshape(-1, m, m), present.reshape(-1, m), np.ones(t * r))
        sensed.append(Sensed(kind, sensor_rows(sensor), measured, flat.reshape(t, r, m, m)))
    return Rows(unknowns, trials.readings, tuple(sensed), len(trials))


def _solved(state: engine.State) -> np.ndarray:
    """(t, n) which poses closed."""
    return state.status == Status.CONVERGED


def _mapped(function: Callable[..., np.ndarray], *states: engine.State) -> engine.State:
    """Return the state whose arrays are the function of those of the given states."""
    first, columns = states[0], range(len(states[0].joints))
    joints = tuple(function(*(s.joints[g] for s in states)) for g in columns)
    fields = {f.name: f.name for f in dataclasses.fields(first) if f.name != "joints"}
    return engine.State(joints=joints, **{name: function(*(getattr(s, name) for s in states)) for name in fields})


def _in_order(parts: list[Residuals], poses: IntArray) -> Residuals:
    """Residuals of all blocks in the order of the kind's rows."""
    if len(parts) == 1:
        return parts[0]
    place = np.argsort(np.argsort(poses // BLOCK, kind="stable"), kind="stable")
    return Residuals(*(np.concatenate(arrays, axis=1)[:, place] for arrays in zip(*parts, strict=True)))
