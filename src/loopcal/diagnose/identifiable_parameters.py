# SPDX-License-Identifier: Apache-2.0
"""Determine what measurements identify, before or without a fit: rank, condition, null space; and
suggest further measurements that determine what they leave open.

Singular values are those of whitened rows in units of tolerance. Every kind of measurement is
tested: with a basis B (d, p) of the unidentifiable combinations, in tolerances, and the triangular
factor X of the rows of a further instrument (its nuisance parameters eliminated), the null space of
X B' stays open. A combination is determined when no direction of that null space has a part in it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from loopcal.diagnose.gauge_freedoms import interpret_combinations, probe_workspace
from loopcal.errors import DataError, EstimationError, MechanismError
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.information import (
    ObservedPoses,
    collect_information,
    count_equations,
    instrument_factor,
    observe_poses,
)
from loopcal.estimate.null_space import (
    Combination,
    describe_direction,
    describe_null_space,
    sparsify_basis,
)
from loopcal.estimate.pose_estimate import find_unclosed_poses
from loopcal.estimate.posterior import Posterior, compute_posterior
from loopcal.estimate.tolerance_components import compute_symmetric_root
from loopcal.findings import Finding, report_finding
from loopcal.findings.wording import list_names, round_to_digits
from loopcal.measure.array_checks import check_type
from loopcal.measure.data_checks import check_actuators
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.joints import Closure, JointSensor
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.poses import Component
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.decomposition import (
    NULL_COMPONENT,
    RANK_TOLERANCE,
    Decomposition,
    are_nonzero,
    decompose,
)
from loopcal.results.description import Field, fields, label_axes
from loopcal.results.result import DrawnResult, Result
from loopcal.typing import FloatArray
from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.results.tables import Block


# Units of the singular values; every index depends on them.
SCALING = "rows divided by sigma, columns multiplied by tolerance"

MEANING = {
    "o1": "(product of s)^(1/L) / sqrt(m): a small uncertainty ellipsoid",
    "o2": "smallest / largest: 1 / condition",
    "o3": "smallest: the worst direction",
    "o4": "smallest^2 / largest: noise amplification",
    "o5": "1 / sum(1/s): a small sum of semi-axes",
}


@dataclass(frozen=True)
class Observability:
    """The five indices over the L observable directions."""

    # o1, o2, o3, o4, o5: the larger the better
    o1: float
    o2: float
    o3: float
    o4: float
    o5: float
    directions: int  # L
    left_out: int  # number of null directions, which would make all five zero
    equations: int  # m
    scaling: str = SCALING  # of rows and columns

    def rows(self) -> list[tuple[str, float, str]]:
        """Return index, value and meaning, for a table."""
        return [(name.upper(), getattr(self, name), meaning) for name, meaning in MEANING.items()]

    def __str__(self) -> str:
        values = ", ".join(f"{name} {value:.3g}" for name, value, _ in self.rows())
        without = f", without {self.left_out} null directions" if self.left_out else ""
        counts = f"m = {self.equations}, L = {self.directions}{without}"
        return f"Observability: {values} ({self.scaling}; {counts})"


def compute_observability(singular_values: FloatArray, rank: int, equations: int) -> Observability:
    """Return the indices of the singular values of whitened rows in units of tolerance.

    singular_values : (p,), descending. rank : how many of them count. equations : number of rows.
    All indices are zero where the rank is zero.
    """
    s = singular_values[:rank]
    left_out = len(singular_values) - rank
    if rank == 0 or equations == 0:
        return Observability(0.0, 0.0, 0.0, 0.0, 0.0, 0, left_out, equations)
    return Observability(
        o1=float(np.exp(np.log(s).mean()) / np.sqrt(equations)),
        o2=float(s[-1] / s[0]),
        o3=float(s[-1]),
        o4=float(s[-1] ** 2 / s[0]),
        o5=float(1.0 / (1.0 / s).sum()),
        directions=rank,
        left_out=left_out,
        equations=equations,
    )


MOST_WEAK = 5  # number of weak directions that are listed, weakest first
AROUND = 3  # number of singular values listed before the cut
MOST_ROWS = 12  # number of parameters in the printed table; the others are counted
CLEAR_GAP = 1e3  # ratio of the singular values at the cut that makes the rank clear
# Multiples of the rank tolerance between which a clear rank does not change.
NEARBY_TOLERANCES = (1e-2, 1e2)


@dataclass(frozen=True)
class ParameterIdentifiability:
    """What the data determine of one parameter."""

    name: str  # of the parameter
    # parameters with which only a combination is determined; only itself where it has no effect;
    # empty where it is determined
    partners: tuple[str, ...]
    # standard deviation with the tolerances as a prior, over the tolerance: 1 where nothing is
    # learned
    left: float

    FIELDS: ClassVar[tuple[Field, ...]] = fields("*", "state")

    @property
    def state(self) -> str:
        """Return "determined", "together" or "not at all"."""
        if not self.partners:
            return "determined"
        return "not at all" if self.partners == (self.name,) else "together"

    @property
    def others(self) -> tuple[str, ...]:
        """The other parameters of its combinations."""
        return tuple(name for name in self.partners if name != self.name)


@dataclass(frozen=True, eq=False, repr=False)
class Identifiability(DrawnResult):
    """What measurements determine, in units of sigma (rows) and tolerance (columns).

    Attributes
    ----------
    free_parameters : the free parameters.
    factor : (p, p) triangular factor of the rows. decomposition : of that factor (one trial).
    unidentifiable : combinations of parameters that change no measured value.
    weak : the weakest directions known no better than the tolerances, weakest first.
    indices : observability O1 to O5. parameters : the result for each parameter.
    """

    free_parameters: FreeParameters
    factor: FloatArray
    decomposition: Decomposition
    unidentifiable: tuple[Combination, ...]
    weak: tuple[Combination, ...]
    indices: Observability
    parameters: tuple[ParameterIdentifiability, ...]

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("n_parameters", "n_equations", "rank", "condition", "gap", "singular_values"),
        *fields("tolerance", "improved", "unidentifiable", "weak", "indices", "parameters"),
        *fields("findings", scaling=lambda _: SCALING),
        Field("determined", "parameters.state", "parameter"),
        Field("sd_over_tolerance", "parameters.left", "parameter", "1"),
        Field("singular_value", "singular_values", "direction", "sigma per tolerance"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="free_parameters.names")

    def page(self) -> list[Block]:
        """Return the findings and the parameters."""
        return ["\n".join(map(str, self.findings)), self.main_table()]

    @property
    def n_parameters(self) -> int:
        """Number p of free parameters."""
        return len(self.free_parameters)

    @property
    def n_equations(self) -> int:
        """Number of equations."""
        return int(self.decomposition.rows[0])

    @property
    def rank(self) -> int:
        """Number of independent combinations that the data determine."""
        return int(self.decomposition.rank[0])

    @property
    def condition(self) -> float:
        """Largest over smallest singular value that counts."""
        return float(self.decomposition.condition[0])

    @property
    def gap(self) -> float:
        """Smallest singular value that counts over the largest that does not; infinite where none
        was cut.
        """
        return float(self.decomposition.gap[0])

    @property
    def singular_values(self) -> FloatArray:
        """(p,) descending."""
        return self.decomposition.singular_values[0]

    @property
    def tolerance(self) -> float:
        """Share of the largest singular value below which one counts as zero."""
        return self.decomposition.tolerance

    @property
    def improved(self) -> int:
        """Number of directions known better than their tolerance (singular value above 1)."""
        return int((self.singular_values[: self.rank] > 1.0).sum())

    def __repr__(self) -> str:
        name, rank = self.free_parameters.robot.name, f"rank {self.rank} of {self.n_parameters}"
        numbers = f"{self.n_equations} equations, condition {round_to_digits(self.condition)}"
        return f"<Identifiability of {name}: {rank}, {numbers}>"

    def __str__(self) -> str:
        lines = [str(finding) for finding in self.findings]
        shown = sorted(self.parameters, key=lambda p: (not p.partners, -round(p.left, 6)))
        width = max(len(p.name) for p in shown[:MOST_ROWS])
        lines += ["", f"{'parameter':<{width}}  sd / tolerance  determined"]
        for p in shown[:MOST_ROWS]:
            state = {"determined": "yes", "not at all": "no"}.get(p.state, "only in combination")
            lines.append(f"{p.name:<{width}}  {p.left:>14.2f}  {state}")
        if len(shown) > MOST_ROWS:
            lines.append(f"{len(shown) - MOST_ROWS} more parameters")
        return "\n".join([*lines, "", str(self.indices)])

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the data determine and what they leave open, without the indices."""
        p, rank, s = self.n_parameters, self.rank, self.singular_values
        findings = [
            report_finding(
                "identifiability.rank",
                rank=rank,
                parameters=p,
                equations=self.n_equations,
                tolerance=self.tolerance,
            ),
            report_finding(
                "identifiability.spectrum",
                condition=self.condition,
                largest=float(s[0]),
                smallest=float(s[max(rank - 1, 0)]),
                scaling=SCALING,
                tolerance=self.tolerance,
            ),
            report_finding("identifiability.improved", improved=self.improved, parameters=p),
        ]
        if self.unidentifiable:
            counted = tuple(f"{value:.2g}" for value in s[max(rank - AROUND, 0) : rank])
            cut = tuple(f"{value:.2g}" for value in s[rank:])
            findings.append(
                report_finding("identifiability.gap", counted=counted, cut=cut, gap=self.gap)
            )
        # singular values that continue through the cut make the rank depend on the tolerance
        tolerances = tuple(self.tolerance * factor for factor in NEARBY_TOLERANCES)
        ranks = tuple(int(are_nonzero(s, tolerance).sum()) for tolerance in tolerances)
        if ranks[0] != ranks[1] and self.gap < CLEAR_GAP:
            data = {"gap": self.gap, "ranks": ranks, "tolerances": tolerances}
            findings.append(report_finding("identifiability.arbitrary-cut", **data))
        findings += [combination.finding for combination in (*self.unidentifiable, *self.weak)]
        if (more := rank - self.improved - len(self.weak)) > 0:
            findings.append(report_finding("identifiability.more-weak-directions", count=more))
        return (*findings, *self.free_parameters.findings())

    @property
    def posterior(self) -> Posterior:
        """What is known of the parameters with the tolerances as a prior."""
        free, d = self.free_parameters, self.decomposition
        if free.correlation is not None:
            rows = np.zeros((1, len(free) + 1, len(free) + 1))
            rows[0, :-1, :-1] = self.factor
            root = compute_symmetric_root(free.correlation)
            d = decompose(rows, d.rows, tolerance=d.tolerance, root=root)
        penalty = np.ones_like(d.singular_values)
        return compute_posterior(free.robot, free.places, free.tolerance, d, penalty)

    def null_space(self) -> FloatArray:
        """Return (p, d) orthonormal deviations in tolerances that change no measured value."""
        return self.decomposition.null_space()


def identifiability(
    robot: Mechanism,
    data: Measurements | Instrument,
    rank_tolerance: float = RANK_TOLERANCE,
    poses: int = 40,
    seed: int = 1,
) -> Identifiability:
    """Determine which combinations of a robot's free parameters measurements identify.

    Parameters
    ----------
    robot : its values, free parameters and tolerances.
    data : measurements, or an instrument that measures `poses` positions drawn from the robot's
        workspace by `seed`. Measured values matter only by their presence, and by locating
        unknown frames, targets and surfaces, which are eliminated.
    rank_tolerance : relative to the largest singular value.

    Raises
    ------
    EstimationError
        There is no free parameter or no row, or a pose is out of reach.
    MechanismError
        Poses are to be drawn, but the robot states no workspace.
    """
    if not 0.0 < rank_tolerance < 1.0:
        raise EstimationError(f"rank_tolerance is {rank_tolerance}; it must be above 0 and below 1")
    if isinstance(data, Instrument):
        coordinates = sample_workspace(robot, poses, seed).coordinates
        data = simulate(robot, coordinates, data, seed=0, controller=robot)
    check_actuators(data, robot)
    free = select_free_parameters(robot)
    if not len(free):
        total = len(robot.parameters)
        finding = report_finding("fit.no-free-parameter", robot=robot.name, total=total)
        raise EstimationError(finding)
    count = count_equations(robot, data)
    if not count and data.n_rows:
        raise EstimationError(
            report_finding("fit.no-equation-left", poses=data.n_poses, unknowns=len(free))
        )
    if not count:
        raise EstimationError(report_finding("fit.no-measured-value"))
    unclosed = find_unclosed_poses(robot, data)
    if unclosed.are_most:
        raise EstimationError(unclosed.report("fit.poses-open"))
    factor, reached = collect_information(free, data)
    if not reached.all():
        names = tuple(data.labels[i] for i in np.flatnonzero(~reached))
        raise EstimationError(
            report_finding(
                "fit.poses-out-of-reach", count=len(names), total=data.n_poses, poses=names
            )
        )
    decomposition = decompose(factor, np.full(1, count), tolerance=rank_tolerance)
    rows = factor[0, :-1, :-1]
    s, V = decomposition.singular_values[0], decomposition.directions[0]
    rank, equations = int(decomposition.rank[0]), int(decomposition.rows[0])
    null, n_improved = decomposition.null_space(), int((s[:rank] > 1.0).sum())
    weakest = range(rank - 1, max(n_improved, rank - MOST_WEAK) - 1, -1)
    combinations = describe_null_space(free, null)
    return Identifiability(
        free,
        rows,
        decomposition,
        unidentifiable=interpret_combinations(free, combinations),
        weak=tuple(describe_direction(free, V[:, i], float(s[i])) for i in weakest),
        indices=compute_observability(s, rank, equations),
        parameters=_judge_parameters(
            free, null, compute_remaining_sd(rows, free.correlation_root())
        ),
    )


def compute_remaining_sd(rows: FloatArray, root: FloatArray) -> FloatArray:
    """Return the standard deviations (p,) over tolerances by rows (m, p) and the tolerances as a
    prior, whose correlation is root root'.
    """
    _, s, vt = np.linalg.svd(rows @ root, full_matrices=False)
    return np.sqrt(((root @ vt.T) ** 2 / (1.0 + s**2)).sum(axis=1))


def _judge_parameters(
    free: FreeParameters, null: FloatArray, remaining: FloatArray
) -> tuple[ParameterIdentifiability, ...]:
    """Judge each parameter by the projector onto the null space (p, d).

    A parameter is determined where its unit vector has no part in the null space, not at all where
    it lies in it, and otherwise together with those to which the projector ties it.
    """
    projector = null @ null.T
    parameters = []
    for i, name in enumerate(free.names):
        part = np.sqrt(projector[i, i])
        tied = np.flatnonzero(np.abs(projector[i]) > NULL_COMPONENT * max(part, NULL_COMPONENT))
        partners = tuple(free.names[j] for j in tied) if part > NULL_COMPONENT else ()
        parameters.append(ParameterIdentifiability(name, partners, float(remaining[i])))
    return tuple(parameters)


POSES = 24  # number of poses of a further measurement
# Singular value above which an instrument observes a direction, relative to the largest of its
# rows and of those that exist.
OBSERVED = 1e-8
# A further measurement must reduce the remaining uncertainty of the leading parameter below this
# share.
IMPROVEMENT = 0.9
MOST_MISSING = 3  # largest number of open combinations that a refusal lists

TILT = "tilt-torsion"
# Single coordinates, the simplest further measurements.
SINGLE = (("x",), ("y",), ("z",), ("psi",), ("theta",), ("phi", "theta"))
# Standard deviations [SI] of a further instrument where none are stated.
SIGMA = {Dimension.LENGTH: 1e-5, Dimension.ANGLE: 5e-5, Dimension.RATIO: 5e-5}


@dataclass(frozen=True)
class FurtherMeasurement:
    """A further measurement that determines a combination."""

    words: str  # what is measured, such as `psi`
    kind: str  # its kind
    # standard deviation of the first parameter of the combination over its tolerance, from the
    # data, the further measurement and the tolerances together
    left: float


@dataclass(frozen=True, eq=False)
class MeasurementSuggestion(Result):
    """An unidentifiable combination, and the measurements that determine it, simplest first."""

    combination: Combination
    measurements: tuple[FurtherMeasurement, ...]

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        names="combination.names", cures="measurements", finding="finding"
    )

    @property
    def finding(self) -> Finding:
        """The suggestion: a further measurement, or fixing a parameter."""
        names = self.combination.names
        if not self.measurements:
            return report_finding("identifiability.fix-one", names=names)
        measurements = tuple(dict(vars(measurement)) for measurement in self.measurements)
        return report_finding(
            "identifiability.measure-also", names=names, measurements=measurements, poses=POSES
        )

    def __str__(self) -> str:
        return str(self.finding)


def suggest_measurements(
    identifiability: Identifiability, sigma: dict[Dimension, float] | None = None
) -> tuple[MeasurementSuggestion, ...]:
    """Test every kind of measurement, one after the other, on the unidentifiable combinations.

    Parameters
    ----------
    sigma : standard deviations of the further instrument by dimension [SI].
    Returns one suggestion for each of `identifiability.unidentifiable`, in order.
    """
    check_type(
        identifiability, Identifiability, "identifiability", "as from identifiability(robot, data)"
    )
    if sigma is not None:
        check_type(sigma, dict, "sigma", "such as {Dimension.LENGTH: 1e-5} [SI]")
    combinations, factor = identifiability.unidentifiable, identifiability.factor
    if not combinations:
        return ()
    free = identifiability.free_parameters
    B = sparsify_basis(identifiability.null_space())
    B = B / np.linalg.norm(B, axis=1, keepdims=True)
    leading = [free.names.index(c.names[0]) for c in combinations]
    measurements: list[list[FurtherMeasurement]] = [[] for _ in leading]
    # an observed direction must exceed the rounding of the existing rows, too
    root, floor = free.correlation_root(), float(np.linalg.norm(factor, ord=2))
    present = compute_remaining_sd(factor, root)
    joints = [
        (f"{limb.name}.{joint.name}", "length" if joint.kind == "P" else "angle")
        for limb, joint in free.robot.assembly.passive_joints
    ]
    names = [name for name, _ in joints]
    try:
        q = sample_workspace(free.robot, POSES, seed=0).solution.q
        scene = observe_poses(free, q, names)
    except MechanismError:  # no stated workspace
        scene = probe_workspace(free, names)
    for words, kind in _list_candidates(free.robot, joints):
        try:
            seen = _measure_at(scene, kind, SIGMA | (sigma or {}))
            X = instrument_factor(scene, seen)[0, :-1, :-1]
        except DataError:
            continue  # this kind has nothing to measure on this robot
        # combinations that the rows X separate from all others
        _, s, vt = np.linalg.svd(X @ B.T)
        largest = max(float(np.linalg.norm(X, ord=2)), floor)
        undetermined = vt[s <= OBSERVED * largest] if largest > 0.0 else vt
        determined = np.asarray(np.linalg.norm(undetermined, axis=0) <= np.sqrt(OBSERVED))
        if determined.any():
            left = compute_remaining_sd(np.concatenate([factor, X]), root)
            better = determined & (left[leading] < IMPROVEMENT * present[leading])
            for i in np.flatnonzero(better):
                measurement = FurtherMeasurement(words, kind.name, float(left[leading[i]]))
                measurements[i].append(measurement)
    pairs = zip(combinations, measurements, strict=True)
    return tuple(MeasurementSuggestion(combination, tuple(chosen)) for combination, chosen in pairs)


def describe_missing_equations(robot: Mechanism, data: Measurements) -> Finding | None:
    """Return what too few equations leave open and what determines it, for a refusal; None where
    more than a few combinations are open.
    """
    if int(robot.parameters.free.sum()) - data.n_rows > MOST_MISSING:
        return None
    suggestions = suggest_measurements(identifiability(robot, data))
    if not 0 < len(suggestions) <= MOST_MISSING:
        return None
    common = [
        words
        for words in (measurement.words for measurement in suggestions[0].measurements)
        if all(words in {m.words for m in other.measurements} for other in suggestions)
    ]
    return report_finding(
        "identifiability.missing-equations",
        combinations=tuple(dict(s.combination.finding.data) for s in suggestions),
        measurement=common[0] if common else None,
    )


def _list_candidates(robot: Mechanism, joints: list[tuple[str, str]]) -> Iterator[tuple[str, Kind]]:
    """Yield measurements with their descriptions, the simplest first: without a frame, single
    coordinates, other kinds, joints.
    """
    # examples of Component and JointSensor belong to one robot; both are made for this one
    known = [
        kind for kind in KINDS.values() if not issubclass(kind, (Closure, Component, JointSensor))
    ]
    yield from _list_examples([kind for kind in known if kind.poses_per_row > 1])
    for names in SINGLE:
        yield " and ".join(names), Component(names, None if names[0] in "xyz" else TILT)
    yield from _list_examples([kind for kind in known if kind.poses_per_row == 1])
    for name, measures in joints:
        yield f"the joint {name}", JointSensor(joints=(name,), measures=measures)


def _list_examples(kinds: Iterable[type[Kind]]) -> Iterator[tuple[str, Kind]]:
    """Yield examples of kinds whose descriptions differ."""
    listed: set[str] = set()
    for kind in (example for cls in kinds for example in cls.examples()):
        targets, unknown = getattr(kind, "targets", ()), list(kind.setup_items)
        words = kind.description
        if unknown or not words:
            words = f"the {kind.name}" + (f" of {len(targets)} targets" if len(targets) > 1 else "")
        if unknown:
            words = f"{words} ({list_names(unknown)} unknown)"
        if words not in listed:
            listed.add(words)
            yield words, kind


def _measure_at(scene: ObservedPoses, kind: Kind, sigma: dict[Dimension, float]) -> Measurements:
    """Return noiseless measurements of a kind at the scene."""
    robot = scene.free.robot
    noise = Gaussian(np.array([sigma[column.dimension] for column in kind.noise_columns]))
    sensor = Sensor(kind.with_tool(robot.tool), noise).assign_rows(len(scene.readings))
    rows, mounted = sensor.rows, sensor.kind
    assert rows is not None
    sensed = kind.stack_joints(scene.joints, rows)
    zero = np.zeros((1, len(rows), len(kind.noise_columns)))
    measured = mounted.measure(scene.T[:, rows], zero, None, sensed)[0]
    observations = Observations.from_sigma(
        mounted, rows, measured, noise.sigma, sensor.session, sensor.group
    )
    return Measurements(robot.name, scene.readings, (observations,))
