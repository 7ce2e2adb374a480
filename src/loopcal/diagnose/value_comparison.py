# SPDX-License-Identifier: Apache-2.0
"""Compare the parameters of a fit with given values, and those of two calibrations, in the
directions that the data determine.

The values are true ones in a simulation, or a stored answer: published anchors, the numbers of a
firmware, an earlier result. Fits of one machine may differ by millimeters along unobservable
directions without any effect on the measurements. With the differences z in spreads and an
orthonormal basis N of these directions, the comparable part is to first order
e = (1 - N N') (z_estimate - z_given).

The joint test takes all comparable directions at once. Let e = Q y with orthonormal Q, and let Q' B
be the posterior spread of y, B B' the posterior covariance of the determined directions. With the
decomposition Q' B = U S V', chi-square = |S^-1 U' y|^2 has as many degrees of freedom as there are
directions. No matrix is inverted. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import EstimationError, MechanismError, suggest_names
from loopcal.estimate.free_parameters import Combination
from loopcal.estimate.posterior import Posterior
from loopcal.estimate.residual_test import SIGNIFICANCE
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.geometry import align_point_sets, log_so3
from loopcal.measure.instrument import make_random_stream
from loopcal.mechanism.inverse import inverse_trials
from loopcal.mechanism.kinematics import compute_readings, forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION, read_coordinates
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.decomposition import NULL_COMPONENT
from loopcal.numerics.statistics import compute_f_tail
from loopcal.results.deferred import DeferredFields, deferred, later
from loopcal.results.description import Field, fields, label_axes
from loopcal.results.result import TableResult
from loopcal.results.tables import Block
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

# Poses at which machines are compared; without a stated workspace their distance from home: a
# share of the robot's size, or radians.
POSES, NEAR = 20, 0.05
STEP = 1e-3  # step of the differences that make G [standard deviations]
SMALLEST = 1e-8  # singular values of G below this share of the largest count as zero
DRAWN_POSES = 5  # purpose of a random stream


def draw_readings(robot: Mechanism) -> FloatArray:
    """Return readings (1, POSES, a) [SI] of poses in the workspace, or else near home."""
    try:
        target = sample_workspace(robot, POSES, 0).coordinates
    except MechanismError:
        home = read_coordinates(robot.home[None], robot.controlled)[0]
        drawn = make_random_stream(0, 0, DRAWN_POSES).uniform(-1.0, 1.0, (POSES, len(home)))
        is_length = np.isin(robot.controlled, POSITION)
        target = home + drawn * np.where(is_length, NEAR * robot.size, NEAR)
    known = robot.values[None]
    return compute_readings(robot, known, inverse_trials(robot, known, target[None]))


def measure_second_order(posterior: Posterior, change: FloatArray) -> float:
    """Return the chi-square of the second-order effect of a change (p,) [SI] of the parameters."""
    robot, places = posterior.robot, posterior.places
    is_known = posterior.determined & np.isfinite(posterior.variance)
    sd = np.sqrt(posterior.variance[is_known])
    steps = STEP * posterior.unit[:, None] * posterior.directions[:, is_known] * sd  # (p, k)
    changes = np.vstack([np.zeros_like(change), change, -change, *steps.T, *-steps.T])
    values = np.repeat(robot.values[None], len(changes), axis=0)
    values[:, places] += changes
    T = forward_trials(robot, values, draw_readings(robot)).T
    T = T[:, np.isfinite(T).all(axis=(0, 2, 3))]
    if not T.shape[1]:
        return np.inf
    turned = np.matmul(T[:, :, :3, :3], T[0, :, :3, :3].swapaxes(-1, -2))
    twists = np.concatenate(
        [log_so3(turned) * robot.size, T[..., :3, 3] - T[0, :, :3, 3]], axis=-1
    ).reshape(len(changes), -1)
    k = len(sd)
    G = (twists[3 : 3 + k] - twists[3 + k :]).T / (2.0 * STEP)
    w = np.linalg.lstsq(G, 0.5 * (twists[1] + twists[2]), rcond=SMALLEST)[0]
    return float(w @ w)


TINY = 1e-99  # probability below which a sentence states no number
MOST_NAMED = 4  # parameters that name the direction of the largest difference
# Smallest part of a parameter in that direction, relative to the largest, for it to be named.
LEAST_PART = 0.3
# Relative difference up to which fixed values, and poses of two robot files, are equal: files
# state some seven digits.
EQUAL = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class ValueComparison(DeferredFields, TableResult):
    """A fit against given values of its parameters; arrays (k,) in the order of `names`.

    Attributes
    ----------
    names : of the compared parameters.
    raw : estimate minus given value [SI].
    error : the same without the unobservable directions [SI].
    tolerances : `error` in spreads [1].
    dropped : the unobservable directions with a part of these parameters, as combinations.
    compared : number of directions that the data determine.
    degrees : number of directions that are tested: those of them that were estimated.
    chi_square : of the differences, divided by their posterior uncertainty; NaN without intervals.
    p_value : probability of a larger chi-square (with estimated noise: of a larger F) if the given
        values are right; NaN where it cannot be decided.
    second_order : chi-square of what the linear test leaves out, see `measure_second_order`; the
        test decides only where its answer does not depend on this: `is_linear`.
    noise : what the uncertainty is based on: "given", "estimated", or "widened" where the residuals
        exceed the stated noise.
    sigma : the largest difference in a single direction [posterior standard deviations].
    direction : names of the parameters that this direction mostly consists of.
    """

    names: tuple[str, ...]
    raw: FloatArray
    error: FloatArray
    tolerances: FloatArray
    dropped: tuple[Combination, ...]
    compared: int
    degrees: int
    chi_square: float
    p_value: float
    second_order: float = deferred()
    is_linear: bool = deferred()
    noise: str
    sigma: float
    direction: tuple[str, ...]

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("*", "rms", "agrees", finding="outcome"),
        Field("estimate_minus_given", "raw", "parameter", "SI"),
        Field("determined_part", "error", "parameter", "SI"),
        Field("determined_part_in_tolerances", "tolerances", "parameter", "tolerance"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="names")
    CAPTION: ClassVar[str] = "Estimate minus given value"

    def page(self) -> list[Block]:
        """Return the outcome of the test and the differences."""
        return [str(self.outcome), self.main_table()]

    @property
    def rms(self) -> float:
        """Root mean square of the error [spreads] over compared directions; NaN without any."""
        if not self.compared:
            return float("nan")
        return float(np.sqrt(np.sum(self.tolerances**2) / self.compared))

    @property
    def agrees(self) -> bool | None:
        """Whether the values agree with the estimate; None where it cannot be decided."""
        return self.p_value >= SIGNIFICANCE if self.is_linear else None

    @property
    def finding(self) -> Finding:
        """The compared directions, and those that the data do not determine."""
        return report_finding(
            "identifiability.compared-with-truth",
            parameters=len(self.names),
            compared=self.compared,
            excluded=self._excluded,
        )

    @property
    def outcome(self) -> Finding:
        """The outcome of the joint test in one sentence."""
        if self.agrees is None:
            has_test = not np.isnan(self.p_value)
            code = "comparison.not-linear" if has_test else "comparison.undecided"
        else:
            code = "comparison.agrees" if self.agrees else "comparison.differs"
        return report_finding(
            code,
            parameters=len(self.names),
            chi_square=self.chi_square,
            degrees=self.degrees,
            p_value=self.p_value,
            tiny=self.p_value < TINY,
            noise=self.noise,
            sigma=self.sigma,
            second_order=self.second_order,
            direction=self.direction,
            excluded=self._excluded,
        )

    @property
    def _excluded(self) -> tuple[dict[str, object], ...]:
        return tuple(dict(combination.finding.data) for combination in self.dropped)


def compare_with_truth(fit: Identification, truth: ArrayLike) -> ValueComparison:
    """Compare the parameters of a fit with true ones in the directions that its data determine.

    Parameters
    ----------
    truth : (parameters of the robot,) or (free parameters,) [SI], in the order of the table.

    Raises
    ------
    EstimationError : the number of true values is different, or one of them is not finite.
    """
    true = np.asarray(truth, dtype=np.float64)
    p, total = len(fit.names), len(fit.robot.parameters)
    if true.shape not in ((p,), (total,)) or not np.isfinite(true).all():
        problem = "" if np.isfinite(true).all() else " and numbers that are not finite"
        raise EstimationError(
            f"the truth has shape {true.shape}{problem}. Give {total} values for all parameters of "
            f"{fit.robot.name!r}, or {p} for the free ones"
        )
    true = true[fit.free_parameters.places] if len(true) == total else true
    return _compare(fit, np.arange(p), true)


def compare_with_values(
    fit: Identification, values: Mapping[str, float] | Mechanism
) -> ValueComparison:
    """Compare a fit with a stored answer: published values, or those of a firmware.

    Parameters
    ----------
    values : of parameters by name [SI], all of them or some (the others are free to differ); or a
        robot of the same structure, whose values are compared. Parameters that the fit keeps fixed
        must have the same value in both.

    Raises
    ------
    EstimationError : an unknown name, a value that is not finite, no parameter that was estimated,
        another value of a fixed parameter, or a robot with other dimensions: the values belong to
        another geometry, or to another frame.

    Examples
    --------
    >>> import loopcal as lc
    >>> robot = lc.load_robot("examples/delta-printer/printer.yaml")
    >>> data = lc.load_measurements("examples/delta-printer/heights.csv", robot)
    >>> fit = lc.identify(robot, data, lc.LeastSquares())
    >>> bool(lc.compare_with_values(fit, {"radius": 0.105}).agrees)
    False
    >>> bool(lc.compare_with_values(fit, {"radius": 0.10569}).agrees)
    True
    """
    table = fit.robot.parameters
    if isinstance(values, Mechanism):
        refuse_other_dimensions(fit.robot, values)
        values = dict(zip(table.names, map(float, values.values), strict=True))
    for name, value in values.items():
        if name not in table.names:
            hint = suggest_names(str(name), table.names)
            raise EstimationError(f"{name!r} is not a parameter of {fit.robot.name!r}{hint}")
        if not np.isfinite(value):
            raise EstimationError(f"the value of {name!r} is {value}. Give a finite number")
        if name not in fit.names:
            place = table.index(name)
            kept, dimension = float(fit.robot.values[place]), table.dimensions[place]
            size = fit.robot.size if dimension is Dimension.LENGTH else 1.0
            if abs(value - kept) > EQUAL * size:
                given = fit.robot.to_quantity(float(value), dimension)
                data = {"name": name, "kept": fit.robot.to_quantity(kept, dimension)}
                raise EstimationError.of("comparison.fixed-differs", **data, given=given)
    indices = [i for i, name in enumerate(fit.names) if name in values]
    if not indices:
        raise EstimationError(
            f"no value belongs to an estimated parameter of {fit.robot.name!r}. Give some of "
            f"{', '.join(fit.names)}"
        )
    return _compare(fit, np.array(indices), np.array([values[fit.names[i]] for i in indices]))


def refuse_other_dimensions(
    robot: Mechanism, stored: Mechanism, names: tuple[str, str] | None = None
) -> None:
    """Refuse a machine that has other poses with the same values of all parameters: those of the
    robot or, where it reaches no pose with them, the stored ones.

    names : of both in messages; default: those of the robots.
    """
    called, given = names or (robot.name, stored.name)
    if stored.parameters.names != robot.parameters.names:
        raise EstimationError(
            f"{stored.name!r} does not have the parameters of {robot.name!r}. Give a robot file of "
            "equal family and structure, or only the values to compare"
        )
    for machine in (robot, stored):
        known, q = machine.values[None], draw_readings(machine)
        states = [forward_trials(compared, known, q) for compared in (robot, stored)]
        is_reached = np.all([s.status[0] == Status.CONVERGED for s in states], axis=0)
        if is_reached.any():
            break
    else:
        code = "comparison.nothing-reached"
        raise EstimationError.of(code, stored=given, robot=called)
    mine, theirs = (state.T[0][is_reached] for state in states)
    apart = np.linalg.norm(mine[:, :3, 3] - theirs[:, :3, 3], axis=1).max()
    if apart <= EQUAL * robot.size:
        return
    own = forward_trials(stored, stored.values[None], q).T[0][is_reached]
    rotation = align_point_sets(own[:, :3, 3], mine[:, :3, 3])[:3, :3]
    raise EstimationError.of(
        "comparison.other-dimensions",
        stored=given,
        robot=called,
        apart=robot.to_quantity(float(apart), Dimension.LENGTH),
        rotation=float(np.rad2deg(np.linalg.norm(log_so3(rotation)))),
    )


def _compare(fit: Identification, indices: IntArray, given: FloatArray) -> ValueComparison:
    """Compare the free parameters at `indices` (k,) with given values (k,) [SI]."""
    posterior, tolerance = fit.posterior, fit.tolerance[indices]
    raw = fit.estimate[indices] - given
    directions = (posterior.unit[indices] / tolerance)[:, None] * posterior.directions[indices]
    comparable = _find_complement(directions[:, ~posterior.determined])
    z = comparable @ (comparable.T @ (raw / tolerance))
    # a direction that a truncation leaves out is determined, but not estimated
    is_open = ~posterior.determined | np.isinf(posterior.variance)
    tested = _find_complement(directions[:, is_open])
    y = tested.T @ (raw / tolerance)
    known = np.where(is_open, 0.0, posterior.variance)
    whitened, u, change = np.full(len(y), np.nan), np.eye(len(y)), None
    left = np.inf
    if np.isfinite(known).all() and len(y):
        scaled = directions * np.sqrt(known)
        u, s, wt = np.linalg.svd(tested.T @ scaled, full_matrices=False)
        whitened = (u.T @ y) / s
        # the most probable change of all parameters with this difference of the compared ones
        change = posterior.directions @ (np.sqrt(known) * (wt.T @ whitened))
        whitening = np.zeros((len(y), len(posterior.unit)))
        whitening[:, indices] = ((u / s).T @ tested.T) / tolerance
        left = float(posterior.count_degrees(whitening))
    chi_square = float(np.sum(whitened**2))
    names = tuple(fit.names[i] for i in indices)
    sigma, direction = float("nan"), ()
    if np.isfinite(whitened).all() and len(whitened):  # the parameters of the largest difference
        worst = int(np.argmax(np.abs(whitened)))
        part = np.abs((tested @ u)[:, worst])
        order = [i for i in np.argsort(-part).tolist() if part[i] > LEAST_PART * part.max()]
        sigma = float(abs(whitened[worst]))
        direction = tuple(names[i] for i in order[:MOST_NAMED])
    is_cut = comparable.shape[1] < len(names)

    def compute_tail(root: float) -> float:
        if not (len(y) and np.isfinite(root)):
            return float("nan")
        return float(compute_f_tail(len(y), left, max(root, 0.0) ** 2 / len(y)))

    @cache
    def measure_bend() -> float:
        if change is None:
            return np.nan
        return measure_second_order(posterior, posterior.unit * change)

    def decide_linearity() -> bool:
        step = np.array([-1.0, 1.0]) * np.sqrt(measure_bend())
        bounds = map(compute_tail, np.sqrt(chi_square) + step)
        return len({bound >= SIGNIFICANCE for bound in bounds}) == 1 and p_value >= 0.0

    p_value = compute_tail(np.sqrt(chi_square))
    return ValueComparison(
        names=names,
        raw=raw,
        error=z * tolerance,
        tolerances=z,
        dropped=tuple(c for c in fit.unidentifiable if is_cut and set(names) & set(c.names)),
        compared=comparable.shape[1],
        degrees=len(y),
        chi_square=chi_square,
        p_value=p_value,
        second_order=later(measure_bend),
        is_linear=later(decide_linearity),
        noise="widened" if fit.residual_test.exceeds_sigma else fit.residual_test.noise,
        sigma=sigma,
        direction=direction,
    )


def _find_complement(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis (k, d) of the vectors that are orthogonal to columns (k, c)."""
    u, s, _ = np.linalg.svd(columns)
    return u[:, int((s > NULL_COMPONENT).sum()) :]
