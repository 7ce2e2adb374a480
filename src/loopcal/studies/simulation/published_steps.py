# SPDX-License-Identifier: Apache-2.0
"""Identification as published studies do it, many trials at once.

Full steps on raw rows: every row has weight one in millimeters and radians, every parameter is
counted in millimeters and radians, steps are neither damped nor checked, and the filter acts on the
step. The iteration ends when the largest component of a step is at most epsilon. With H = U S V'
and s_i = S_ii the step is sum f_i (u_i'D / s_i) v_i, where f_i = 1 for least squares (without rank
detection), s_i^2 / (s_i^2 + lam) for ridge, and 1 for i <= k, else 0, for truncated SVD. One lam
per parameter, (H'H + diag(lam))^-1 H'D, is the same filter with lam = 1 for H diag(lam)^(-1/2). The
result depends on the number of steps and on the units; use `identify` for real work. Source: "least
squares, ridge estimation and truncated SVD", Advances in Mechanical Engineering 2016,
doi:10.1177/1687814016667908.

Products of points on planes and perpendicular lines, of a hexapod whose points a coordinate
measuring machine holds:

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

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from loopcal import geometry
from loopcal.engine import State, fold
from loopcal.errors import EstimationError
from loopcal.estimate.descent import Descent, StepControl, descend
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.linearization import Linearization, Start
from loopcal.estimate.penalties import LeastSquares, Method
from loopcal.estimate.problem import Problem, problem_of_trials
from loopcal.findings.wording import name_count
from loopcal.measure.instrument import Gaussian
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import Trials
from loopcal.mechanism.inverse import inverse_trials
from loopcal.mechanism.kinematics import compute_readings, forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import Solution, forward, inverse
from loopcal.mechanism.states import Status
from loopcal.numerics.decomposition import Decomposition, are_nonzero, decompose, empty_factor
from loopcal.results.description import Field, fields
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

MM = 1e-3
EPSILON = 1e-6  # largest component of a step [mm, rad] at which the iteration ends by default
LIMIT = 1_000_000  # steps at most; ridge steps shorten slowly, and 100,000 of them are common
# Steps of least squares and truncated SVD at most, unless their number is stated.
LINEARIZATIONS = 40

SINGLE, AHEAD, BACK = 20, 0.5, 0.125
"""Steps of ridge that are computed one by one. How many are then taken with one H, as a share of
the steps done before, and at most, as a share of the steps left.

Ridge converges in many steps that hardly change the machine, and so hardly change H. With the same
H the sum of m steps has a closed form, the filter 1 - (lam / (s^2 + lam))^m. It starts at the state
before, so that the H of the middle carries both leaps. A leap leaves well-determined directions
where the H before saw their end, so leaps get shorter before the limit. In the study `tsvd-2016`
errors of poses differ by 1e-5 from those of 100,000 single steps on the 3-PRS. On the RU-PUS-PRS
they differ from those of leaps of 2 % by 1e-3 (median over machines) and 2e-2 (largest).
"""

LOST = 1e4  # a step of more than this [mm, rad] has diverged: ten meters


LEG_STEPS = 3  # steps of a fit leg by leg, unless another number is stated

Stop = Literal["step", "dQint"]
"""What the epsilon of a fit leg by leg limits: the largest component of a step [mm, rad], or the
largest integrated error of a pose after a step [mm + rad], see `integrate_errors`. The latter is
the rule of the study hexapod-42.
"""


@dataclass(frozen=True)
class StepRule:
    """When the steps end.

    epsilon : largest component of a step [mm, rad] at which they end; 0 takes `limit` steps.
    limit : steps at most. ahead : see `AHEAD`; 0 computes H for every step.
    """

    epsilon: float = EPSILON
    limit: int = LIMIT
    ahead: float = AHEAD

    def plan_leap(self, count: IntArray) -> IntArray:
        """Return how many steps to take with one H after `count` (a,) steps."""
        wanted = np.where(count < SINGLE, 1.0, self.ahead * count)
        return np.maximum(1.0, np.minimum(wanted, BACK * (self.limit - count))).astype(np.int64)

    @property
    def matrices(self) -> int:
        """Number of matrices H with which the limit is reached, if no step before is small."""
        count, number = np.zeros(1, dtype=np.int64), 0
        while count[0] < self.limit:
            count, number = count + self.plan_leap(count), number + 1
        return number


@dataclass(frozen=True, eq=False)
class RawSteps:
    """Result of the steps of t trials; index k of a history is the state at the k-th H.

    values : (t, p) identified parameters [SI], NaN where diverged. history : (k + 1, t, p) [SI],
        NaN from the step on that diverged.
    steps : (k, t) largest component of the first step with each H [mm, rad], NaN after the end and
        where it diverged. done : (k + 1, t) steps before each state of the history.
    is_converged, is_diverged : (t,); neither: ended by the limit of steps or of matrices.
    """

    values: FloatArray
    history: FloatArray
    steps: FloatArray
    done: IntArray
    is_converged: BoolArray
    is_diverged: BoolArray

    @property
    def count(self) -> IntArray:
        """(t,) steps done."""
        return self.done[-1]


@dataclass(frozen=True, eq=False)
class RawProblem:
    """Raw rows of t trials.

    problem : with a noise of one millimeter and one radian as whitener, and with parameters in
        millimeters and radians. start : the poses of the nominal robot. method : in whose
        coordinates H is decomposed, a ridge with one lam per parameter or any other method.
    """

    problem: Problem
    start: Start
    method: Method = field(default_factory=LeastSquares)

    def __len__(self) -> int:
        return len(self.problem)

    def take(self, trials: IntArray) -> RawProblem:
        """Return the problem of some trials, which may repeat."""
        return replace(self, problem=self.problem.take(trials), start=self.start.take(trials))

    def linearize(self, values: FloatArray) -> tuple[Decomposition, BoolArray]:
        """Return the decomposition of H at values (t, p) [SI], and which trials reach all poses."""
        z = self.problem.free.deviation(values)
        linearized = self.problem.linearize(z, self.start)
        factor = linearized.factor
        reached = np.isfinite(linearized.cost) & np.isfinite(factor).all(axis=(1, 2))
        safe = np.where(reached[:, None, None], factor, 0.0)
        safe[:, :, -1] *= -1.0  # the rows end with predicted minus measured
        p, how = z.shape[1], self.method
        unpenalized, root = how.unpenalized(p), how.root(p)
        d = decompose(safe, linearized.equations, tolerance=0.0, unpenalized=unpenalized, root=root)
        return d, reached


def make_raw_problem(robot: Mechanism, trials: Trials, method: Method | None = None) -> RawProblem:
    """Return the raw rows of trials, which begin with the values of the robot."""
    free = select_free_parameters(robot)
    dimensions = [robot.parameters.dimensions[i] for i in free.places]
    free = replace(free, tolerance=list_raw_units(dimensions), correlation=None)
    sensors = tuple(
        replace(s, noise=Gaussian(list_raw_units([c.dimension for c in s.kind.noise_columns])))
        for s in trials.instrument.sensors
    )
    instrument = replace(trials.instrument, sensors=sensors)
    problem = problem_of_trials(free, replace(trials, instrument=instrument))
    z = np.repeat(free.deviation(robot.values[None]), len(trials), axis=0)
    start = problem.linearize(z, problem.start(z)).next_start
    return RawProblem(problem, replace(start, is_near=False), method or LeastSquares())


def take_steps(raw: RawProblem, penalty: FloatArray, rule: StepRule | None = None) -> RawSteps:
    """Take full steps from the values of the robot until they are small.

    raw : of t trials. penalty : (t | 1, p) of the directions: 0 for least squares, lam for ridge (1
        where `raw.method` has one lam per parameter), infinite for directions that truncated SVD
        does not use. rule : when the steps end.
    """
    rule = rule or StepRule()
    free, t = raw.problem.free, len(raw)
    penalty = np.broadcast_to(penalty, (t, penalty.shape[1]))
    values = np.repeat(free.robot.values[None], t, axis=0)
    diverged, converged = np.zeros(t, dtype=bool), np.zeros(t, dtype=bool)
    count, before, last = np.zeros(t, dtype=np.int64), values.copy(), np.zeros(t, dtype=np.int64)
    is_ridge = ((penalty > 0.0) & np.isfinite(penalty)).any(axis=1)
    most = np.where(is_ridge | (rule.epsilon == 0.0), rule.limit, min(rule.limit, LINEARIZATIONS))
    history, steps, done = [values.copy()], [], [count.copy()]
    for _ in range(rule.matrices if rule.epsilon else rule.limit):
        active = np.flatnonzero(~diverged & ~converged & (count < most))
        if not active.size:
            break
        decomposition, reached = raw.take(active).linearize(values[active])
        wanted, penalized = rule.plan_leap(count[active]), penalty[active]
        if decomposition.unpenalized is not None:
            penalized = np.where(decomposition.unpenalized, 0.0, penalized)
        taken = _count_steps(decomposition, penalized, wanted, rule.epsilon)
        size = _measure_step(decomposition, penalized, np.zeros(len(active), np.int64))
        is_leap = taken > 1
        start = (before[active] - values[active])[:, free.places] / free.tolerance
        start *= is_leap[:, None]
        total = taken + np.where(is_leap, last[active], 0)
        change = _sum_steps(decomposition, penalized, total, start)
        good = reached & (size < LOST) & (np.abs(change).max(axis=1) < LOST)
        moved = np.where(good[:, None], change, np.nan) * free.tolerance
        before[active], last[active] = values[active], taken
        values[np.ix_(active, free.places)] += moved
        count[active] += np.where(good, taken, 1)
        is_small = size <= rule.epsilon if rule.epsilon else np.zeros(len(active), dtype=bool)
        converged[active], diverged[active] = good & is_small, ~good
        history.append(values.copy())
        done.append(count.copy())
        steps.append(np.full(t, np.nan))
        steps[-1][active] = np.where(good, size, np.nan)
    size = np.stack(steps) if steps else np.zeros((0, t))
    return RawSteps(values, np.stack(history), size, np.stack(done), converged, diverged)


def list_raw_units(dimensions: Sequence[Dimension]) -> FloatArray:
    """Return the raw units in SI: millimeters for lengths, radians for angles, one for ratios."""
    return np.where([d is Dimension.LENGTH for d in dimensions], MM, 1.0)


def penalize_ridge(lam: FloatArray, parameters: int) -> FloatArray:
    """Return the penalties (l, p) of ridge for each lam (l,)."""
    return np.repeat(np.asarray(lam, dtype=np.float64)[:, None], parameters, axis=1)


def penalize_truncated(k: IntArray, parameters: int) -> FloatArray:
    """Return the penalties (l, p) of truncated SVD for each k (l,): infinite beyond it."""
    return np.where(np.arange(parameters) < np.asarray(k)[:, None], 0.0, np.inf)


def _sum_steps(
    decomposition: Decomposition, penalty: FloatArray, count: IntArray, start: FloatArray
) -> FloatArray:
    """Return the deviation (a, p) after `count` (a,) steps with the same H from a deviation
    `start` (a, p).

    Step m + 1 from y = V'start has the filter f r^m with f = s^2 / (s^2 + penalty) and r = 1 - f,
    so that the sum has the filter 1 - r^m.
    """
    s, y = decomposition.singular_values, decomposition.coordinates(start)
    kept = 1.0 - (1.0 - decomposition.filter_factors(penalty)) ** count[:, None]
    end = np.divide(decomposition.projections, s, out=y.copy(), where=s > 0.0)
    return decomposition.deviation(y + kept * (end - y))


def _measure_step(
    decomposition: Decomposition, penalty: FloatArray, before: IntArray
) -> FloatArray:
    """Return the largest component (a,) of the step after `before` (a,) steps with this H."""
    left = (1.0 - decomposition.filter_factors(penalty)) ** before[:, None]
    step = decomposition.deviation(left * decomposition.solution(penalty))
    return np.abs(step).max(axis=1)


def _count_steps(
    decomposition: Decomposition, penalty: FloatArray, wanted: IntArray, epsilon: float
) -> IntArray:
    """Return how many of the `wanted` (a,) steps are larger than epsilon, and one at least."""
    low, high = np.ones_like(wanted), np.maximum(wanted, 1)
    while (low < high).any():
        middle = (low + high) // 2
        is_small = _measure_step(decomposition, penalty, middle) <= epsilon
        low, high = np.where(is_small, low, middle + 1), np.where(is_small, middle, high)
        low = np.minimum(low, high)
    return low


# The six least-squares problems of the paper's section 3: changes of leg length by parameters.

# Share of a column of G, relative to its largest entry, that counts as no effect on a leg.
SHARED = 1e-9


@dataclass(frozen=True, eq=False)
class LegForm:
    """The matrices at one machine.

    G : (n, 6, p) change of each leg's length with the parameters.
    S : (n, 6, 6) twist by leg lengths. D : (n, 6, p) twist by parameters.
    members : for each leg, the positions of its free parameters.
    """

    G: FloatArray
    S: FloatArray
    D: FloatArray
    members: tuple[IntArray, ...]

    @classmethod
    def at(cls, machine: Mechanism, solution: Solution) -> LegForm:
        """Linearize a machine at solved poses."""
        slopes = differentiate_pose(machine, machine.values[None], solution.q[None], solution.state)
        S, D = slopes.readings[0], slopes.parameters[0]
        G = np.asarray(np.linalg.solve(S, D), dtype=np.float64)
        size = np.abs(G).max(axis=0)
        touched = machine.parameters.free & (size > SHARED * size.max(axis=0, keepdims=True))
        members = tuple(np.flatnonzero(row) for row in touched)
        return cls(G, S, D, members)

    def compute_lengths(self, twists: FloatArray) -> FloatArray:
        """Return the changes of leg length (n, 6) [m] that twists (n, 6) mean."""
        return np.asarray(np.linalg.solve(self.S, twists[..., None])[..., 0], dtype=np.float64)

    def fit(self, twists: FloatArray) -> FloatArray:
        """Return the change (p,) of the parameters that fits twists (n, 6) best, leg by leg."""
        lengths, change = self.compute_lengths(twists), np.zeros(self.G.shape[2])
        for leg, members in enumerate(self.members):
            change[members] = np.linalg.lstsq(self.G[:, leg, members], lengths[:, leg])[0]
        return change

    def count_legs(self) -> IntArray:
        """Return the number (p,) of legs that each free parameter moves."""
        return np.bincount(np.concatenate(self.members), minlength=self.G.shape[2])

    @property
    def conditions(self) -> FloatArray:
        """(6,) condition number of each leg's matrix, columns unscaled."""
        columns = [self.G[:, leg, members] for leg, members in enumerate(self.members)]
        return np.array([np.linalg.cond(matrix) for matrix in columns])


def integrate_errors(errors: FloatArray) -> FloatArray:
    """Return the largest integrated error, max dQint (..,) [mm + rad], of pose errors (.., n, 6)
    [m, rad], positions first.

    Equations (15) to (17) of the study hexapod-42: dQint = |(dx, dy, dz)| [mm] + |(dalpha, dbeta,
    dgamma)| [rad]. It adds millimeters and radians as they are, so it depends on these units.
    """
    lengths, angles = (np.linalg.norm(part, axis=-1) for part in (errors[..., :3], errors[..., 3:]))
    return np.asarray((lengths / MM + angles).max(axis=-1))


@dataclass(frozen=True, eq=False)
class PerLegEstimate:
    """Result of the identification leg by leg.

    robot : at the estimated values. estimate_history : (steps + 1, p) parameters after each step
        [SI]. conditions : (6,) condition number of each leg's matrix in the last step.
    integrated_errors : (steps + 1,) max dQint [mm + rad] at these parameters, see
        `integrate_errors`; the angle of a pose is that between its measured and computed rotation.
        Infinite where a pose is out of reach.
    is_converged : whether the rule ended the steps; always with a fixed number of steps.
    """

    robot: Mechanism
    estimate_history: FloatArray
    conditions: FloatArray
    integrated_errors: FloatArray
    is_converged: bool = True

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        robot="robot.name",
        parameters=lambda fit: fit.list_parameters(),
        **{name: name for name in ("conditions", "steps", "integrated_errors", "is_converged")},
    )

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.estimate_history) - 1

    def list_parameters(self) -> list[dict[str, Any]]:
        """Return name, unit, nominal value and estimate in the units of the robot file."""
        robot = self.robot
        shown = map(robot.list_shown, (robot.parameters.nominal, robot.values))
        return [
            {"name": p.name, "unit": robot.units[p.dimension], "nominal": old, "estimate": new}
            for p, old, new in zip(robot.parameters.entries, *shown, strict=True)
        ]


def identify_per_leg(
    robot: Mechanism,
    data: Measurements,
    steps: int = LEG_STEPS,
    epsilon: float = 0.0,
    stop: Stop = "dQint",
) -> PerLegEstimate:
    """Identify a hexapod leg by leg by full Gauss-Newton steps.

    robot : start values. data : full poses of one kind. steps : at most.
    epsilon : limit at which the steps end; 0 takes all steps. stop : what epsilon limits, see
        `Stop`.

    EstimationError
        The robot has not six actuators, the data are not full poses in known frames or too few, a
        parameter moves no leg or several, a pose is out of reach, or epsilon is below zero
        or infinite.
    """
    if not 0.0 <= epsilon < np.inf:
        raise EstimationError(
            f"epsilon is {epsilon}. Give a finite number above 0, or 0 for all steps"
        )
    _check_actuators(robot)
    observations = _select_full_poses(data)
    q = data.readings[observations.rows]
    values, history, conditions = robot.values.copy(), [robot.values.copy()], np.zeros(0)
    units, integrated, is_met = list_raw_units(robot.parameters.dimensions), [], False
    while True:
        machine = robot.with_values(values)
        solution = forward(machine, q)
        reached = solution.converged.all()
        evaluated = observations.kind.evaluate(solution.T[None], observations.measured[None])
        errors = np.roll(evaluated.residual[0], 3, axis=1)  # a kind has its angles first
        integrated.append(float(integrate_errors(errors)) if reached else np.inf)
        if stop == "dQint" and len(history) > 1:
            is_met = epsilon > 0.0 and integrated[-1] <= epsilon
        if is_met or len(history) > steps:
            break
        if not reached:
            lost = f"cannot reach {int((~solution.converged).sum())} of these poses"
            if len(history) == 1:
                raise EstimationError(f"{robot.name} {lost}. Check the readings")
            done = name_count(len(history) - 1, "step")
            raise EstimationError(
                f"identification leg by leg diverged: {robot.name}, corrected by {done}, {lost}; "
                "identify all parameters together, or begin closer to the true machine"
            )
        legs = LegForm.at(machine, solution)
        _check_members(robot, legs, len(q))
        twists = -np.linalg.solve(evaluated.jacobian[0], evaluated.residual[0, :, :, None])[:, :, 0]
        change = legs.fit(twists)
        values, conditions = values + change, legs.conditions
        history.append(values.copy())
        is_met = stop == "step" and np.abs(change / units).max() <= epsilon
    return PerLegEstimate(
        machine, np.stack(history), conditions, np.array(integrated), is_met or epsilon == 0.0
    )


def check_legs(robot: Mechanism) -> None:
    """Refuse a robot whose legs cannot be identified one by one, as it stands at home.

    Raises EstimationError: it has not six actuators, or a parameter moves several legs.
    """
    _check_actuators(robot)
    count = LegForm.at(robot, inverse(robot, robot.home[None])).count_legs()
    _refuse_coupled(robot, count, count > 1)  # one pose does not show that a parameter moves none


def _check_actuators(robot: Mechanism) -> None:
    if len(robot.actuators) != 6:
        facts = {"robot": robot.name, "actuators": len(robot.actuators)}
        raise EstimationError.of("fit.no-six-legs", **facts)


def _refuse_coupled(robot: Mechanism, count: IntArray, is_wrong: BoolArray) -> None:
    """Raise EstimationError where a free parameter moves a wrong number of legs, count (p,)."""
    places = np.flatnonzero(robot.parameters.free & is_wrong)
    if places.size:
        facts = {"parameter": robot.parameters.names[places[0]], "legs": int(count[places[0]])}
        raise EstimationError.of("fit.legs-coupled", robot=robot.name, **facts)


def _check_members(robot: Mechanism, legs: LegForm, poses: int) -> None:
    """Refuse parameters that do not move exactly one leg, or that these poses do not determine."""
    count = legs.count_legs()
    _refuse_coupled(robot, count, count != 1)
    most = max(len(members) for members in legs.members)
    if poses < most:
        raise EstimationError(
            f"{poses} poses are too few for the {most} parameters of a leg. Measure at least {most}"
        )
    for leg, members in enumerate(legs.members):
        columns = legs.G[:, leg, members]
        scaled = columns / np.linalg.norm(columns, axis=0)
        rank = int(are_nonzero(np.linalg.svd(scaled, compute_uv=False)).sum())
        if rank < len(members):
            raise EstimationError(
                f"these poses determine {rank} of the {len(members)} parameters of leg {leg + 1} "
                "(relative rank tolerance 1e-11). Use identify"
            )


def _select_full_poses(data: Measurements) -> Observations:
    """Return the rows of the one kind, which must measure all six coordinates of every pose."""
    kinds = [observations for observations in data.observations if len(observations)]
    if len(kinds) == 1:
        kept = kinds[0].take(kinds[0].weight > 0.0)
        unknown = kept.kind.unknown
        if unknown:
            raise EstimationError(
                f"identification leg by leg needs poses in known frames, but {unknown[0]} is "
                "unknown. Use identify"
            )
        if kept.present.shape[1] == 6 and kept.present.all() and len(kept):
            return kept
    raise EstimationError(
        "identification leg by leg needs full poses of one kind. Use identify for other data"
    )


Weights = Literal["printed", "distance", "single", "full"]
"""Rows as printed; divided by |d_1|, a distance from the plane; divided by their own sd; with their
full covariance.
"""
WEIGHTS: tuple[Weights, ...] = get_args(Weights)


@dataclass(frozen=True, eq=False)
class Layout:
    """Which points a machine is sent to.

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
    def levers(self) -> tuple[FloatArray, FloatArray]:
        """d_1 (g, 3) and d_i (g, k - 2, 3) [m] as commanded."""
        points = (self.state.T[0] @ self.robot.tool)[:, :3, 3]
        return compute_levers(points.reshape(self.groups, -1, 3))

    def hold_points(
        self, truth: FloatArray, noise: FloatArray | float = 0.0
    ) -> tuple[State, FloatArray]:
        """Return states (t, n) and readings (t, n, a) of true machines (t, p) [SI] whose end point
        is held where it was commanded to, but for noise (t, n, 3) [m].
        """
        target = np.repeat(self.flat[None], len(truth), axis=0)
        target[:, :, [self.robot.controlled.index(name) for name in POSITION]] += noise
        state = inverse_trials(self.robot, truth, target, self.state)
        return state, compute_readings(self.robot, truth, state)

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
        """(g, k - 2, k - 2) multiplies the rows of a group, S = sigma^2 1; made at the points as
        commanded.

        "printed": all rows alike, divided by the root mean square of their sds, so that a prior can
        be set against them.
        """
        d_1, d = self.layout.levers
        B = map_displacements(d_1, d)
        unit = np.broadcast_to(np.eye(d.shape[1]), (*d.shape[:2], d.shape[1]))
        if self.weights != "full":
            sd, length = self.sigma * np.linalg.norm(B, axis=2), np.linalg.norm(d_1, axis=1)
            each = {"printed": np.ones((1, 1)), "distance": length[:, None], "single": sd}
            size = each[self.weights]
            return unit / (size * np.sqrt(np.mean((sd / size) ** 2)))[..., None]
        covariance = self.sigma**2 * B @ np.swapaxes(B, 1, 2)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=np.float64)

    def values(self, deviation: FloatArray) -> FloatArray:
        """Return parameters (t, p) [m] at deviations z (t, p)."""
        return self.layout.robot.parameters.nominal + self.sd * deviation

    def whiten(self, deviation: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return rows (t, m, p + 1), [A | residual], at deviations (t, p), and which machines reach
        all points.
        """
        points, J, reached = self.layout.linearize_points(self.values(deviation), self.q)
        A, c = linearize_products(points, J * self.sd)
        rows = self.whitener @ np.concatenate([A, -c[..., None]], axis=-1)
        return rows.reshape(len(deviation), self.layout.equations, -1), reached

    def start(self, deviation: FloatArray) -> Start:
        """Return a start without nuisance parameters and poses."""
        t, p = deviation.shape
        return Start(deviation, np.zeros((t, 0)), np.zeros((t, 0, p)), np.zeros((t, 0)))

    def linearize(self, deviation: FloatArray, start: Start) -> Linearization:
        """Fold the rows at deviations (t, p)."""
        (t, p), (rows, reached) = deviation.shape, self.whiten(deviation)
        factor = fold(empty_factor(t, p), np.where(reached[:, None, None], rows, 0.0))
        cost = np.where(reached, np.sum(rows[:, :, -1] ** 2, axis=1), np.inf)
        equations = np.full(t, self.layout.equations)
        return Linearization(deviation, factor, cost, equations, start)

    def take(self, trials: IntArray) -> PaperRows:
        """Return the rows of some machines."""
        return replace(self, q=self.q[trials])


def identify_from_rows(problem: PaperRows, method: Method, relative: float = 1e-2) -> Descent:
    """Iterate (18) with the library's filters and step control, from the machine as designed.

    The last step changes the residuals by at most `relative` of their norm and is still taken, so
    that the next one would change them by its square or so.
    """
    begin = np.zeros((len(problem.q), problem.parameters))
    return descend(problem, begin, method, StepControl(relative=relative))


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
