# SPDX-License-Identifier: Apache-2.0
"""Determine what measurements identify, before or without a fit: rank, condition, null space; and
suggest further measurements that determine what they leave open.

Singular values are those of whitened rows in units of tolerance. Every kind of measurement is
tested: with a basis B (d, p) of the unidentifiable combinations, in spreads, and the triangular
factor X of the rows of a further instrument (its nuisance parameters eliminated), the null space of
X B' stays open. A combination is determined when no direction of that null space has a part in it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from loopcal.diagnose.error_causes import report_picture_scale
from loopcal.diagnose.gauge_freedoms import interpret_combinations, probe_readings
from loopcal.errors import DataError, EstimationError, MechanismError
from loopcal.estimate import information
from loopcal.estimate.determinable_setup import fix_undetermined_setup
from loopcal.estimate.free_parameters import (
    NEGLIGIBLE,
    Combination,
    FreeParameters,
    choose_pivots,
    describe_direction,
    describe_null_space,
    free_only,
    select_free_parameters,
    sparsify_basis,
)
from loopcal.estimate.pose_estimate import find_unclosed_poses, refuse_unreached
from loopcal.estimate.posterior import Posterior, compute_posterior
from loopcal.estimate.prior_inflation import restate
from loopcal.findings import Finding, report_finding
from loopcal.findings.catalog.phrases import effect
from loopcal.findings.wording import list_names, round_to_digits
from loopcal.measure.data_checks import check_actuators
from loopcal.measure.instrument import SIGMA, Gaussian, Instrument, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.joints import Closure, JointSensor
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.poses import Component
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import simulate
from loopcal.mechanism.assembly import LinearMap
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
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

# Units of the singular values; every index depends on them.
SCALING = "rows divided by sigma, columns multiplied by prior sd"

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
    # standard deviation with the spreads as a prior, over the spread: 1 where nothing is
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
    """What measurements determine, in units of sigma (rows) and expected spread (columns).

    Attributes
    ----------
    free_parameters : the free parameters.
    factor : (p, p) triangular factor of the rows. decomposition : of that factor (one trial).
    unidentifiable : combinations of parameters that change no measured value.
    weak : the weakest directions known no better than the spreads, weakest first.
    indices : observability O1 to O5. parameters : the result for each parameter.
    scale : what the lengths follow from, where only pictures of a board show any.
    """

    free_parameters: FreeParameters
    factor: FloatArray
    decomposition: Decomposition
    unidentifiable: tuple[Combination, ...]
    weak: tuple[Combination, ...]
    indices: Observability
    parameters: tuple[ParameterIdentifiability, ...]
    scale: tuple[Finding, ...] = ()

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("n_parameters", "n_equations", "rank", "condition", "gap", "singular_values"),
        *fields("tolerance", "improved", "unidentifiable", "weak", "indices", "parameters"),
        *fields("findings", scaling=lambda _: SCALING),
        Field("determined", "parameters.state", "parameter"),
        Field("sd_over_tolerance", "parameters.left", "parameter", "1"),
        Field("singular_value", "singular_values", "direction", "sigma per prior sd"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="free_parameters.names")

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
        return (*self.scale, *findings, *self.free_parameters.findings())

    @property
    def posterior(self) -> Posterior:
        """What is known of the parameters with the spreads as a prior."""
        free, d = self.free_parameters, self.decomposition
        if free.correlation is not None:
            d = restate(d, free.correlation)
        penalty = np.ones_like(d.singular_values)
        return compute_posterior(free.robot, free.places, free.tolerance, d, penalty)

    def null_space(self) -> FloatArray:
        """Return (p, d) orthonormal deviations in spreads that change no measured value."""
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
    robot : its values, free parameters and spreads.
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
        raise EstimationError(
            f"rank_tolerance is {rank_tolerance}, but must be above 0 and below 1"
        )
    if isinstance(data, Instrument):
        coordinates = sample_workspace(robot, poses, seed).coordinates
        data = simulate(robot, coordinates, data, seed=0, controller=robot)
    check_actuators(data, robot)
    data = fix_undetermined_setup(robot, data)
    free = select_free_parameters(robot)
    if not len(free):
        total = len(robot.parameters)
        raise EstimationError.of("fit.no-free-parameter", robot=robot.name, total=total)
    count = information.count_equations(robot, data)
    if not count and data.n_rows:
        raise EstimationError.of("fit.no-equation-left", poses=data.n_poses, unknowns=len(free))
    if not count:
        raise EstimationError.of("fit.no-measured-value")
    unclosed = find_unclosed_poses(robot, data)
    if unclosed.are_most:
        raise EstimationError(unclosed.report("fit.poses-open"))
    factor, reached = information.collect_information(free, data)
    refuse_unreached(data, np.flatnonzero(~reached))
    decomposition = decompose(factor, np.full(1, count), tolerance=rank_tolerance)
    rows = factor[0, :-1, :-1]
    s, V = decomposition.singular_values[0], decomposition.directions[0]
    rank, equations = int(decomposition.rank[0]), int(decomposition.rows[0])
    null, n_improved = decomposition.null_space(), int((s[:rank] > 1.0).sum())
    weakest = range(rank - 1, max(n_improved, rank - MOST_WEAK) - 1, -1)
    combinations = describe_null_space(free, null)
    # a parameter is determined where its unit vector has no part in the null space, not at all
    # where it lies in it, and otherwise together with those to which the projector ties it
    projector, remaining = null @ null.T, compute_remaining_sd(rows, free.correlation_root())
    parameters = []
    for i, name in enumerate(free.names):
        part = np.sqrt(projector[i, i])
        tied = np.flatnonzero(np.abs(projector[i]) > NULL_COMPONENT * max(part, NULL_COMPONENT))
        partners = tuple(free.names[j] for j in tied) if part > NULL_COMPONENT else ()
        parameters.append(ParameterIdentifiability(name, partners, float(remaining[i])))
    return Identifiability(
        free,
        rows,
        decomposition,
        unidentifiable=interpret_combinations(free, combinations),
        weak=tuple(describe_direction(free, V[:, i], float(s[i])) for i in weakest),
        indices=compute_observability(s, rank, equations),
        parameters=tuple(parameters),
        scale=tuple(report_picture_scale(robot, data)),
    )


def compute_remaining_sd(rows: FloatArray, root: FloatArray) -> FloatArray:
    """Return the standard deviations (p,) over spreads by rows (m, p) and the spreads as a
    prior, whose correlation is root root'.
    """
    _, s, vt = np.linalg.svd(rows @ root, full_matrices=False)
    return np.sqrt(((root @ vt.T) ** 2 / (1.0 + s**2)).sum(axis=1))


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


@dataclass(frozen=True)
class FurtherMeasurement:
    """A further measurement that determines a combination."""

    words: str  # what is measured, such as `psi`
    kind: str  # its kind
    # standard deviation of the first parameter of the combination over its spread, from the
    # data, the further measurement and the spreads together
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


def suggest_measurements(
    identifiability: Identifiability, sigma: dict[Dimension, float] | None = None
) -> tuple[MeasurementSuggestion, ...]:
    """Test every kind of measurement, one after the other, on the unidentifiable combinations.

    Parameters
    ----------
    sigma : standard deviations of the further instrument by dimension [SI].
    Returns one suggestion for each of `identifiability.unidentifiable`, in order.
    """
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
        scene = information.observe_poses(free, q, names)
    except MechanismError:  # no stated workspace
        scene = information.observe_poses(free, probe_readings(free.robot), names)
    for words, kind in _list_candidates(free.robot, joints):
        try:
            seen = _measure_at(scene, kind, SIGMA | (sigma or {}))
            X = information.instrument_factor(scene, seen)[0, :-1, :-1]
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
    # examples of Component and JointSensor belong to one robot; both are made for this one. What a
    # camera sees depends on where it stands
    known = [
        kind
        for kind in KINDS.values()
        if not (kind.label_count or issubclass(kind, (Closure, Component, JointSensor)))
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


def _measure_at(
    scene: information.ObservedPoses, kind: Kind, sigma: dict[Dimension, float]
) -> Measurements:
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


# A minimal set of parameters that carries all information of measurements, and what they determine
# to a useful accuracy.
#
# With a basis N (p, d) of the null space, in spreads, fixing d parameters loses nothing if their
# rows N_d are nonsingular. Then B = N N_d^-1 has the identity in those rows, and to first order a
# change z of a fixed parameter is the change -B z of the kept ones. The fixed parameters are chosen
# by elimination with pivoting on N', each column multiplied by a weight: those with the largest
# uncertainty in their tolerance, and those that nobody sets or measures, go first. See
# docs/theory/observability.md.

# Weights of parameters that a controller can set (those of a transmission), and of dimensions
# that are not zero: they are kept against others of as much as ten and three times their share.
SETTABLE, NONZERO = 0.1, 0.3


@dataclass(frozen=True, eq=False)
class MergedParameter(Result):
    """A parameter that is fixed because others have the same effect."""

    # name, unit: of the parameter
    name: str
    unit: str
    into: tuple[str, ...]  # names of the kept parameters that replace it
    changes: FloatArray  # (k,) of each for one `unit` of it, to first order
    units: tuple[str, ...]  # (k,) symbols

    FIELDS: ClassVar[tuple[Field, ...]] = fields("*", "finding")

    @property
    def finding(self) -> Finding:
        """The parameter and its replacement."""
        changes = tuple(float(change) for change in self.changes)
        return report_finding("model.merged-parameter", **{**vars(self), "changes": changes})

    def describe_effect(self, most: int = 8) -> str:
        """Return the effect in terms of at most `most` of the kept parameters."""
        return effect(vars(self), most)


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiableSubset(Result):
    """A set of free parameters that carries all information of the measurements.

    kept : names of the parameters that stay free. dropped : those to fix, and their replacements.
    condition : of the kept columns alone. robot : with the dropped parameters fixed at their
        nominal values.
    """

    kept: tuple[str, ...]
    dropped: tuple[MergedParameter, ...]
    condition: float
    robot: Mechanism

    FIELDS: ClassVar[tuple[Field, ...]] = fields("kept", "dropped", "condition")

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The numbers of parameters, then every fixed parameter."""
        kept, total = len(self.kept), len(self.kept) + len(self.dropped)
        if not self.dropped:
            return (report_finding("model.not-reducible", total=total),)
        summary = report_finding("model.reduced", kept=kept, total=total, condition=self.condition)
        return (summary, *(merged.finding for merged in self.dropped))


def choose_identifiable_subset(identifiability: Identifiability) -> IdentifiableSubset:
    """Choose a minimal set of parameters for what measurements determine.

    The result has as many free parameters as the rank, and does not depend on the machine.

    Parameters
    ----------
    identifiability : as from `identifiability(robot, data)`.
    Returns a subset whose `robot` has the chosen parameters free and the others fixed at their
    nominal values. Least squares can identify it.

    Raises
    ------
    DataError : a robot or measurements in place of an identifiability.

    Examples
    --------
    >>> import loopcal as lc
    >>> robot = lc.load_robot("five-bar")
    >>> camera = lc.Instrument((lc.Sensor(lc.Component(("x", "y")), lc.Gaussian([2e-5, 2e-5])),))
    >>> subset = lc.choose_identifiable_subset(lc.identifiability(robot, camera))
    >>> len(subset.kept), int(subset.robot.parameters.free.sum())
    (10, 10)
    """
    free, null = identifiability.free_parameters, identifiability.null_space()
    # of equal parameters the last one in the file is fixed
    places = choose_pivots((null * _weights(free)[:, None]).T, first=False)
    kept = np.setdiff1d(np.arange(len(free)), places)
    B = null @ np.linalg.inv(null[places]) if len(places) else null
    factor, symbols = free.display()
    unit = free.tolerance / factor  # tolerances in the units of the robot's file
    dropped = []
    for place, direction in zip(places, B.T, strict=True):  # one at its place
        into = kept[np.abs(direction[kept]) > NEGLIGIBLE]
        changes = -direction[into] * unit[into] / unit[place]
        replacing = tuple(free.names[i] for i in into)
        units = tuple(symbols[i] for i in into)
        merged = MergedParameter(free.names[place], symbols[place], replacing, changes, units)
        dropped.append(merged)
    s = np.linalg.svd(identifiability.factor[:, kept], compute_uv=False)
    names = tuple(free.names[i] for i in kept)
    condition = float(s[0] / s[-1]) if len(s) else 1.0
    return IdentifiableSubset(names, tuple(dropped), condition, free_only(free.robot, names))


def _weights(free: FreeParameters) -> FloatArray:
    """Return the weight (p,) with which each parameter is a candidate to be fixed."""
    settable: set[str] = set()
    for link in free.robot.assembly.maps:
        addresses = (link.address,) if isinstance(link, LinearMap) else link.outputs
        if any(address.element == "transmission" for address in addresses):
            settable.update((link.parameter,) if isinstance(link, LinearMap) else link.inputs)
    # nominal values are computed: what is far below its spread is zero
    is_zero = np.abs([p.nominal for p in free.parameters]) <= NEGLIGIBLE * free.tolerance
    is_settable = np.array([p.name in settable for p in free.parameters], dtype=bool)
    return np.where(is_settable, SETTABLE, np.where(is_zero, 1.0, NONZERO))


# Multiples of the accuracy for which the number of combinations is stated, too.
NEIGHBORS = (0.1, 10.0)
NEGLIGIBLE_GAIN = 1e-6  # part of a combination of length one that is rounding and left out


@dataclass(frozen=True, eq=False)
class AccurateCombination:
    """A combination c'y of length one of the parameters, in units of the useful accuracy."""

    names: tuple[str, ...]  # (k,) strongest first
    coefficients: FloatArray  # (k,) c of y = deviation / useful accuracy
    # standard deviation by the data alone, in units of the useful accuracy; infinite where the
    # data do not determine it
    sd: float

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        "names", "coefficients", sd=lambda known: known.sd if np.isfinite(known.sd) else None
    )


@dataclass(frozen=True, eq=False)
class UsefulAccuracy:
    """What data determine to a useful accuracy."""

    free_parameters: FreeParameters  # the free parameters
    # length, angle: the accuracy [m, rad]
    length: float
    angle: float
    # (p,) [SI] standard deviation of each parameter by the data alone; infinite where they do not
    # determine it
    sd: FloatArray
    is_useful: BoolArray  # (p,) parameters whose own standard deviation is at most the accuracy
    # determined, undetermined: combinations of length one that span what is known to the
    # accuracy, and what is not
    determined: tuple[AccurateCombination, ...]
    undetermined: tuple[AccurateCombination, ...]
    nearby: tuple[int, ...]  # number of determined combinations at `NEIGHBORS` times the accuracy

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        *("length", "angle", "determined", "undetermined"),
        nearby=lambda useful: dict(zip(map(str, NEIGHBORS), useful.nearby, strict=True)),
        parameters=lambda useful: useful.list_parameters(),
        findings="findings",
    )

    def list_parameters(self) -> list[dict[str, Any]]:
        """Return name, standard deviation and usefulness of each parameter."""
        rows = zip(self.free_parameters.names, self.sd, self.is_useful, strict=True)
        return [
            {"name": name, "sd": float(sd) if np.isfinite(sd) else None, "useful": bool(is_useful)}
            for name, sd, is_useful in rows
        ]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """How many combinations are known to the accuracy, and which parameters on their own."""
        robot = self.free_parameters.robot
        names = np.array(self.free_parameters.names)[: len(self.is_useful)]
        return (
            report_finding(
                "identifiability.useful",
                count=len(self.determined),
                parameters=len(self.sd),
                length=robot.to_quantity(self.length, Dimension.LENGTH),
                angle=robot.to_quantity(self.angle, Dimension.ANGLE),
                finer=self.nearby[0],
                coarser=self.nearby[1],
            ),
            report_finding(
                "identifiability.useful-parameters",
                names=tuple(names[self.is_useful].tolist()),
                others=tuple(names[~self.is_useful].tolist()),
            ),
        )


def judge_useful_accuracy(
    analysis: Identifiability, length: float, angle: float | None = None
) -> UsefulAccuracy:
    """Separate the combinations that the data of an analysis determine to an accuracy.

    length : accuracy of lengths [m], a standard deviation.
    angle : accuracy of angles [rad]; default: the length over the robot's size, by which an angle
        moves a point at that distance as far as the length.
    """
    free = analysis.free_parameters
    angle = length / free.robot.size if angle is None else angle
    for name, value in (("length", length), ("angle", angle)):
        if not 0.0 < value < np.inf:
            raise EstimationError(f"useful {name} is {value}. Give a finite number above 0")
    units = {Dimension.LENGTH: length, Dimension.ANGLE: angle}
    ratio = length / free.robot.size
    unit = np.array([units.get(parameter.dimension, ratio) for parameter in free.parameters])
    _, s, vt = np.linalg.svd(analysis.factor * (unit / free.tolerance))
    s = np.where(s > np.finfo(np.float64).eps * len(s) * s[0], s, 0.0)
    count = int((s >= 1.0).sum())
    components = _without_rounding(vt)
    sd = np.sqrt((_divide(components, s[:, None]) ** 2).sum(axis=0))
    return UsefulAccuracy(
        free_parameters=free,
        length=length,
        angle=angle,
        sd=sd * unit,
        is_useful=sd <= 1.0,
        determined=_name_combinations(free, vt[:count], s[:count]),
        undetermined=_name_combinations(free, vt[count:], s[count:]),
        nearby=tuple(int((s * factor >= 1.0).sum()) for factor in NEIGHBORS),
    )


def _name_combinations(
    free: FreeParameters, vt: FloatArray, s: FloatArray
) -> tuple[AccurateCombination, ...]:
    """Return a sparse basis of the span of directions vt (k, p), by names, best known first."""
    combinations = []
    for row in sparsify_basis(vt.T):
        c = row / np.linalg.norm(row)
        sd = float(np.linalg.norm(_divide(_without_rounding(vt @ c), s)))
        chosen = np.flatnonzero(np.abs(c) > NEGLIGIBLE_GAIN)
        order = chosen[np.argsort(-np.round(np.abs(c[chosen]), 9), kind="stable")]
        names = tuple(free.names[i] for i in order)
        combinations.append(AccurateCombination(names, c[order] * np.sign(c[order[0]]), sd))
    return tuple(sorted(combinations, key=lambda combination: combination.sd))


def _without_rounding(components: FloatArray) -> FloatArray:
    """Return components of directions, with zero for those that are rounding."""
    return np.where(np.abs(components) > NULL_COMPONENT, components, 0.0)


def _divide(components: FloatArray, s: FloatArray) -> FloatArray:
    """Return components / s; infinite where only s is zero, zero where the component is."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(components == 0.0, 0.0, components / s)
