# SPDX-License-Identifier: Apache-2.0
"""Information that measurements hold of a robot at its present values.

Rows are [F | A | r]: nuisance parameters, the robot's free parameters in tolerances, the residual,
all whitened. Identifiability is read from the triangular factor of what is left of A once F is
eliminated: the projection onto the complement of F, without forming it. See
docs/theory/identification.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from loopcal import engine
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.linearization import LinearizedPoses, linearize_poses
from loopcal.estimate.penalties import Method, decompose_for
from loopcal.estimate.problem import Problem, problem_of
from loopcal.estimate.unfixed_motions import frame_twists
from loopcal.measure.initial_values import evaluate_measurements, whiten_rows
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import NuisanceParameters
from loopcal.measure.readings import resolve_reading_sigma
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import RANK_TOLERANCE, empty_factor
from loopcal.numerics.elimination import eliminate_from_factor
from loopcal.typing import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class ObservedPoses:
    """Poses of a robot, solved and linearized once, that any kind may observe.

    free : the free parameters. readings : (n, actuators) [SI]. linearized : (1, n) poses.
    """

    free: FreeParameters
    readings: FloatArray
    linearized: LinearizedPoses

    @property
    def T(self) -> FloatArray:
        """(1, n, 4, 4) T_base_platform [m]."""
        return self.linearized.T

    @property
    def twists(self) -> FloatArray:
        """(1, n, 6, p) by deviations in tolerances."""
        return self.linearized.by_parameters

    @property
    def joints(self) -> Mapping[str, FloatArray]:
        """name -> (1, n) values [SI] of the joints that were asked for."""
        return self.linearized.joints

    def by_frames(self) -> ObservedPoses:
        """Return the poses with derivatives by motions of the base and platform frames, see
        `frame_twists`, in place of the parameters.
        """
        by_frames = frame_twists(self.T, self.free.robot.size)
        moved = replace(self.linearized, by_parameters=by_frames, joints_by_parameters={})
        return replace(self, linearized=moved)

    @property
    def is_reached(self) -> BoolArray:
        """(n,) poses at which the loops close."""
        return self.linearized.is_reached[0]


def observe_poses(
    free: FreeParameters, readings: FloatArray, joints: Iterable[str] = ()
) -> ObservedPoses:
    """Solve and linearize a robot at readings (n, actuators) and its present values.

    `joints` are names of joints whose values and derivatives are needed.
    """
    values = free.robot.values[None]
    state = forward_trials(free.robot, values, readings[None])
    poses = linearize_poses(free, values, readings[None], state, tuple(joints))
    return ObservedPoses(free, readings, poses)


def observe_rows(
    poses: ObservedPoses, measured: Measurements, nuisance: NuisanceParameters, values: FloatArray
) -> FloatArray:
    """Return whitened rows (1, M, U + p + 1), [nuisance | machine | residual], of measurements.

    `values` (U,) are those of the nuisance parameters `nuisance`. The columns of the machine are
    those of `poses.linearized`.
    """
    linearized = poses.linearized
    evaluated = evaluate_measurements(
        measured, linearized.T, values[None], nuisance, linearized.joints
    )
    rows = whiten_rows(evaluated, linearized.by_parameters, linearized.joints_by_parameters)
    p, u = linearized.by_parameters.shape[-1], len(nuisance)
    return np.concatenate([rows[..., p : p + u], rows[..., :p], rows[..., p + u :]], axis=-1)


def collect_information(free: FreeParameters, data: Measurements) -> tuple[FloatArray, BoolArray]:
    """Return the factor (1, p + 1, p + 1) of all rows [A | r] of measurements at the robot's
    present values, nuisance parameters eliminated, and the poses (n,) that close or that no row
    needs. Nuisance parameters and uncertain poses are where the measurements put them.
    """
    problem = problem_of(free, data)
    z = free.deviation(free.robot.values[None])
    start = problem.start(z)
    linearization = problem.linearize(z, start)
    is_reached = np.ones(data.n_poses, dtype=bool)
    if not np.isfinite(linearization.cost[0]):
        is_reached[problem.poses.find_unreached(z, start)] = False
    return linearization.factor, is_reached


def count_equations(robot: Mechanism, data: Measurements) -> int:
    """Return how many equations measurements give.

    They are the present residuals and, where readings are uncertain, less those that poses take up.
    """
    if resolve_reading_sigma(robot, data.reading_sigma, data.n_poses) is None:
        return data.n_rows
    return int(problem_of(select_free_parameters(robot), data).equations[0])


def has_equations_to_spare(
    problem: Problem, z: FloatArray, method: Method, tolerance: float = RANK_TOLERANCE
) -> bool:
    """Return whether the equations (t = 1) that setup parameters leave determine, at deviations z
    (1, p), all parameters without a penalty, or are more than the directions that they determine.

    Otherwise their number limits the rank. Poses out of reach count as spared: a fit names them.
    """
    rows = problem.linearize(z, problem.start(z))
    if not np.isfinite(rows.cost[0]):
        return True
    d = decompose_for(method, rows.factor, rows.equations, z, tolerance)
    required = method.required_equations(problem.parameters)
    determined = d.used if d.unpenalized is None else d.used & d.unpenalized
    rank = min(int(determined.sum()), required)
    return int(rows.equations[0]) > rank or rank == required > 0


def instrument_factor(poses: ObservedPoses, measured: Measurements) -> FloatArray:
    """Return the factor (1, p + 1, p + 1) of one instrument's rows at observed poses.

    Its nuisance parameters are eliminated at their stated values.
    """
    nuisance = measured.nuisance_parameters
    rows = observe_rows(poses, measured, nuisance, nuisance.values())
    factor = engine.fold(empty_factor(1, len(nuisance) + len(poses.free)), rows)
    has_prior = nuisance.table.free & ~np.isnan(nuisance.table.tolerance)
    weight = np.where(has_prior, 1.0 / np.where(has_prior, nuisance.table.tolerance, 1.0), 0.0)
    nothing = np.zeros((len(nuisance), len(poses.free) + 1))
    prior_rows = np.concatenate([np.diag(weight), nothing], axis=1)[None]
    return eliminate_from_factor(engine.fold(factor, prior_rows), len(nuisance))
