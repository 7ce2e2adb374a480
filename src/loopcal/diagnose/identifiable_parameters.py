# SPDX-License-Identifier: Apache-2.0
"""Determine what measurements identify, before or without a fit: rank, condition, null space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.diagnose.null_space import interpret_combinations
from loopcal.diagnose.observability import SCALING, Observability, compute_observability
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.estimate.inference.null_space import (
    Combination,
    describe_direction,
    describe_null_space,
    sparsify_basis,
)
from loopcal.estimate.information import collect_information, count_equations
from loopcal.findings import Finding, report_finding
from loopcal.measure import Instrument, Measurements, check_actuators, simulate
from loopcal.mechanism import Mechanism, sample_workspace
from loopcal.numerics.decomposition import NULL_COMPONENT, RANK_TOLERANCE, Decomposition, decompose
from loopcal.typing import FloatArray

MOST_WEAK = 5
"""Number of weak directions that are listed, weakest first."""

AROUND = 3
"""Number of singular values listed before the cut."""

MOST_ROWS = 12
"""Number of parameters in the printed table; the others are counted."""


@dataclass(frozen=True)
class ParameterIdentifiability:
    """What the data determine of one parameter.

    Attributes
    ----------
    name : of the parameter. partners : parameters with which only a combination is determined;
        only itself where it has no effect; empty where it is determined.
    left : standard deviation with the tolerances as a prior, over the tolerance: 1 where nothing is
        learned.
    """

    name: str
    partners: tuple[str, ...]
    left: float

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

    def to_dict(self) -> dict[str, object]:
        """Return the attributes and the state for JSON."""
        return {**vars(self), "state": self.state}


@dataclass(frozen=True, eq=False, repr=False)
class Identifiability:
    """What measurements determine, in units of sigma (rows) and tolerance (columns).

    Attributes
    ----------
    n_parameters, n_equations : numbers of free parameters and of equations.
    rank : number of independent combinations that the data determine.
    condition : largest over smallest singular value that counts.
    gap : smallest singular value that counts over the largest that does not; infinite where none
        was cut.
    singular_values : (p,) descending. tolerance : share of the largest below which one counts as
        zero.
    improved : number of directions known better than their tolerance (singular value above 1).
    unidentifiable : combinations of parameters that change no measured value.
    weak : the weakest directions known no better than the tolerances, weakest first.
    indices : observability O1 to O5. parameters : the result for each parameter.
    notes : findings on assumptions.
    free_parameters, factor : the free parameters, and the triangular factor (p, p) of the rows.
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
    parameters: tuple[ParameterIdentifiability, ...]
    notes: tuple[Finding, ...]
    free_parameters: FreeParameters
    factor: FloatArray

    def __repr__(self) -> str:
        name, rank = self.free_parameters.robot.name, f"rank {self.rank} of {self.n_parameters}"
        numbers = f"{self.n_equations} equations, condition {self.condition:.3g}"
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
        findings = [
            report_finding(
                "identifiability.rank",
                rank=self.rank,
                parameters=self.n_parameters,
                equations=self.n_equations,
            ),
            report_finding(
                "identifiability.spectrum",
                condition=self.condition,
                largest=float(self.singular_values[0]),
                smallest=float(self.singular_values[max(self.rank - 1, 0)]),
                scaling=SCALING,
                tolerance=self.tolerance,
            ),
            report_finding(
                "identifiability.improved", improved=self.improved, parameters=self.n_parameters
            ),
        ]
        if self.unidentifiable:
            findings.append(
                report_finding(
                    "identifiability.gap",
                    counted=tuple(f"{value:.2g}" for value in self.counted),
                    cut=tuple(f"{value:.2g}" for value in self.cut),
                    gap=self.gap,
                )
            )
        findings += [one.finding for one in (*self.unidentifiable, *self.weak)]
        if (more := self.rank - self.improved - len(self.weak)) > 0:
            findings.append(report_finding("identifiability.more-weak-directions", count=more))
        return (*findings, *self.notes)

    @property
    def counted(self) -> FloatArray:
        """The last singular values that count."""
        return self.singular_values[max(self.rank - AROUND, 0) : self.rank]

    @property
    def cut(self) -> FloatArray:
        """All singular values that do not count."""
        return self.singular_values[self.rank :]

    def null_space(self) -> FloatArray:
        """Return (p, d) orthonormal deviations in tolerances that change no measured value."""
        return np.linalg.svd(self.factor)[2].T[:, self.rank :]

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes for JSON, without the matrices, and the findings."""
        omitted = {"notes", "free_parameters", "factor"}
        content = {k: v for k, v in vars(self).items() if k not in omitted}
        return {**content, "scaling": SCALING, "findings": self.findings}


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
    if isinstance(data, Instrument):
        coordinates = sample_workspace(robot, poses, seed).coordinates
        data = simulate(robot, coordinates, data, seed=0, controller=robot)
    check_actuators(data, robot)
    free = select_free_parameters(robot)
    count = count_equations(robot, data)
    if not len(free):
        total = len(robot.parameters)
        finding = report_finding("fit.no-free-parameter", robot=robot.name, total=total)
        raise EstimationError(finding)
    if not count:
        raise EstimationError(report_finding("fit.no-measured-value"))
    factor, reached = collect_information(free, data)
    if not reached.all():
        names = tuple(data.labels[i] for i in np.flatnonzero(~reached))
        raise EstimationError(
            report_finding(
                "fit.poses-out-of-reach", count=len(names), total=data.n_poses, poses=names
            )
        )
    decomposition = decompose(factor, np.full(1, count), tolerance=rank_tolerance)
    return summarize_identifiability(free, decomposition, factor[0, :-1, :-1])


def summarize_identifiability(
    free: FreeParameters, decomposition: Decomposition, factor: FloatArray
) -> Identifiability:
    """Return the identifiability by a decomposition (t = 1) of a factor (p, p)."""
    s, V = decomposition.singular_values[0], decomposition.directions[0]
    rank, equations = int(decomposition.rank[0]), int(decomposition.rows[0])
    null = decomposition.null_space()
    improved = int((s[:rank] > 1.0).sum())
    weakest = range(rank - 1, max(improved, rank - MOST_WEAK) - 1, -1)
    combinations = describe_null_space(free, null)
    return Identifiability(
        n_parameters=len(free),
        n_equations=equations,
        rank=rank,
        condition=float(decomposition.condition[0]),
        gap=float(decomposition.gap[0]),
        singular_values=s,
        tolerance=decomposition.tolerance,
        improved=improved,
        unidentifiable=interpret_combinations(free, combinations, sparsify_basis(null)),
        weak=tuple(describe_direction(free, V[:, i], float(s[i])) for i in weakest),
        indices=compute_observability(s, rank, equations),
        parameters=_identify_parameters(free, null, V, s),
        notes=free.findings(),
        free_parameters=free,
        factor=factor,
    )


def _identify_parameters(
    free: FreeParameters, null: FloatArray, V: FloatArray, s: FloatArray
) -> tuple[ParameterIdentifiability, ...]:
    """Judge each parameter by the projector onto the null space (p, d).

    A parameter is determined where its unit vector has no part in the null space, not at all where
    it lies in it, and otherwise together with those to which the projector ties it.
    """
    left = np.sqrt((V**2 / (1.0 + s**2)).sum(axis=1))
    projector = null @ null.T
    parameters = []
    for i, name in enumerate(free.names):
        part = np.sqrt(projector[i, i])
        tied = np.flatnonzero(np.abs(projector[i]) > NULL_COMPONENT * max(part, NULL_COMPONENT))
        partners = tuple(free.names[j] for j in tied) if part > NULL_COMPONENT else ()
        parameters.append(ParameterIdentifiability(name, partners, float(left[i])))
    return tuple(parameters)
