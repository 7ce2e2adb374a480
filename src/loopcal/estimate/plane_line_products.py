# SPDX-License-Identifier: Apache-2.0
"""Products of points on planes and perpendicular lines, as a published study identifies a hexapod
from points that a coordinate measuring machine holds; many machines at once.

    (14) (p_i - p_0)'(p_1 - p_0) = 0
         points i on a plane, the line from p_0 to p_1 perpendicular to it
    (17) a_i e = c_i
         a_i = d_i'(J_1 - J_0) + d_1'(J_i - J_0),  c_i = -d_i'd_1
    (18) e = (A'A)^-1 A'c, again and again

with d_i = p_i - p_0 by forward kinematics at the present parameters and J_i their slopes. The frame
of the coordinate measuring machine cancels. Points of a group share p_0 and p_1, so their
rows are correlated: noise dp of the points moves row i by B dp,

    d(d_i'd_1) = d_1'dp_i + d_i'dp_1 - (d_1 + d_i)'dp_0

and the covariance of the rows is B S B'. The paper gives every row weight one. A'A is singular, see
the study `cmm-constraint-2011`: least squares here takes the smallest deviation along unobservable
directions. Derivation, and why this equals surfaces as unknowns: docs/theory/constraint.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from loopcal import geometry
from loopcal.engine import State
from loopcal.estimate.descent import Descent, FunctionProblem, StepControl, descend
from loopcal.estimate.penalties import Method
from loopcal.measure.instrument import make_random_stream
from loopcal.mechanism.kinematics import compute_readings, forward_trials, inverse_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.states import Status
from loopcal.typing import BoolArray, FloatArray, IntArray

Weights = Literal["printed", "distance", "single", "full"]
"""Rows as printed; divided by |d_1|, a distance from the plane; divided by their own sd; with their
full covariance.
"""
WEIGHTS: tuple[Weights, ...] = get_args(Weights)


@dataclass(frozen=True, eq=False)
class Layout:
    """Which points a machine is sent to.

    Attributes
    ----------
    robot : as designed; the origin of its tool is the end point. coordinates : (g, k, 6)
        controlled [m, rad] of g groups: p_0, p_1 on the line, the others in the plane.
    """

    robot: Mechanism
    coordinates: FloatArray

    @property
    def groups(self) -> int:
        """Number of groups g."""
        return len(self.coordinates)

    @property
    def points(self) -> int:
        """Number of points n of all groups."""
        return self.coordinates.shape[0] * self.coordinates.shape[1]

    @property
    def equations(self) -> int:
        """Number of rows: one for each point of a plane but its foot."""
        return self.points - 2 * self.groups

    @cached_property
    def flat(self) -> FloatArray:
        """(n, 6) coordinates, group after group."""
        return self.coordinates.reshape(self.points, -1)

    @cached_property
    def state(self) -> State:
        """Where the machine as designed stands, (1, n)."""
        return inverse_trials(self.robot, self.robot.parameters.nominal[None], self.flat[None])

    @cached_property
    def commanded_readings(self) -> FloatArray:
        """(n, a) readings of the machine as designed at the points."""
        return compute_readings(self.robot, self.robot.parameters.nominal[None], self.state)[0]

    @cached_property
    def levers(self) -> tuple[FloatArray, FloatArray]:
        """d_1 (g, 3) and d_i (g, k - 2, 3) [m] as commanded."""
        points = (self.state.T[0] @ self.robot.tool)[:, :3, 3]
        return compute_levers(points.reshape(self.groups, -1, 3))

    def hold_points(self, truth: FloatArray, noise: FloatArray) -> tuple[State, FloatArray]:
        """Return states (t, n) and readings (t, n, a) of true machines (t, p) [SI] whose end point
        is held where it was commanded to, but for noise (t, n, 3) [m].
        """
        target = np.repeat(self.flat[None], len(truth), axis=0)
        target[:, :, [self.robot.controlled.index(name) for name in POSITION]] += noise
        state = inverse_trials(self.robot, truth, target, self.state)
        return state, compute_readings(self.robot, truth, state)

    def solve_readings(self, truth: FloatArray, sigma: float, seed: int) -> FloatArray:
        """Return readings (t, n, a) at which true machines (t, p) [SI] hold the coordinates of the
        measuring machine.

        The true end point stands where it was commanded to, but for Gaussian noise of `sigma` [m]
        in x, y and z. Trial i draws the same numbers whatever sigma and however many trials there
        are.
        """
        noise = np.stack(
            [
                make_random_stream(seed, trial).standard_normal((self.points, 3))
                for trial in range(len(truth))
            ]
        )
        return self.hold_points(truth, sigma * noise)[1]

    def linearize_points(
        self, values: FloatArray, q: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return points (t, g, k, 3) [m], their derivatives (t, g, k, 3, p), and which machines
        reach all of them (t,).
        """
        state = forward_trials(self.robot, values, q, self.state)
        by_twist = differentiate_pose(self.robot, values, q, state).parameters
        arm = state.T[:, :, :3, :3] @ self.robot.tool[:3, 3]
        D = by_twist[:, :, 3:] - geometry.hat(arm) @ by_twist[:, :, :3]
        shape = (len(values), self.groups, -1, 3)
        reached = np.all(state.status == Status.CONVERGED, axis=1) & np.isfinite(D).all(
            axis=(1, 2, 3)
        )
        return (state.T[:, :, :3, 3] + arm).reshape(shape), D.reshape(*shape, D.shape[3]), reached


@dataclass(frozen=True, eq=False)
class PaperRows:
    """Equations (17) of t machines as a problem for the library's descent.

    Attributes
    ----------
    layout : the points. q : (t, n, a) readings. sd : of all parameters or of each (p,) [SI], in
        which deviations are counted; 0 keeps a parameter at its nominal value.
    weights : of the rows. sigma : of the noise of a point [m].
    """

    layout: Layout
    q: FloatArray
    sd: float | FloatArray
    sigma: float
    weights: Weights = "full"

    @property
    def parameters(self) -> int:
        """p."""
        return len(self.layout.robot.parameters)

    @cached_property
    def whitener(self) -> FloatArray:
        """(g, k - 2, k - 2) what the rows of a group are multiplied by; made at the points as
        commanded.
        """
        return build_whitener(*self.layout.levers, self.sigma, self.weights)

    def values(self, deviation: FloatArray) -> FloatArray:
        """Return parameters (t, p) [m] at deviations z (t, p)."""
        return self.layout.robot.parameters.nominal + self.sd * deviation

    def whiten(self, deviation: FloatArray, trials: IntArray) -> tuple[FloatArray, BoolArray]:
        """Return rows (a, m, p + 1), [A | residual], of some machines at deviations (a, p), and
        which machines reach all points.
        """
        points, J, reached = self.layout.linearize_points(self.values(deviation), self.q[trials])
        A, c = linearize_products(points, J * self.sd)
        rows = self.whitener @ np.concatenate([A, -c[..., None]], axis=-1)
        return rows.reshape(len(trials), self.layout.equations, -1), reached

    def fold(self, deviation: FloatArray, trials: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return factor (a, p + 1, p + 1) and sum of squares (a,) of some machines."""
        if not deviation.any() and len(trials) == len(self.q):
            factor, cost = self.nominal_fold
            return factor.copy(), cost.copy()
        return self._fold(deviation, trials)

    @cached_property
    def nominal_fold(self) -> tuple[FloatArray, FloatArray]:
        """Fold of all machines as designed, from which every method begins."""
        return self._fold(np.zeros((len(self.q), self.parameters)), np.arange(len(self.q)))

    def _fold(self, deviation: FloatArray, trials: IntArray) -> tuple[FloatArray, FloatArray]:
        rows, reached = self.whiten(deviation, trials)
        short = max(rows.shape[2] - rows.shape[1], 0)
        rows = np.concatenate([rows, np.zeros((len(rows), short, rows.shape[2]))], axis=1)
        factor = np.asarray(np.linalg.qr(np.where(reached[:, None, None], rows, 0.0), mode="r"))
        return factor, np.where(reached, np.sum(rows[:, :, -1] ** 2, axis=1), np.inf)


def identify_from_rows(problem: PaperRows, method: Method, relative: float = 1e-2) -> Descent:
    """Iterate (18) with the library's filters and step control, from the machine as designed.

    The last step changes the residuals by at most `relative` of their norm and is still taken, so
    that the next one would change them by its square or so.
    """
    begin = np.zeros((len(problem.q), problem.parameters))
    equations = np.full(len(problem.q), problem.layout.equations)
    rows = FunctionProblem(problem.parameters, problem.fold, equations)
    return descend(rows, begin, method, StepControl(relative=relative))


def compute_levers(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return d_1 (.., 3) and d_i (.., k - 2, 3) of points (.., k, 3)."""
    return points[..., 1, :] - points[..., 0, :], points[..., 2:, :] - points[..., :1, :]


def linearize_products(points: FloatArray, J: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return equations (17): a (.., k - 2, p) and c (.., k - 2) of points (.., k, 3) [m] with
    slopes J (.., k, 3, p).
    """
    d_1, d = compute_levers(points)
    slope_1 = J[..., 1, :, :] - J[..., 0, :, :]
    slope = J[..., 2:, :, :] - J[..., :1, :, :]
    a = d @ slope_1 + (d_1[..., None, None, :] @ slope)[..., 0, :]
    return a, -(d @ d_1[..., None])[..., 0]


def map_displacements(d_1: FloatArray, d: FloatArray) -> FloatArray:
    """Return B (g, k - 2, 3 k): how displacements of the points (p_0, p_1, p_2 ..) move the rows
    d_i'd_1 of a group.
    """
    g, r = d.shape[:2]
    B = np.zeros((g, r, r + 2, 3))
    B[:, :, 0] = -(d + d_1[:, None])
    B[:, :, 1] = d
    B[:, np.arange(r), 2 + np.arange(r)] = d_1[:, None]
    return B.reshape(g, r, -1)


def build_whitener(d_1: FloatArray, d: FloatArray, sigma: float, weights: Weights) -> FloatArray:
    """Return W (g, k - 2, k - 2) for rows of points with noise of `sigma` [m] in x, y and z: S =
    sigma^2 1.

    "printed": all rows alike, divided by the root mean square of their sds, so that a prior can be
    set against them.
    """
    B = map_displacements(d_1, d)
    unit = np.broadcast_to(np.eye(d.shape[1]), (*d.shape[:2], d.shape[1]))
    sd = sigma * np.linalg.norm(B, axis=2)
    if weights == "printed":
        return unit / np.sqrt(np.mean(sd**2))
    if weights == "distance":
        length = np.linalg.norm(d_1, axis=1)[:, None]
        return unit / (length * np.sqrt(np.mean((sd / length) ** 2)))[..., None]
    if weights == "single":
        return unit / sd[..., None]
    return np.asarray(
        np.linalg.inv(np.linalg.cholesky(sigma**2 * B @ np.swapaxes(B, 1, 2))), dtype=np.float64
    )
