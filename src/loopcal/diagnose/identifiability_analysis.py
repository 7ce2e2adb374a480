# SPDX-License-Identifier: Apache-2.0
"""What can be known from these data, before or without fitting: rank, condition and the
combinations that stay open.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.diagnose.meaning import with_meaning
from loopcal.diagnose.observability import SCALING, Observability, compute_observability
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.inference.null_space import (
    Combination,
    describe_direction,
    describe_null_space,
    listed,
    sparsify_basis,
)
from loopcal.estimate.information import collect_information, count_equations
from loopcal.measure import Instrument, Measurements, check_actuators, simulate
from loopcal.mechanism import Mechanism, sample_workspace
from loopcal.numerics.decomposition import NULL_COMPONENT, RANK_TOLERANCE, Decomposition, decompose
from loopcal.typing import BoolArray, FloatArray

WEAKEST = 5
"""Directions written out of those that the data know, but no better than the tolerances."""

AROUND = 3
"""Singular values shown on each side of the cut."""


@dataclass(frozen=True)
class Verdict:
    """What the data say of one parameter.

    Attributes
    ----------
    name : of the parameter. partners : parameters without which it is not determined; itself alone
        where nothing shows it.
    left : its standard deviation with the tolerances as a prior, over its tolerance: 1 where
        nothing is learned.
    """

    name: str
    partners: tuple[str, ...]
    left: float

    @property
    def state(self) -> str:
        """determined, together, or not at all."""
        if not self.partners:
            return "determined"
        return "not at all" if self.partners == (self.name,) else "together"

    def __str__(self) -> str:
        others = [name for name in self.partners if name != self.name]
        return f"only together with {listed(others)}" if others else self.state

    def to_dict(self) -> dict[str, object]:
        """All attributes and the state."""
        return {
            "name": self.name,
            "state": self.state,
            "partners": list(self.partners),
            "left": self.left,
        }


@dataclass(frozen=True, eq=False)
class Identifiability:
    """What the measurements determine, in units of sigma (rows) and tolerance (columns).

    Attributes
    ----------
    n_parameters, n_equations : numbers of free parameters and of equations.
    rank : how many independent combinations the data determine.
    condition : largest over smallest singular value that counts.
    gap : smallest singular value that counts over the largest that does not; infinite where none
        was cut.
    singular_values : (p,) descending. tolerance : share of the largest below which one counts as
        zero.
    improved : directions that the data know better than their tolerance (singular value above 1).
    unidentifiable : combinations of parameters that change nothing that was measured.
    weak : the weakest of the directions that count, but are known no better than the tolerances;
        weakest first.
    indices : observability O1 to O5. parameters : a verdict on each.
    notes : sentences on what was assumed.
    unknowns, factor : what it was read from: the free parameters, and the triangular factor (p, p)
        of the rows.
    """

    n_parameters: int
    n_equations: int
    rank: int
    condition: float
    gap: float
    singular_values: FloatArray
    tolerance: float
    improved: int
    unidentifiable: tuple[Combination, ...]
    weak: tuple[Combination, ...]
    indices: Observability
    parameters: tuple[Verdict, ...]
    notes: tuple[str, ...]
    unknowns: FreeParameters
    factor: FloatArray

    def __str__(self) -> str:
        return "\n".join([*self.sentences(), str(self.indices)])

    def sentences(self) -> list[str]:
        """What is known and what stays open, without the indices."""
        lines = [
            (
                f"{self.rank} of {self.n_parameters} parameter combinations can be identified from "
                f"{self.n_equations} equations"
            ),
            (
                f"condition {self.condition:.3g}, singular values {self._largest:.3g} to "
                f"{self._smallest:.3g} ({SCALING})"
            ),
            f"singular values below {self.tolerance:.0e} of the largest count as zero",
            (
                f"{self.improved} of {self.n_parameters} directions become better known than their "
                "tolerance"
            ),
        ]
        if self.unidentifiable:
            lines.append(
                f"singular values around the cut: {_numbers(self.counted)} | {_numbers(self.cut)}"
                f" ({self.gap:.1e} times below the next)"
            )
            lines += [str(combination) for combination in self.unidentifiable]
        lines += [str(combination) for combination in self.weak]
        if (more := self.rank - self.improved - len(self.weak)) > 0:
            lines.append(f"{more} more directions are known no better than their tolerance")
        return [*lines, *(f"note: {note}" for note in self.notes)]

    @property
    def counted(self) -> FloatArray:
        """The last singular values that count."""
        return self.singular_values[max(self.rank - AROUND, 0) : self.rank]

    @property
    def cut(self) -> FloatArray:
        """All singular values that do not count."""
        return self.singular_values[self.rank :]

    @property
    def _largest(self) -> float:
        return float(self.singular_values[0])

    @property
    def _smallest(self) -> float:
        return float(self.singular_values[max(self.rank - 1, 0)])

    def null_space(self) -> FloatArray:
        """(p, d) orthonormal deviations in tolerances that change nothing that was measured."""
        return np.linalg.svd(self.factor)[2].T[:, self.rank :]

    def to_dict(self) -> dict[str, Any]:
        """Return all attributes by name, ready for JSON (numbers that are not finite are left to
        the writer).
        """
        written = {"unidentifiable", "weak", "indices", "parameters", "unknowns", "factor"}
        plain = {k: v for k, v in vars(self).items() if k not in written}
        return {
            **plain,
            "scaling": SCALING,
            "unidentifiable": [c.to_dict() for c in self.unidentifiable],
            "weak": [c.to_dict() for c in self.weak],
            "indices": self.indices.to_dict(),
            "parameters": [verdict.to_dict() for verdict in self.parameters],
        }


def identifiability(
    robot: Mechanism,
    data: Measurements | Instrument,
    rank_tolerance: float = RANK_TOLERANCE,
    poses: int = 40,
    seed: int = 1,
) -> Identifiability:
    """Tell which combinations of a robot's free parameters measurements determine, at the robot's
    values.

    Parameters
    ----------
    robot : its values, free parameters and tolerances.
    data : measurements, of which the values matter only through which of them are present, and as
        far as they tell where unknown frames, targets and surfaces are (these are eliminated); or
        an instrument, which looks at `poses` positions drawn from the robot's workspace by `seed`.
    rank_tolerance : relative to the largest singular value.

    Raises
    ------
    EstimationError
        No free parameter, no row, or a pose out of reach.
    MechanismError
        Poses are to be drawn, but the robot states no workspace.
    """
    if isinstance(data, Instrument):
        data = simulate(
            robot, sample_workspace(robot, poses, seed).coordinates, data, seed=0, controller=robot
        )
    check_actuators(data, robot)
    free = select_free_parameters(robot)
    count = count_equations(robot, data)
    if not len(free) or not count:
        what = (
            f"{robot.name} has no free parameter; free one"
            if count
            else "no measured value counts; give at least one"
        )
        raise EstimationError(f"there is nothing to tell: {what}")
    factor, reached = collect_information(free, data)
    if not reached.all():
        raise EstimationError(_unreached(data, reached))
    return summarize_identifiability(
        free, decompose(factor, np.full(1, count), tolerance=rank_tolerance), factor[0, :-1, :-1]
    )


def summarize_identifiability(
    free: FreeParameters, decomposition: Decomposition, factor: FloatArray
) -> Identifiability:
    """Return what a decomposition (t = 1), of a factor (p, p), says about identifiability."""
    s, V = decomposition.singular_values[0], decomposition.directions[0]
    rank, equations = int(decomposition.rank[0]), int(decomposition.rows[0])
    null = decomposition.null_space()
    improved = int((s[:rank] > 1.0).sum())
    weakest = range(rank - 1, max(improved, rank - WEAKEST) - 1, -1)
    note = next(map(str, free.findings()), None)
    return Identifiability(
        n_parameters=len(free),
        n_equations=equations,
        rank=rank,
        condition=float(decomposition.condition[0]),
        gap=float(decomposition.gap[0]),
        singular_values=s,
        tolerance=decomposition.tolerance,
        improved=improved,
        unidentifiable=with_meaning(free, describe_null_space(free, null), sparsify_basis(null)),
        weak=tuple(describe_direction(free, V[:, i], float(s[i])) for i in weakest),
        indices=compute_observability(s, rank, equations),
        parameters=_verdicts(free, null, V, s),
        notes=() if note is None else (note,),
        unknowns=free,
        factor=factor,
    )


def _unreached(data: Measurements, reached: BoolArray) -> str:
    """The sentence for poses that the robot does not reach."""
    lost = np.flatnonzero(~reached)
    names = ", ".join(repr(data.labels[i]) for i in lost[:WEAKEST]) + (
        ", ..." if len(lost) > WEAKEST else ""
    )
    return (
        f"the robot cannot reach {len(lost)} of {data.n_poses} poses with the readings given there "
        f"(poses {names}); correct "
        "the readings, their unit or the robot's dimensions, or give these rows weight 0"
    )


def _verdicts(
    free: FreeParameters, null: FloatArray, V: FloatArray, s: FloatArray
) -> tuple[Verdict, ...]:
    """Judge each parameter by the projector onto the null space: whom it shares null directions
    with.

    A parameter is determined where its unit vector has no part in the null space (p, d), not at all
    where it lies in it, and else together with those to which the projector ties it.
    """
    left = np.sqrt((V**2 / (1.0 + s**2)).sum(axis=1))
    projector = null @ null.T
    found = []
    for i, name in enumerate(free.names):
        part = np.sqrt(projector[i, i])
        tied = np.flatnonzero(np.abs(projector[i]) > NULL_COMPONENT * max(part, NULL_COMPONENT))
        partners = tuple(free.names[j] for j in tied) if part > NULL_COMPONENT else ()
        found.append(Verdict(name, partners, float(left[i])))
    return tuple(found)


def _numbers(values: FloatArray) -> str:
    return ", ".join(f"{value:.2g}" for value in values)
