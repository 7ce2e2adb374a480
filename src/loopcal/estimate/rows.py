# SPDX-License-Identifier: Apache-2.0
"""The rows of an identification: residuals of a robot against its measurements, whitened and
scaled, block by block.

For a row with residual r = predicted - measured, whitener W and kind's derivative G by the
platform's twist, and the error model D = d twist / d parameter, the row is [W G D diag(tolerance) |
W r]; a row that compares poses has the sum over its poses, one that looks at joints their
derivatives in addition. Blocks of poses are folded into one triangular factor by the engine, so the
memory of a fit is its parameters squared plus one block. FreeParameters that measurements bring with them
are eliminated, see `loopcal.estimate.local`. The rows are a `Problem` of the descent: t machines
that share readings and kinds, each with its own measured values.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from loopcal import engine, geometry
from loopcal.estimate.elimination import Factors
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.latent import LatentRows, latent_rows
from loopcal.estimate.local import Own, Part, fold_parts, spread_columns
from loopcal.estimate.moves import Last, Moves, evaluated, machine_columns
from loopcal.estimate.sensed import BLOCK, Block, Residuals, Sensed, blocks_of
from loopcal.measure import (
    Measurements,
    NuisanceParameters,
    Trials,
    collect_nuisance_parameters,
    list_sensed_joints,
    resolve_reading_sigma,
    select_joint_values,
)
from loopcal.measure.simulation import rows_of as sensor_rows
from loopcal.measure.whitening import whitener
from loopcal.mechanism import (
    Status,
    differentiate_passive_joints,
    differentiate_pose,
    forward_trials,
    joints_from_readings,
)
from loopcal.numerics.decomposition import empty_factor
from loopcal.typing import FloatArray, IntArray


class Rows:
    """Whitened rows of t machines at the readings they share; a `Problem` of the descent.

    Where all poses fit into one block, each trial's kinematics begins where that trial's last
    solution ended: it saves Newton steps. Otherwise it begins at home, and nothing is kept from
    block to block.

    Parameters
    ----------
    unknowns : the free parameters and their units.
    readings : (n, a) [SI].
    sensed : what each kind measured.
    trials : number of machines t.
    located : (t | 1, n, 4, 4) poses [m], optional. With it closure is not solved but linearised at
        these poses: with its Newton step dx from there a row is [W G D diag(tolerance) | W (r + G
        dx)]. See `loopcal.estimate.closure`.
    own : the unknowns that the measurements bring with them, where there are any.
    """

    def __init__(
        self,
        unknowns: FreeParameters,
        readings: FloatArray,
        sensed: tuple[Sensed, ...],
        trials: int,
        located: FloatArray | None = None,
        own: Own | None = None,
    ) -> None:
        self.unknowns = unknowns
        self.readings = readings
        self.sensed = sensed
        self.located = located
        self.own = own
        self.parameters = len(unknowns)
        self.joints = list_sensed_joints(s.kind for s in sensed)
        present = [np.einsum("trii->tri", s.whitener) != 0.0 for s in sensed]
        counted = sum((p.sum(axis=(1, 2)) for p in present), start=np.zeros(1, dtype=np.int64))
        self.counted: IntArray = np.broadcast_to(counted, (trials,)).astype(np.int64)
        needed = np.zeros(len(readings), dtype=bool)
        for s, p in zip(sensed, present, strict=True):
            needed[s.poses[p.any(axis=(0, 2))]] = True
        self.blocks = blocks_of(readings, sensed, needed, BLOCK)
        self.last = (
            Last(unknowns.robot.home_state, trials, len(readings))
            if len(self.blocks) == 1
            else None
        )

    @property
    def rows(self) -> IntArray:
        """(t,) equations, less the directions of own unknowns that the last fold solved for."""
        return self.counted if self.own is None else self.counted + self.own.priors - self.own.rank

    def fold(self, deviation: FloatArray, trials: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return triangular factor (a, p + 1, p + 1) and sum of squares (a,); infinite where a pose
        is out of reach.
        """
        factor = empty_factor(len(trials), self.parameters)
        lost = np.zeros(len(trials), dtype=bool)
        shared = (
            len(trials) > 1 and self.located is None and bool((deviation == deviation[0]).all())
        )
        together = max(1, BLOCK // len(self.blocks[0].needed))
        moves = (
            self._moves(self.blocks[0], deviation[:1], trials)
            if shared and len(self.blocks) == 1
            else None
        )
        for first in range(0, len(trials), together):
            some = slice(first, first + together)
            factor[some], lost[some] = self._folded(deviation[some], trials[some], moves)
        return factor, np.where(lost, np.inf, (factor[:, :, -1] ** 2).sum(axis=1))

    def _folded(
        self, z: FloatArray, trials: IntArray, moves: Moves | None
    ) -> tuple[FloatArray, np.ndarray]:
        """Factor (a, p + 1, p + 1) of some trials, own unknowns settled and eliminated, and which
        are out of reach.
        """
        p, lost = self.parameters, np.zeros(len(trials), dtype=bool)
        factor = empty_factor(len(trials), p)
        if moves is None and len(self.blocks) == 1:
            moves = self._moves(self.blocks[0], z, trials)
        values = None
        if self.own is not None:
            looks = [moves or self._look(block, z, trials) for block in self.blocks]
            values = self._settled(looks, z, trials)
        folding = None if self.own is None else Factors(self.own.nesting, len(trials), p)
        for block in self.blocks:
            found = moves or self._moves(block, z, trials)
            parts = [
                part for s in block.sensed for part in self._kind_rows(s, found, trials, values)
            ]
            plain = [part.rows for part in parts if part.form < 0]
            if plain:
                factor = engine.fold(
                    factor, plain[0] if len(plain) == 1 else np.concatenate(plain, axis=1)
                )
            fold_parts(folding, parts)
            lost |= found.failed
        if self.own is not None and folding is not None and values is not None:
            factor = engine.fold(factor, self.own.finish(folding, values))
            self.own.keep(
                trials, z, values, np.where(lost, np.inf, (factor[:, :, -1] ** 2).sum(axis=1))
            )
        return factor, lost

    def own_values(self, deviation: FloatArray) -> FloatArray | None:
        """Return the own unknowns (t, U) that fit best at deviations (t, p); None where there are
        none.
        """
        if self.own is None:
            return None
        trials = np.arange(len(deviation))
        return self._settled(
            [self._look(block, deviation, trials) for block in self.blocks], deviation, trials
        )

    def residuals(
        self, deviation: FloatArray, own: FloatArray | None = None
    ) -> tuple[Residuals, ...]:
        """Return the residuals of every kind at deviations (t, p); NaN where a pose is out of
        reach.

        Own unknowns are as given (t, U); by default those that fit best.
        """
        trials = np.arange(len(deviation))
        looks = [self._look(block, deviation, trials) for block in self.blocks]
        values = (
            self._settled(looks, deviation, trials) if own is None and self.own is not None else own
        )
        shapes = [(len(trials), *s.whitener.shape[1:3]) for s in self.sensed]
        found = [Residuals(np.full(shape, np.nan), np.full(shape, np.nan)) for shape in shapes]
        for block, look in zip(self.blocks, looks, strict=True):
            for kind, rows, sensed in zip(found, block.rows, block.sensed, strict=True):
                if not len(rows):
                    continue
                seen, white = evaluated(sensed, look, trials, values)
                raw = np.where(
                    np.all(look.ok[:, sensed.per_pose], axis=2, keepdims=True),
                    seen.residual,
                    np.nan,
                )
                kind.raw[:, rows], kind.whitened[:, rows] = (
                    raw,
                    np.matmul(white, raw[..., None])[..., 0],
                )
        return tuple(found)

    def linearised(self, deviation: FloatArray) -> Iterator[list[tuple[IntArray, FloatArray]]]:
        """Give, block by block, the poses (r,) and rows (r, m, U + p + 1) of every kind at
        deviation (1, p) of trial 0.

        The first U columns, none without own unknowns, are in units of these unknowns' own standard
        deviation, and the next p those of the machine as the own unknowns follow it: all as the
        last fold found them.
        """
        trial, p = np.arange(1), self.parameters
        for block in self.blocks:
            found = self._moves(block, deviation, trial)
            given = []
            for s in (s for s in block.sensed if len(s.poses)):
                m = s.whitener.shape[-1]
                values = None if self.own is None else self.own.predicted(trial, deviation)
                rows = np.zeros(
                    (len(s.poses), m, (0 if self.own is None else len(self.own.local)) + p + 1)
                )
                for part in self._kind_rows(s, found, trial, values):
                    one = part.rows.reshape(len(part.which), m, -1)
                    w = one.shape[-1] - p - 1
                    rows[part.which, :, -p - 1 :] = one[..., w:]
                    if self.own is not None and self.own.solved is not None and part.form >= 0:
                        path, root, slope = self.own.solved.at(part.nodes)
                        rows[part.which, :, -p - 1 : -1] += one[..., :w] @ slope
                        rows[part.which[:, None, None], np.arange(m)[:, None], path[:, None, :]] = (
                            one[..., :w] @ root
                        )
                given.append((block.poses[s.first], rows))
            yield given

    def weighted(self, weight: FloatArray) -> Rows:
        """Return these rows with a factor (n,) on each pose's squares; 0 makes its rows absent.
        Kinematics goes on.
        """
        root = np.sqrt(weight)
        scaled = []
        for s in self.sensed:
            each = root[s.per_pose].prod(axis=1) ** (1.0 / s.per_pose.shape[1])
            scaled.append(dataclasses.replace(s, whitener=s.whitener * each[:, None, None]))
        if self.own is not None:
            self.own.cost[:] = np.inf
        other = Rows(
            self.unknowns, self.readings, tuple(scaled), self.counted.size, self.located, self.own
        )
        other.last = self.last
        return other

    @property
    def equations(self) -> IntArray:
        """(t,) equations, own unknowns not counted."""
        return self.counted

    def sizes(self, member: IntArray, count: int) -> IntArray:
        """How many rows `linearised` gives of each of `count` blocks; member (n,) is the block of
        each pose.
        """
        total = np.zeros(count, dtype=np.int64)
        for s in self.sensed:
            total += np.bincount(member[s.first], minlength=count) * s.whitener.shape[-1]
        return total

    def spent(self, member: IntArray, count: int) -> IntArray:
        """How many of the residuals of each of `count` blocks its poses have used up: none,
        readings being exact.
        """
        return np.zeros(count, dtype=np.int64)

    def unreachable(self, deviation: FloatArray) -> IntArray:
        """Return the poses that some row needs and that cannot be reached at deviation (1, p)."""
        robot, values = self.unknowns.robot, self.unknowns.values(deviation)
        lost = [
            b.poses[~_solved(forward_trials(robot, values, b.readings))[0] & b.needed]
            for b in self.blocks
        ]
        return np.unique(np.concatenate(lost))

    def _moves(self, block: Block, deviation: FloatArray, trials: IntArray) -> Moves:
        """Solve a block's poses and linearise them; one deviation (1, p) stands for all of the
        trials.
        """
        robot, values = self.unknowns.robot, self.unknowns.values(deviation)
        if self.located is not None:
            return self._closure(block, values, trials)
        begin = self.last and self.last.take(trials[: len(values)], deviation)
        state = forward_trials(robot, values, block.readings, begin)
        D, T = differentiate_pose(robot, values, block.readings, state).parameters, state.T
        ok = _solved(state) & np.isfinite(D).all(axis=(2, 3))
        failed = np.zeros(len(values), dtype=bool)
        if not ok.all():
            failed = np.any(~ok & block.needed, axis=1)
            T, D = (
                np.where(ok[..., None, None], T, np.eye(4)),
                np.where(ok[..., None, None], D, 0.0),
            )
        D = self._scaled(D)
        if self.last is not None:
            self.last.put(trials, state, ok, deviation, D)
        if not self.joints:
            return Moves(T, ok, failed, D)
        passive = [
            name
            for name in self.joints
            if name not in {actuator.name for actuator in robot.actuators}
        ]
        slopes = {}
        if passive:
            moved = differentiate_passive_joints(robot, values, block.readings, state)
            every = self._scaled(np.where(ok[..., None, None], moved.parameters, 0.0))
            slopes = {name: every[:, :, moved.names.index(name)] for name in passive}
        return Moves(T, ok, failed, D, joints=self._joints(block, state, ok), slopes=slopes)

    def _look(self, block: Block, deviation: FloatArray, trials: IntArray) -> Moves:
        """Solve a block's poses alone."""
        robot, values = self.unknowns.robot, self.unknowns.values(deviation)
        state = forward_trials(
            robot, values, block.readings, self.last and self.last.take(trials, deviation)
        )
        ok = _solved(state)
        T = np.where(ok[..., None, None], state.T, np.eye(4))
        return Moves(
            T, ok, np.any(~ok & block.needed, axis=1), joints=self._joints(block, state, ok)
        )

    def _joints(self, block: Block, state: engine.State, ok: np.ndarray) -> dict[str, FloatArray]:
        """Values (a, n) of the joints that kinds look at; zero where a pose failed."""
        found = select_joint_values(self.unknowns.robot, self.joints, block.readings, state)
        return {name: np.where(ok, value, 0.0) for name, value in found.items()}

    def _settled(self, looks: list[Moves], z: FloatArray, trials: IntArray) -> FloatArray:
        """Values (a, U) of the own unknowns that fit best at the poses of all blocks."""
        own = self.own
        assert own is not None
        for i in np.flatnonzero(~own.started[trials]):
            if (
                own.started.any()
            ):  # trials look with the same instrument: what was found for one is near for all
                own.follow(int(trials[i]))
            else:
                self._start(looks, int(i), trials)

        def factors(values: FloatArray) -> Factors:
            folding = Factors(own.nesting, len(trials), 0)
            for block, look in zip(self.blocks, looks, strict=True):
                using = [s for s in block.sensed if s.places.shape[1]]
                fold_parts(
                    folding,
                    [
                        part
                        for s in using
                        for part in self._kind_rows(s, look, trials, values, machine=False)
                    ],
                )
            own.fold_priors(folding, values)
            return folding

        return own.settled(own.predicted(trials, z), factors)

    def _start(self, looks: list[Moves], i: int, trials: IntArray) -> None:
        """Find values to begin with from the poses of trial trials[i]; where it cannot reach some
        they stay nominal.
        """
        assert self.own is not None
        each = [(look, i if len(look.T) > 1 else 0) for look in looks]
        if any(look.failed[k] for look, k in each):
            return
        n = len(self.readings)
        T = np.concatenate([look.T[k] for look, k in each])[:n]
        joints = {name: np.concatenate([np.broadcast_to(look.joints[name], look.ok.shape)[k] for look, k in each])[None, :n]
                  for name in self.joints}  # fmt: skip
        trial = int(trials[i])
        self.own.begin(trial, T, joints)

    def _closure(self, block: Block, values: FloatArray, trials: IntArray) -> Moves:
        """Linearise closure at the located poses of a block."""
        robot = self.unknowns.robot
        assert self.located is not None
        every = np.broadcast_to(self.located, (self.counted.size, *self.located.shape[1:]))
        T = every[trials[:, None], block.poses]
        e, tau = robot.slots(values)
        joints = joints_from_readings(block.readings, tau, robot.slots.frequency)
        state = engine.solve(
            robot.program, e, joints, dataclasses.replace(robot.home_state, T=T), max_iterations=1
        )
        step = geometry.pose_difference(state.T, T)
        here = dataclasses.replace(state, T=T, status=np.zeros_like(state.status))
        D = differentiate_pose(robot, values, block.readings, here).parameters
        ok = np.asarray(np.isfinite(step).all(axis=2) & np.isfinite(D).all(axis=(2, 3)))
        step, D = np.where(ok[..., None], step, 0.0), np.where(ok[..., None, None], D, 0.0)
        return Moves(T, ok, np.any(~ok & block.needed, axis=1), self._scaled(D), step)

    def _scaled(self, D: FloatArray) -> FloatArray:
        """Columns of the free parameters in units of their tolerance."""
        free = D[..., self.unknowns.places] if len(self.unknowns.places) < D.shape[-1] else D
        return free * self.unknowns.tolerance

    def _kind_rows(
        self,
        sensed: Sensed,
        moves: Moves,
        trials: IntArray,
        values: FloatArray | None,
        machine: bool = True,
    ) -> Iterator[Part]:
        """Rows of one kind by the form of their nodes; without the p columns where `machine` is
        false.
        """
        if not len(sensed.poses):
            return
        found, white = evaluated(sensed, moves, trials, values)
        residual = found.residual
        if moves.step is not None:
            residual = (
                residual + np.matmul(found.jacobian, moves.step[:, sensed.poses, :, None])[..., 0]
            )
        a, r, m = residual.shape
        p = self.parameters if machine else 0
        rows = np.empty((a, r, m, p + 1))
        if machine:
            rows[..., :-1] = machine_columns(sensed, found, white, moves)
        rows[..., -1] = np.matmul(white, residual[..., None])[..., 0]
        if self.own is None:
            every = np.arange(r)
            yield Part(-1, every, np.full(r, -1), rows.reshape(a, r * m, -1))
            return
        own = (
            None
            if found.nuisance is None
            else np.matmul(
                white, np.broadcast_to(found.nuisance, (a, r, m, found.nuisance.shape[-1]))
            )
        )
        for form, which, nodes, columns in self.own.members(sensed):
            part = rows[:, which]
            if form >= 0 and own is not None:
                wide = spread_columns(
                    own[:, which], columns, self.own.nesting.forms[form].path.shape[1]
                )
                part = np.concatenate([wide, part], axis=-1)
            yield Part(form, which, nodes, part.reshape(a, len(which) * m, -1))


def rows_of(
    unknowns: FreeParameters, data: Measurements, local: NuisanceParameters | None = None
) -> AnyRows:
    """Return the rows of one machine's measurements; `local` are the unknowns that these bring,
    default as stated.

    Where readings have a sigma above 0, the poses are unknowns, too.
    """
    own = data.nuisance_parameters if local is None else local
    pairs = [
        (o, places) for o, places in zip(data.observations, own.indices, strict=True) if len(o)
    ]
    sensed = tuple(
        Sensed(o.kind, o.rows, o.measured[None], o.whitener[None], places) for o, places in pairs
    )
    return _rows(unknowns, data.readings[None], data.reading_sigma, sensed, 1, own, lambda _: data)


def rows_of_trials(unknowns: FreeParameters, trials: Trials) -> AnyRows:
    """Return the rows of t simulated machines."""
    sensors = trials.instrument.sensors
    first = trials.trial(0)
    local = collect_nuisance_parameters(first.observations, first.labels)
    sensed = []
    for sensor, measured, places in zip(sensors, trials.measured, local.indices, strict=True):
        kind = sensor.kind
        present = kind.detect_present(measured)
        N = kind.linearize_noise(measured)
        covariance = (N * np.asarray(sensor.noise.sigma) ** 2) @ np.swapaxes(N, -1, -2)
        t, r, m = present.shape
        flat = whitener(
            np.broadcast_to(covariance, (t, r, m, m)).reshape(-1, m, m),
            present.reshape(-1, m),
            np.ones(t * r),
        )
        sensed.append(Sensed(kind, sensor_rows(sensor), measured, flat.reshape(t, r, m, m), places))
    recorded = trials.readings[None] if trials.recorded is None else trials.recorded
    return _rows(
        unknowns, recorded, trials.reading_sigma, tuple(sensed), len(trials), local, trials.trial
    )


def _rows(
    unknowns: FreeParameters,
    recorded: FloatArray,
    sigma: FloatArray | None,
    sensed: tuple[Sensed, ...],
    trials: int,
    local: NuisanceParameters,
    data: Callable[[int], Measurements],
) -> AnyRows:
    """Rows at readings (t | 1, n, a), the poses unknown where a reading is not exact."""

    def own(together: IntArray | None) -> Own | None:
        return Own(local, sensed, trials, len(unknowns), data, together) if len(local) else None

    believed = resolve_reading_sigma(unknowns.robot, sigma, recorded.shape[1])
    if believed is None:
        return Rows(unknowns, recorded[0], sensed, trials, own=own(None))
    return latent_rows(unknowns, recorded, believed, sensed, trials, own)


AnyRows = Rows | LatentRows
"""Rows of exact readings, or of uncertain ones: every estimator takes both."""


def _solved(state: engine.State) -> np.ndarray:
    """(t, n) which poses closed."""
    return state.status == Status.CONVERGED
