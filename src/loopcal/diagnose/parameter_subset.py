# SPDX-License-Identifier: Apache-2.0
"""Choose a minimal set of parameters that carries all information of measurements.

With a basis N (p, d) of the null space, in tolerances, fixing d parameters loses nothing if their
rows N_d are nonsingular. Then B = N N_d^-1 has the identity in those rows, and to first order a
change z of a fixed parameter is the change -B z of the kept ones. The fixed parameters are chosen
by elimination with pivoting on N', each column multiplied by a weight: those with the largest
uncertainty in their tolerance, and those that nobody sets or measures, go first. See
docs/theory/observability.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from loopcal.diagnose.identifiable_parameters import Identifiability
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters, free_only
from loopcal.estimate.null_space import NEGLIGIBLE, choose_pivots, sparsify_basis
from loopcal.findings import Finding, report_finding
from loopcal.findings.catalog.phrases import effect
from loopcal.measure.array_checks import check_type
from loopcal.mechanism.assembly import LinearMap
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import NULL_COMPONENT
from loopcal.results.description import Field, fields
from loopcal.results.result import Result
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

# Weights of parameters that a controller can set (those of a transmission), and of dimensions
# that are not zero: they are kept against others of as much as ten and three times their share.
SETTABLE, NONZERO = 0.1, 0.3


@dataclass(frozen=True, eq=False)
class MergedParameter:
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

    def __str__(self) -> str:
        return str(self.finding)


@dataclass(frozen=True, eq=False)
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

    def __repr__(self) -> str:
        return f"<IdentifiableSubset: {len(self.kept)} kept, {len(self.dropped)} fixed>"

    def __str__(self) -> str:
        return "\n".join(str(finding) for finding in self.findings)


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
    check_type(
        identifiability, Identifiability, "identifiability", "as from identifiability(robot, data)"
    )
    free, null = identifiability.free_parameters, identifiability.null_space()
    # of equal parameters the last one in the file is fixed
    places = choose_pivots((null * _weights(free)[:, None]).T, first=False)
    kept = np.setdiff1d(np.arange(len(free)), places)
    B = null @ np.linalg.inv(null[places]) if len(places) else null
    dropped = tuple(_merge(free, int(place), B[:, i], kept) for i, place in enumerate(places))
    s = np.linalg.svd(identifiability.factor[:, kept], compute_uv=False)
    names = tuple(free.names[i] for i in kept)
    condition = float(s[0] / s[-1]) if len(s) else 1.0
    return IdentifiableSubset(names, dropped, condition, free_only(free.robot, names))


def _weights(free: FreeParameters) -> FloatArray:
    """Return the weight (p,) with which each parameter is a candidate to be fixed."""
    settable: set[str] = set()
    for link in free.robot.assembly.maps:
        addresses = (link.address,) if isinstance(link, LinearMap) else link.outputs
        if any(address.element == "transmission" for address in addresses):
            settable.update((link.parameter,) if isinstance(link, LinearMap) else link.inputs)
    # nominal values are computed: what is far below its tolerance is zero
    is_zero = np.abs([p.nominal for p in free.parameters]) <= NEGLIGIBLE * free.tolerance
    is_settable = np.array([p.name in settable for p in free.parameters], dtype=bool)
    return np.where(is_settable, SETTABLE, np.where(is_zero, 1.0, NONZERO))


def _merge(
    free: FreeParameters, place: int, direction: FloatArray, kept: IntArray
) -> MergedParameter:
    """Return the replacement of a parameter, whose null direction (p,) is one at its place."""
    factor, symbols = free.display()
    unit = free.tolerance / factor  # tolerances in the units of the robot's file
    chosen = kept[np.abs(direction[kept]) > NEGLIGIBLE]
    changes = -direction[chosen] * unit[chosen] / unit[place]
    names = tuple(free.names[i] for i in chosen)
    units = tuple(symbols[i] for i in chosen)
    return MergedParameter(free.names[place], symbols[place], names, changes, units)


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

    def to_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return {
            "length": self.length,
            "angle": self.angle,
            "determined": self.determined,
            "undetermined": self.undetermined,
            "nearby": dict(zip(map(str, NEIGHBORS), self.nearby, strict=True)),
            "parameters": [
                {"name": name, "sd": float(sd) if np.isfinite(sd) else None, "useful": bool(ok)}
                for name, sd, ok in zip(
                    self.free_parameters.names, self.sd, self.is_useful, strict=True
                )
            ],
            "findings": self.findings,
        }


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
            raise EstimationError(f"useful {name} is {value}; give a finite number above 0")
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
