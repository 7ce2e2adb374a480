# SPDX-License-Identifier: Apache-2.0
"""Choose which parameters to free: a minimal identifiable set, or the simplest sufficient model.

Identifiable set. With a basis N (p, d) of the null space, in tolerances, fixing d parameters loses
nothing if their rows N_d are nonsingular. Then B = N N_d^-1 has the identity in those rows, and to
first order a change z of a fixed parameter is the change -B z of the kept ones. The fixed
parameters are chosen by elimination with pivoting on N', each column multiplied by a weight: those
with the largest uncertainty in their tolerance, and those that nobody sets or measures, go first.
See docs/theory/observability.md.

Sufficient model. Nested sets of free parameters are compared by cross-validation. The simplest set
is chosen whose held-out score is within one standard error of the best one (Breiman, Friedman,
Olshen, Stone, Classification and Regression Trees, 1984). The simplest set of all frees nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from loopcal.diagnose.cross_validation import CrossValidation, cross_validate
from loopcal.diagnose.identifiable_parameters import Identifiability
from loopcal.errors import EstimationError
from loopcal.estimate.fit_input import check_types
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.null_space import NEGLIGIBLE
from loopcal.estimate.methods.penalties import Method
from loopcal.estimate.options import FitOptions, merge_options
from loopcal.findings import Finding, report_finding
from loopcal.findings.catalog.phrases import effect
from loopcal.measure import Measurements
from loopcal.measure.array_checks import check_type
from loopcal.mechanism import LinearMap, Mechanism
from loopcal.typing import FloatArray, IntArray, Progress, report_no_progress
from loopcal.units import Dimension

SETTABLE, NONZERO = 0.1, 0.3
"""Weights of parameters that a controller can set (those of a transmission), and of dimensions that
are not zero: they are kept against others of as much as ten and three times their share.
"""

TIE = 1e-6
"""Relative difference below which two candidates for the next fixed parameter are equal; then the
last in the robot's file is fixed. Equal candidates differ by rounding, unlike on every machine.
"""

OFFSETS = re.compile(r"(^|\.)(offset|stop|zero|home)$|^q\d+$")
"""Names of parameters that shift an actuator reading."""

LENGTHS = re.compile(r"(^|\.)(length|radius)$|^[lr]\d*$")
"""Names of the main dimensions."""

NOTHING = "nothing"
"""Name of the set that frees no parameter."""


@dataclass(frozen=True, eq=False)
class MergedParameter:
    """A parameter that is fixed because others have the same effect.

    Attributes
    ----------
    name, unit : of the parameter. into : names of the kept parameters that replace it.
    changes : (k,) of each for one `unit` of it, to first order. units : (k,) symbols.
    """

    name: str
    unit: str
    into: tuple[str, ...]
    changes: FloatArray
    units: tuple[str, ...]

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

    def to_dict(self) -> dict[str, object]:
        """Return the attributes and the finding for JSON."""
        return {**vars(self), "finding": self.finding}


@dataclass(frozen=True, eq=False)
class IdentifiableSubset:
    """A set of free parameters that carries all information of the measurements.

    Attributes
    ----------
    kept : names of the parameters that stay free. dropped : those to fix, and their replacements.
    condition : of the kept columns alone. robot : with the dropped parameters fixed at their
        nominal values.
    """

    kept: tuple[str, ...]
    dropped: tuple[MergedParameter, ...]
    condition: float
    robot: Mechanism

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

    def to_dict(self) -> dict[str, object]:
        """Return names, replacements and the condition for JSON."""
        return {"kept": self.kept, "dropped": self.dropped, "condition": self.condition}


@dataclass(frozen=True, eq=False)
class Candidate:
    """One set of free parameters, and its cross-validation."""

    name: str
    parameters: tuple[str, ...]
    validation: CrossValidation

    JSON_FIELDS: ClassVar[Mapping[str, str]] = {
        "name": "name",
        "parameters": "parameters",
        "score": "validation.score",
        "standard_error": "validation.standard_error",
    }


@dataclass(frozen=True, eq=False)
class ModelChoice:
    """The comparison of nested sets of free parameters.

    Attributes
    ----------
    candidates : simplest first. chosen : the set to use. best : the one with the lowest score.
    robot : the robot with only the chosen parameters free.
    """

    candidates: tuple[Candidate, ...]
    chosen: Candidate
    best: Candidate
    robot: Mechanism

    @property
    def finding(self) -> Finding:
        """The choice."""
        code = "simpler-suffices" if self.chosen.parameters else "nothing-gained"
        if self.chosen is self.candidates[-1]:
            code = "all-needed"
        return report_finding(
            f"model.{code}",
            chosen=self.chosen.name,
            parameters=len(self.chosen.parameters),
            best=self.best.name,
            best_parameters=len(self.best.parameters),
        )

    def __repr__(self) -> str:
        return f"<ModelChoice: {self.chosen.name} of {', '.join(c.name for c in self.candidates)}>"

    def __str__(self) -> str:
        lines = [f"{'free':<12} {'parameters':>10} {'held-out score':>14} {'+/-':>9}"]
        for candidate in self.candidates:
            validation = candidate.validation
            lines.append(
                f"{candidate.name:<12} {len(candidate.parameters):>10} {validation.score:>14.4g} "
                f"{validation.standard_error:>9.2g}"
            )
        return "\n".join([*lines, str(self.finding)])

    def to_dict(self) -> dict[str, Any]:
        """Return scores, choice and finding for JSON."""
        return {
            "candidates": self.candidates,
            "chosen": self.chosen.name,
            "best": self.best.name,
            "finding": self.finding,
        }


def choose_identifiable_subset(identifiability: Identifiability) -> IdentifiableSubset:
    """Choose a minimal set of parameters for what measurements determine.

    The result has as many free parameters as the rank, and does not depend on the machine.
    """
    check_type(
        identifiability, Identifiability, "identifiability", "as from identifiability(robot, data)"
    )
    free, null = identifiability.free_parameters, identifiability.null_space()
    places = _choose_fixed(free, null)
    kept = np.setdiff1d(np.arange(len(free)), places)
    B = null @ np.linalg.inv(null[places]) if len(places) else null
    dropped = tuple(_merge(free, int(place), B[:, i], kept) for i, place in enumerate(places))
    s = np.linalg.svd(identifiability.factor[:, kept], compute_uv=False)
    names = tuple(free.names[i] for i in kept)
    condition = float(s[0] / s[-1]) if len(s) else 1.0
    return IdentifiableSubset(names, dropped, condition, _free_only(free.robot, names))


def nest_parameter_sets(robot: Mechanism) -> dict[str, tuple[str, ...]]:
    """Return nested sets of a robot's free parameters: offsets, lengths, ideal, complete.

    The names of the shipped families tell offsets and lengths. "lengths" contains the offsets,
    "ideal" all lengths and ratios (joints where they are, axes as designed), "complete" everything.
    A set that adds nothing is omitted.
    """
    free = [p for p in robot.parameters.entries if p.free]
    offsets = {p.name for p in free if OFFSETS.search(p.name)}
    lengths = offsets | {p.name for p in free if LENGTHS.search(p.name)}
    ideal = lengths | {p.name for p in free if p.dimension is not Dimension.ANGLE}
    nested = {"offsets": offsets, "lengths": lengths, "ideal": ideal}
    nested["complete"] = {p.name for p in free}
    sets: dict[str, tuple[str, ...]] = {}
    size = 0
    for name, chosen in nested.items():
        if len(chosen) > size:
            sets[name] = tuple(p.name for p in free if p.name in chosen)
            size = len(chosen)
    return sets


def choose_model(
    robot: Mechanism,
    data: Measurements,
    nested: Mapping[str, Sequence[str]] | None = None,
    method: Method | None = None,
    *,
    options: FitOptions | None = None,
    count: int = 5,
    seed: int = 1,
    progress: Progress = report_no_progress,
) -> ModelChoice:
    """Choose the simplest set of free parameters that predicts held-out poses as well as any.

    Parameters
    ----------
    robot, data, method, options, count, seed : as for `cross_validate`; all candidates are subsets
        of the free parameters and have the same folds.
    nested : name -> parameters, each set within the next; default `nest_parameter_sets`. The set
        "nothing" is always compared as well.
    progress : receives the fits that are done.

    Raises
    ------
    EstimationError
        The sets are not nested. A set that the data cannot determine by this method is refused as
        by `identify`.
    """
    check_types(robot, data)
    nested = nest_parameter_sets(robot) if nested is None else nested
    named = [(NOTHING, ()), *((name, tuple(names)) for name, names in nested.items())]
    for (small, inner), (large, outer) in pairwise(named):
        if not set(inner) < set(outer):
            raise EstimationError(
                f"the set {small!r} is not within {large!r}, or equal to it; give each set within "
                "the next"
            )
    options = merge_options(options, method)

    def validate_set(place: int, names: Sequence[str]) -> CrossValidation:
        def count_fits(done: int, _total: int, _what: str) -> None:
            progress(place * count + done, len(named) * count, "comparing parameter sets")

        only = _free_only(robot, names)
        return cross_validate(
            only, data, options=options, count=count, seed=seed, progress=count_fits
        )

    candidates = tuple(
        Candidate(name, names, validate_set(i, names)) for i, (name, names) in enumerate(named)
    )
    best = min(candidates, key=lambda c: c.validation.score)
    limit = best.validation.score + best.validation.standard_error
    chosen = next(c for c in candidates if c.validation.score <= limit)
    return ModelChoice(candidates, chosen, best, _free_only(robot, chosen.parameters))


def _free_only(robot: Mechanism, names: Sequence[str]) -> Mechanism:
    return replace(robot, parameters=robot.parameters.with_free(names))


def _choose_fixed(free: FreeParameters, null: FloatArray) -> IntArray:
    """Return the places (d,) of the parameters to fix, in the order of the robot's file."""
    columns = (null * _weights(free)[:, None]).T
    fixed: list[int] = []
    for _ in range(len(columns)):
        size = np.linalg.norm(columns, axis=0)
        size[fixed] = 0.0
        place = int(np.flatnonzero(size >= (1.0 - TIE) * size.max())[-1])
        fixed.append(place)
        direction = columns[:, place] / size[place]
        columns = columns - direction[:, None] * (direction @ columns)
    return np.sort(np.array(fixed, dtype=np.int64))


def _weights(free: FreeParameters) -> FloatArray:
    """Return the weight (p,) with which each parameter is a candidate to be fixed."""
    settable: set[str] = set()
    for link in free.robot.assembly.maps:
        addresses = (link.address,) if isinstance(link, LinearMap) else link.outputs
        if any(address.element == "transmission" for address in addresses):
            settable.update((link.parameter,) if isinstance(link, LinearMap) else link.inputs)
    return np.array(
        [
            SETTABLE if p.name in settable else NONZERO if p.nominal != 0.0 else 1.0
            for p in free.parameters
        ]
    )


def _merge(
    free: FreeParameters, place: int, direction: FloatArray, kept: IntArray
) -> MergedParameter:
    """Return the replacement of a parameter whose null direction (p,) is one at its own place and
    zero at the other fixed ones.
    """
    factor, symbols = free.display()
    unit = free.tolerance / factor  # tolerances in the units of the robot's file
    chosen = kept[np.abs(direction[kept]) > NEGLIGIBLE]
    changes = -direction[chosen] * unit[chosen] / unit[place]
    names = tuple(free.names[i] for i in chosen)
    units = tuple(symbols[i] for i in chosen)
    return MergedParameter(free.names[place], symbols[place], names, changes, units)
