# SPDX-License-Identifier: Apache-2.0
"""The least-squares problem of an identification, linearized by a pure function.

A problem holds the free parameters of a robot, the whitened rows of every kind, the table of
nuisance parameters with its elimination tree, and how poses follow from readings. It has no state:
`linearize(z, start)` depends on its arguments alone. Warm starts are passed in and returned.

For a row with residual r = predicted - measured, whitener W, the kind's derivative G by the
platform's twist, and the error model D = d twist / d parameter, the row is
[W G D diag(tolerance) | W r]. Unknowns of all scopes are eliminated from the innermost outwards:
the coordinates of poses whose readings are uncertain (block by block, while rows are made), then
groups, sessions and what all rows share. What is left is folded into one triangular factor, so that
the memory of a fit is its parameters squared plus one block. See docs/theory/identification.md.

The rank of a Jacobian with residuals contains second-order terms. Turn a robot with its surfaces
about a line: what is left between the points and the line turns as well, so that a first-order row
contains the rotation in proportion to the residual, though the sum of squares does not depend on
it. At poses without residuals no such term exists, and there J'J is the curvature of the sum of
squares. Rank is therefore decided at poses next to the measured ones at which touched surfaces have
exactly the gaps that were recorded (`ConsistentPoses`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from loopcal import engine
from loopcal.estimate import elimination
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.linearization import (
    LeverageRows,
    Linearization,
    LinearizedPoses,
    PoseSolution,
    PoseStates,
    Start,
    evaluate_rows,
    spread_states,
)
from loopcal.estimate.observation_rows import TRIAL_BLOCK, ObservationRows, Residuals, list_rows
from loopcal.estimate.pose_coordinates import (
    MeasuredPoses,
    PoseCoordinates,
    ReadingCoordinates,
    TwistCoordinates,
)
from loopcal.estimate.pose_rows import BLOCK, PoseBlock, PoseRows, find_components, take_rows
from loopcal.estimate.smooth_errors import SmoothErrors
from loopcal.measure.initial_values import guess_nuisance_values
from loopcal.measure.kinds.kind import Evaluation, Kind
from loopcal.measure.measurements import Measurements, anchor_rows
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.observations import compute_whitener
from loopcal.measure.readings import list_sensed_joints, make_readings_kind, resolve_reading_sigma
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import RANK_TOLERANCE, are_nonzero, empty_factor
from loopcal.numerics.elimination import NodeFactors, spread_columns
from loopcal.numerics.gauss_newton import Halving
from loopcal.numerics.statistics import find_distinct
from loopcal.numerics.trial_batch import select_counts
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.measure.instrument import Sensor
    from loopcal.measure.simulation import Trials


AtNodes = Callable[[IntArray], tuple[IntArray, FloatArray, FloatArray]]
"""From nodes (k,) of nuisance parameters to their paths (k, w), roots and slopes; see
`TreeElimination.at_nodes`.
"""


def spread_rows(
    poses: PoseRows,
    block: PoseBlock,
    node_rows: Iterable[elimination.NodeRows],
    at_nodes: AtNodes | None,
) -> Iterator[LeverageRows]:
    """Give rows with columns for the nuisance parameters that they move, poses eliminated (one
    trial).

    The columns of the p free parameters are those by which the nuisance parameters follow.
    `at_nodes` is None without nuisance parameters.
    """
    for part in node_rows:
        rows, path = part.machine[0], np.zeros((len(part.nodes), 0), dtype=np.int64)
        if at_nodes is not None and part.structure >= 0:
            path, root, slope = at_nodes(part.nodes)
            moved = spread_columns(part.by_unknowns[0], part.columns, path.shape[1])
            rows = rows.copy()
            rows[..., :-1] += moved @ slope
            rows = np.concatenate([moved @ root, rows], axis=2)
        first, numbers, columns = poses.first_pose, part.numbers, np.zeros((0, 0), dtype=np.int64)
        if part.kind >= 0:  # else rows of components, whose poses are eliminated
            first = block.poses[block.rows[part.kind].first_poses]
            numbers, columns = block.locate(part.kind, part.numbers)
        yield LeverageRows(first[part.numbers], path, rows, part.kind, numbers, columns)


CONTROL = Halving(steps=10, attempts=10, relative=0.0, absolute=1e-9, stuck=1e-3)
"""Control of the iteration to consistent poses: until residuals are rounding, or out of reach."""

LOOSE = 1e3
"""Standard deviation of a reading that moves freely, in sizes of the robot or in radians."""

SIGNIFICANT = 3.0
"""Recorded gaps below this multiple of their noise (root mean square) count as zero."""


def _without_noise(rows: ObservationRows) -> ObservationRows:
    """Return rows with gaps of zero where the recorded ones are not larger than their noise."""
    gaps = np.matmul(rows.whitener, np.nan_to_num(rows.measured)[..., None])[..., 0]
    count = np.maximum(rows.is_present.sum(axis=(1, 2)), 1)
    is_noise = (gaps**2).sum(axis=(1, 2)) <= SIGNIFICANT**2 * count
    measured = np.broadcast_to(rows.measured, (len(is_noise), *rows.measured.shape[1:]))
    cleared = np.where(is_noise[:, None, None] & np.isfinite(measured), 0.0, measured)
    return replace(rows, measured=cleared)


class ConsistentPoses(NamedTuple):
    """Finds poses, near given ones, at which rows have no residual.

    poses : rows to satisfy, and readings so uncertain that they follow.
    readings : (T | 1, n, actuators) [SI] where exact readings begin.
    """

    poses: PoseRows
    readings: FloatArray

    def move(
        self, solution: PoseSolution, z: FloatArray, trials: IntArray, start: Start
    ) -> PoseStates:
        """Return poses (a, n) and readings at which the rows have the recorded gaps, at the
        nuisance parameters of a solution.
        """
        begin = solution.states
        if solution.estimates is None or begin is None:
            q = self.readings if len(self.readings) == 1 else self.readings[trials]
            q = np.broadcast_to(q, (len(trials), *q.shape[1:]))
            state = self.poses.free.robot.home_state if begin is None else begin.state
            begin = PoseStates(spread_states(state, *q.shape[:2]), q)
        moved = self.poses.solve(
            z, trials, replace(start, poses=begin), CONTROL, fixed=solution.nuisance
        )
        assert moved.states is not None
        return moved.states


def remove_null_space(factor: FloatArray, reference: FloatArray) -> FloatArray:
    """Return a factor (t, p + 1, p + 1) without the directions that the rows of a reference with
    the same columns do not determine.

    With the null space N of the reference, A becomes A (I - N N'). Where the reference has full
    rank, or numbers that are not finite, the factor stays as it is.
    """
    p = factor.shape[-1] - 1
    finite = np.isfinite(reference).all(axis=(1, 2))
    finite = np.asarray(finite & np.isfinite(factor).all(axis=(1, 2)))
    _, s, vt = np.linalg.svd(np.where(finite[:, None, None], reference[:, :p, :p], 0.0))
    determined = are_nonzero(s, RANK_TOLERANCE)
    changed = np.flatnonzero(finite & ~determined.all(axis=1))
    if not changed.size:
        return factor
    basis = np.where(determined[changed, :, None], vt[changed], 0.0)
    rows = np.array(factor[changed])
    rows[:, :, :p] = np.matmul(np.matmul(rows[:, :, :p], basis.swapaxes(-1, -2)), basis)
    result = np.array(factor)
    result[changed] = np.linalg.qr(rows, mode="r")
    return result


@dataclass(frozen=True, eq=False)
class Problem:
    """Whitened rows of t machines that share readings and kinds.

    poses : the rows of every kind at the poses; uncertain readings are the last kind.
    readings : (T | 1, n, actuators) [SI] recorded ones, NaN where not taken.
    trials : (t,) numbers of the problem's trials among the T trials of the arrays.
    data : from the number of a trial to its measurements, from which nuisance parameters start.
    control : of the iteration to the best nuisance parameters and poses.
    sigma : (n, actuators) [SI] of the readings, 0 exact, infinite not taken or not believed; None
        where all readings are exact.
    consistent : poses without residuals, at which rank is decided; None where all residuals are
        invariant under the motions that the rows do not determine.
    """

    poses: PoseRows
    readings: FloatArray
    trials: IntArray
    data: Callable[[int], Measurements]
    control: Halving = Halving()  # noqa: RUF009
    sigma: FloatArray | None = None
    consistent: ConsistentPoses | None = None

    def __len__(self) -> int:
        return len(self.trials)

    @property
    def free(self) -> FreeParameters:
        """The free parameters and their units."""
        return self.poses.free

    @property
    def rows(self) -> tuple[ObservationRows, ...]:
        """The rows of every kind."""
        return self.poses.rows

    @property
    def nuisance(self) -> elimination.NuisanceElimination | None:
        """The nuisance parameters and their elimination tree; None without any."""
        return self.poses.nuisance

    @property
    def parameters(self) -> int:
        """Number p of free parameters."""
        return len(self.free)

    @property
    def is_uncertain(self) -> bool:
        """Whether readings are uncertain, so that poses are unknowns."""
        return self.poses.coordinates.count > 0

    @property
    def residual_count(self) -> IntArray:
        """(t,) residuals that are present, those of uncertain readings included."""
        return select_counts(self.poses.component_count.sum(axis=1), self.trials)

    @property
    def equations(self) -> IntArray:
        """(t,) equations, at least, once every pose is determined.

        Nuisance parameters are not counted.
        """
        count, member = self.poses.component_count, self.poses.member
        free = self.poses.coordinates.is_free(np.arange(len(member))).sum(axis=1)
        used = np.bincount(member, free, count.shape[1]).astype(np.int64)
        return select_counts(np.maximum(count - used, 0).sum(axis=1), self.trials)

    @property
    def part_size(self) -> int:
        """Number of trials whose rows are made together."""
        size = TRIAL_BLOCK if self.folds_plain_rows else BLOCK
        return max(1, size // max(len(block.poses) for block in self.poses.blocks))

    @property
    def folds_plain_rows(self) -> bool:
        """Whether the engine makes the rows of exact poses as it folds them."""
        return self.poses.are_plain and self.consistent is None

    def take(self, trials: IntArray) -> Problem:
        """Return the problem of some trials; this object where these are all of them."""
        if np.array_equal(trials, np.arange(len(self))):
            return self
        return replace(self, trials=self.trials[trials])

    def with_rows(self, rows: Iterable[ObservationRows]) -> Problem:
        """Return the problem of other rows of the same kinds and poses."""
        return replace(self, poses=replace(self.poses, rows=tuple(rows)))

    def with_errors(
        self, errors: SmoothErrors, solution: PoseSolution
    ) -> tuple[Problem, PoseSolution]:
        """Return the problem and a solution with the coefficients of errors of the poses as more
        parameters, which have no part in the rank of the machine.
        """
        known = solution.linearized
        solution = replace(solution, linearized=known and known.with_errors(errors))
        free, coordinates = replace(self.free, errors=errors), copy(self.poses.coordinates)
        coordinates.free = free
        poses = replace(self.poses, free=free, coordinates=coordinates)
        return replace(self, poses=poses, consistent=None), solution

    def divide(self, most: int) -> Iterator[Problem]:
        """Give problems of about `most` residuals each, which share no setup parameters, with the
        poses of these alone (one trial); this one where it is small, has none, or poses are free.
        """
        if self.nuisance is None or self.is_uncertain or self.residual_count[0] <= most:
            yield self
            return
        local, cluster, n = self.nuisance.local, self.nuisance.tree.cluster, self.readings.shape[1]
        groups = [cluster[r.nuisance].max(axis=1, initial=-1) + 1 for r in self.rows]
        sizes = [np.full(len(r.poses), r.whitener.shape[-1]) for r in self.rows]
        size = np.bincount(np.concatenate(groups), np.concatenate(sizes))
        part = (np.cumsum(size) - size) // most
        for number in find_distinct(part[size > 0]):
            chosen = tuple(np.flatnonzero(part[group] == number) for group in groups)
            used = [r.poses[own].ravel() for r, own in zip(self.rows, chosen, strict=True)]
            poses = find_distinct(np.concatenate(used))
            rows, readings = take_rows(self.rows, poses, chosen, n), self.readings[:, poses]
            yield make_exact_problem(self.free, readings, rows, 1, local, self.data)

    def weighted(self, weight: FloatArray) -> Problem:
        """Return the problem with a factor (n,) on each pose's squares, its readings included, or
        with factors (t, n) of each trial.

        A weight of 0 makes the rows of a pose absent.
        """
        is_one = bool((weight == 1.0).all())
        return self if is_one else self.with_rows(r.weighted(weight) for r in self.rows)

    def at_measured_poses(self, T: FloatArray) -> Problem:
        """Return the problem whose closure is linearized at poses (T | 1, n, 4, 4) [m] that were
        measured in full, and not solved.
        """
        exact = self.poses.coordinates
        coordinates = MeasuredPoses(self.free, exact.names, exact.readings, T)
        return replace(self, poses=replace(self.poses, coordinates=coordinates))

    def start(self, deviation: FloatArray | None = None, seek: bool = True) -> Start:
        """Return the first start at deviations (t, p), by default the robot's present values.

        All trials begin with the nuisance parameters that fit the first one whose poses are
        reached: trials are measured with the same instruments. Unless these are sought, all begin
        at nominal values.
        """
        t, p = len(self), self.parameters
        if deviation is None:
            deviation = np.repeat(self.free.deviation(self.free.robot.values[None]), t, axis=0)
        nominal = np.zeros(0) if self.nuisance is None else self.nuisance.local.values()
        values = np.broadcast_to(nominal, (t, len(nominal)))
        slope = np.broadcast_to(0.0, (t, len(nominal), p))
        start = Start(deviation, values, slope, values, self._first_states())
        if self.nuisance is None or not seek or not self.nuisance.is_free.any():
            return start
        for i in range(t):
            trial = np.array([i])
            located = self.poses.locate(deviation[trial], start.take(trial))
            if located is not None:
                data = self.data(int(self.trials[i]))
                measured = [rows.measured[None] for rows in data.all_observations]
                # by groups of rows; the fit begins with the best values of all rows together
                local = self.nuisance.local
                found = guess_nuisance_values(data, measured, located[0][None], local)
                return start.with_nuisance(found)
        return start

    def linearize(self, deviation: FloatArray, start: Start) -> Linearization:
        """Linearize at deviations (t, p), nuisance parameters and poses eliminated.

        Nuisance parameters and uncertain poses are those that fit best there; the iteration to them
        begins at `start`.
        """
        advanced = self.advance(deviation, start, engine.Steps(deviation[0], np.zeros((0, 0))))
        if advanced is not None:
            return advanced[0]
        t, known, poses, folds = len(self), None, self.poses, self.folds_plain_rows
        are_shared = poses.is_kept and poses.coordinates.are_shared
        if are_shared and t > 1 and (deviation == deviation[0]).all():
            known = poses.solve_exact_poses(deviation[:1], start, not folds)
        batch, linearizations = self.part_size, []
        for first in range(0, t, batch):
            chosen = np.arange(first, min(first + batch, t))
            z, trials, begin = deviation[chosen], self.trials[chosen], start.take(chosen)
            solution = poses.solve(
                z, trials, begin, self.control, known=known, derivatives=not folds
            )
            linearizations.append(self.take(chosen).linearize_at(z, begin, solution))
        return Linearization.join(linearizations)

    def advance(
        self, deviation: FloatArray, start: Start, steps: engine.Steps
    ) -> tuple[Linearization, engine.Advanced] | None:
        """Take full steps of one trial from a deviation (1, p) and linearize where they end, by one
        call of the engine; None where that is not possible.
        """
        if start.poses is None or len(self) != 1 or not self.folds_plain_rows:
            return None
        if (done := self.poses.fold_compared(deviation, start.poses, steps)) is None:
            return None
        way, states = done
        z, cost = way.deviations[-1:], (way.factor[:, :, -1] ** 2).sum(axis=1)
        near = replace(start, deviation=z, poses=states, is_near=True)
        return Linearization(z, way.factor, cost, self.residual_count, near), way

    def linearize_at(
        self, deviation: FloatArray, start: Start, solution: PoseSolution
    ) -> Linearization:
        """Linearize at deviations (t, p) and a solution there, see `solve`."""
        linearization = self._eliminate(solution, deviation, start)
        if self.consistent is None:
            return linearization
        # directions that the rows do not determine at poses without residuals
        states = self.consistent.move(solution, deviation, self.trials, start)
        moved = replace(solution, states=states, linearized=None, evaluated=None)
        reference = self._eliminate(moved, deviation, start).factor
        return replace(linearization, factor=remove_null_space(linearization.factor, reference))

    def solve(
        self,
        deviation: FloatArray,
        start: Start,
        nuisance: FloatArray | None = None,
        *,
        derivatives: bool = False,
    ) -> PoseSolution:
        """Solve for poses and nuisance parameters at deviations (t, p).

        `nuisance` (t, U) is not solved for. `derivatives` : whether poses are linearized, too.
        """
        trials, control = self.trials, self.control
        return self.poses.solve(
            deviation, trials, start, control, nuisance, derivatives=derivatives
        )

    def residuals(
        self,
        deviation: FloatArray,
        solution: PoseSolution,
        observe: Callable[[int, LinearizedPoses, Sequence[Evaluation | None]], None] | None = None,
    ) -> tuple[Residuals, ...]:
        """Return the residuals of every kind at a solution; NaN where a pose is not reached.

        `observe` receives the number of each block, its poses, and what its rows of each kind
        evaluate to; None for a kind without rows there.
        """
        shapes = [(len(self), *r.whitener.shape[1:3]) for r in self.rows]
        kinds = [Residuals(np.full(shape, np.nan), np.full(shape, np.nan)) for shape in shapes]
        for i, (block, poses) in enumerate(self.poses.iterate_poses(solution, deviation, False)):
            evaluations: list[Evaluation | None] = []
            for kind, numbers, rows in zip(kinds, block.row_numbers, block.rows, strict=True):
                if not len(numbers):
                    evaluations.append(None)
                    continue
                evaluated, white = evaluate_rows(rows, poses, self.trials, solution.nuisance)
                ok = np.all(poses.is_reached[:, rows.poses_by_link], axis=2, keepdims=True)
                raw = np.where(ok, evaluated.residual, np.nan)
                shape = len(raw), len(numbers), -1
                kind.raw[:, numbers] = raw.reshape(shape)
                whitened = rows.whiten(white, raw, self.trials)
                kind.whitened[:, numbers] = whitened.reshape(shape)
                evaluations.append(evaluated)
            if observe is not None:
                observe(i, poses, evaluations)
        return tuple(kinds)

    def leverage_rows(
        self, linearization: Linearization, solution: PoseSolution | None = None
    ) -> Iterator[list[LeverageRows]]:
        """Give, block by block, the rows by everything that they determine (one trial).

        `linearization` is one of this problem, or of the same one with other weights: nuisance
        parameters and their elimination are taken from it. Uncertain poses are where the rows of
        this problem put them at these nuisance parameters, unless a solution is given. Rows of
        targets on the base are left out where readings are exact: they belong to no pose.
        """
        z, estimate = linearization.deviation, linearization.nuisance
        if solution is None:
            fixed = None if estimate is None else estimate.values
            solution = self.solve(z, linearization.next_start, fixed, derivatives=True)
        at_nodes = None if estimate is None else estimate.elimination.at_nodes
        return self._spread_rows(solution, z, at_nodes)

    def rows_at(self, deviation: FloatArray, nuisance: FloatArray) -> Iterator[list[LeverageRows]]:
        """Give the rows like `leverage_rows`, but with nuisance parameters that are not eliminated:
        their columns [1 / SI] are derivatives at given values (1, U).
        """
        start = self.start(deviation, seek=False).with_nuisance(nuisance)
        solution = self.poses.solve(deviation, self.trials, start, self.control, nuisance)
        unknowns, p = self.nuisance, self.parameters
        apart = None if unknowns is None else partial(unknowns.keep_apart, p)
        return self._spread_rows(solution, deviation, apart)

    def _spread_rows(
        self, solution: PoseSolution, z: FloatArray, at_nodes: AtNodes | None
    ) -> Iterator[list[LeverageRows]]:
        """Give the rows of every block of poses, without those of targets on the base."""
        of_base = {i for i, r in enumerate(self.rows) if r.kind.is_of_base}
        for block, node_rows, _ in self.poses.iterate_rows(solution, z, self.trials):
            of_poses = [part for part in node_rows if part.kind not in of_base]
            yield list(spread_rows(self.poses, block, of_poses, at_nodes))

    def _eliminate(self, solution: PoseSolution, z: FloatArray, start: Start) -> Linearization:
        """Fold all rows at a solution and eliminate the nuisance parameters."""
        a, p, poses, trials = len(self), self.parameters, self.poses, self.trials
        nuisance = None if self.nuisance is None else self.nuisance.take(trials)
        factor, is_lost = empty_factor(a, p), np.zeros(a, dtype=bool)
        factors = None if nuisance is None else NodeFactors(nuisance.tree, a, p)
        if self.folds_plain_rows and not solution.has_derivatives:
            factor, is_lost = poses.fold_plain_rows(factor, solution, z, trials)
        else:
            for _, node_rows, lost in poses.iterate_rows(solution, z, trials):
                factor = elimination.fold_node_rows(factor, factors, node_rows)
                is_lost |= lost
                del node_rows  # else the last ones stay in memory
        equations = self.residual_count
        if solution.estimates is not None:
            equations = equations - solution.estimates.rank.sum(axis=1)
        states, is_near = poses.next_start(solution, start)
        next_start = replace(start, deviation=z, poses=states, is_near=is_near)
        estimate = None
        if nuisance is not None and factors is not None and solution.nuisance is not None:
            estimate, rest = nuisance.eliminate(factors, solution.nuisance)
            factor = engine.fold(factor, rest)
            equations = equations + int(nuisance.has_prior.sum()) - estimate.elimination.rank
            slope = estimate.elimination.slope
            next_start = replace(next_start, nuisance=solution.nuisance, slope=slope)
        cost = np.where(is_lost, np.inf, (factor[:, :, -1] ** 2).sum(axis=1))
        return Linearization(z, factor, cost, equations, next_start, estimate, solution.estimates)

    def _first_states(self) -> PoseStates | None:
        """Return the states with which poses begin; None where they are not kept."""
        coordinates = self.poses.coordinates
        if not coordinates.count:
            if coordinates.are_shared and not self.poses.is_kept:
                return None
            return coordinates.first_states(self.trials)
        from loopcal.estimate.pose_coordinates import first_poses

        assert self.sigma is not None
        total = max(len(self.readings), int(self.trials.max(initial=0)) + 1)
        states = first_poses(self.free.robot, self.readings, self.sigma, self.rows[:-1], total)
        return states if len(self.trials) == total else states.take(self.trials)


# Construction of a problem: from the measurements of one machine, or of many simulated ones.

POSE_CONTROL = Halving(attempts=10, stuck=1e-3)
"""Control of the iteration to uncertain poses, which may lie at the end of their reach."""

UNKNOWN_READING = 1e-3
"""Unit of a reading that was not taken: this share of the robot's size, or this many radians. It
has no row."""


def problem_of(
    free: FreeParameters, data: Measurements, stated: NuisanceParameters | None = None
) -> Problem:
    """Return the problem of one machine's measurements.

    Where readings have a sigma above 0, poses are unknowns, too. `stated` are the nuisance
    parameters of the measurements, default as stated there.
    """
    nuisance = data.nuisance_parameters if stated is None else stated
    rows = list_rows(data, nuisance)
    return make_problem(
        free, data.readings[None], data.reading_sigma, rows, 1, nuisance, lambda _: data
    )


def problem_of_trials(
    free: FreeParameters, trials: Trials, nuisance: NuisanceParameters | None = None
) -> Problem:
    """Return the problem of t simulated machines; `nuisance`: other than those of the kinds."""
    sensors, first = trials.instrument.sensors, trials.trial(0)
    local = nuisance or first.nuisance_parameters
    order = sorted(range(len(sensors)), key=lambda i: sensors[i].kind.is_of_base)  # stable
    rows = []
    for i, (number, o) in enumerate(zip(order, first.all_observations, strict=True)):
        sensor, measured = sensors[number], trials.measured[number]
        kind, places, factor = sensor.kind, local.indices[i], local.factor(i)
        white = _compute_whiteners(sensor, measured)
        poses = anchor_rows(o, first.observations) if kind.is_of_base else sensor.assigned_rows
        rows.append(ObservationRows(kind, poses, measured, white, places, factor))
    recorded = trials.readings[None] if trials.recorded is None else trials.recorded
    return make_problem(
        free, recorded, trials.reading_sigma, tuple(rows), len(trials), local, trials.trial
    )


def _compute_whiteners(sensor: Sensor, measured: FloatArray) -> FloatArray:
    """Return the whiteners (t | 1, r, m, m) of the rows of a sensor, one set where those of all
    trials are equal.
    """
    kind, step = sensor.kind, max(1, BLOCK // max(1, measured.shape[1]))
    batches = [measured[first : first + step] for first in range(0, len(measured), step)]
    first = _list_noise(kind, batches[0][:1])
    sight = sensor.noise.sight
    if not sight and all(_is_equal(_list_noise(kind, batch), first) for batch in batches):
        batches = [batches[0][:1]]
    white = []
    for batch in batches:  # so that what they are computed with stays small
        N, present = _list_noise(kind, batch)
        covariance = (N * np.asarray(sensor.noise.sigma) ** 2) @ np.swapaxes(N, -1, -2)
        spread = kind.spread_sight_noise(batch) if sight else {}
        covariance = sum((sd * sd * spread[name] for name, sd in sight.items()), covariance)
        t, r, m = present.shape
        flat = np.broadcast_to(covariance, (t, r, m, m)).reshape(-1, m, m)
        whitener = compute_whitener(flat, present.reshape(-1, m), np.ones(t * r))
        white.append(whitener.reshape(t, r, m, m))
    return np.concatenate(white)


def _list_noise(kind: Kind, measured: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return by what noise changes the columns, and which residuals exist, of trials (t, ..)."""
    return kind.linearize_noise(measured), kind.detect_present(measured)


def _is_equal(noise: tuple[FloatArray, BoolArray], first: tuple[FloatArray, BoolArray]) -> bool:
    """Return whether all trials have the noise of the first one."""
    return all(
        np.array_equal(a[:1], b) and (not a.strides[0] or bool((a == b).all()))
        for a, b in zip(noise, first, strict=True)
    )


def make_problem(
    free: FreeParameters,
    recorded: FloatArray,
    sigma: FloatArray | None,
    rows: tuple[ObservationRows, ...],
    trials: int,
    local: NuisanceParameters,
    data: Callable[[int], Measurements],
) -> Problem:
    """Return the problem of observed rows at readings (t | 1, n, actuators) [SI].

    `sigma` (n, actuators) [SI] of the readings; None where they are exact unless the robot states
    the sigma of its actuators.
    """
    believed = resolve_reading_sigma(free.robot, sigma, recorded.shape[1])
    consistent = _plan_consistent_poses(free, recorded, believed, rows)
    if believed is None:
        problem = make_exact_problem(free, recorded[:1], rows, trials, local, data)
        return replace(problem, consistent=consistent)
    poses = _make_uncertain_rows(free, recorded, believed, rows)
    poses = replace(poses, nuisance=elimination.plan_elimination(local, rows, poses.member))
    numbers = np.arange(trials)
    return Problem(poses, recorded, numbers, data, POSE_CONTROL, believed, consistent)


def make_exact_problem(
    free: FreeParameters,
    readings: FloatArray,
    rows: tuple[ObservationRows, ...],
    trials: int,
    local: NuisanceParameters,
    data: Callable[[int], Measurements],
) -> Problem:
    """Return the problem of observed rows at exact readings (1, n, actuators) [SI], without poses
    at which rank is decided.
    """
    coordinates = PoseCoordinates(free, list_sensed_joints(r.kind for r in rows), readings)
    member = np.zeros(readings.shape[1], dtype=np.int64)
    poses = PoseRows(free, rows, elimination.plan_elimination(local, rows), coordinates, member)
    return Problem(poses, readings, np.arange(trials), data)


def _make_uncertain_rows(
    free: FreeParameters, recorded: FloatArray, sigma: FloatArray, rows: tuple[ObservationRows, ...]
) -> PoseRows:
    """Return the rows, and those of uncertain readings, (true - recorded) / sigma, before nuisance
    parameters are eliminated.
    """
    robot, is_row = free.robot, np.isfinite(sigma) & (sigma > 0.0)
    weight = np.where(is_row, 1.0 / np.where(is_row, sigma, 1.0), 0.0)
    white = weight[None, :, :, None] * np.eye(sigma.shape[1])
    readings = ObservationRows(make_readings_kind(robot), np.arange(len(sigma)), recorded, white)
    all_rows = (*rows, readings)
    names = list_sensed_joints(r.kind for r in all_rows)
    if robot.redundancy is None:
        scale = np.where(np.isinf(sigma), UNKNOWN_READING * _reading_units(robot), sigma)
        coordinates: PoseCoordinates = ReadingCoordinates(free, names, scale)
    else:
        coordinates = TwistCoordinates(free, names)
    member = find_components(recorded.shape[1], all_rows, coordinates.count)
    return PoseRows(free, all_rows, None, coordinates, member)


def _plan_consistent_poses(
    free: FreeParameters,
    recorded: FloatArray,
    sigma: FloatArray | None,
    rows: tuple[ObservationRows, ...],
) -> ConsistentPoses | None:
    """Return poses that follow the rows of kinds that mix their components; None without any."""
    mixing = tuple(_without_noise(r) for r in rows if r.kind.mixes_components and len(r.poses))
    if not mixing:
        return None
    loose = np.broadcast_to(LOOSE * _reading_units(free.robot), recorded.shape[1:])
    if sigma is not None:
        loose = np.where(np.isinf(sigma), np.inf, loose)
    return ConsistentPoses(_make_uncertain_rows(free, recorded, loose, mixing), recorded)


def _reading_units(robot: Mechanism) -> FloatArray:
    """Return the units (actuators,) of readings [SI]: the size of the robot, or a radian."""
    return np.array(
        [robot.size if a.dimension is Dimension.LENGTH else 1.0 for a in robot.actuators]
    )
