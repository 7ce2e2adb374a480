# SPDX-License-Identifier: Apache-2.0
"""Choose the simplest set of free parameters that predicts held-out poses as well as any.

Sets of free parameters are compared by cross-validation: nested ones, and the one that the
controller of the machine stores. The set with the fewest parameters is chosen whose held-out score
is within one standard error of the best one (Breiman, Friedman, Olshen, Stone, Classification and
Regression Trees, 1984). The simplest set of all frees nothing. Rank and condition of every set
show what a score does not: whether the data determine its parameters well.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np

from loopcal.diagnose.cross_validation import CrossValidation, cross_validate
from loopcal.errors import EstimationError
from loopcal.estimate.fit_input import check_types, exclude_poses
from loopcal.estimate.free_parameters import free_only, select_free_parameters
from loopcal.estimate.information import collect_information
from loopcal.estimate.methods.penalties import Method
from loopcal.estimate.options import FitOptions, merge_options
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements, fill_in_reading_sigma
from loopcal.mechanism import Mechanism
from loopcal.numerics.decomposition import are_nonzero
from loopcal.presentation import TableResult
from loopcal.typing import FloatArray, Progress, report_no_progress
from loopcal.units import Dimension

OFFSETS = re.compile(r"(^|\.)(offset|stop|zero|home)$|^q\d+$")
"""Names of parameters that shift an actuator reading."""

LENGTHS = re.compile(r"(^|\.)(length|radius)$|^[lr]\d*$")
"""Names of the main dimensions."""

NOTHING = "nothing"
"""Name of the set that frees no parameter."""

CONTROLLER = "controller"
"""Name of the set that the controller of the machine stores."""

NOT_COMPARED = ("fit.too-few-equations", "model.fold-not-converged")
"""Codes of the reasons why a set is not compared: the data have too few equations for it, or its
fit without a fold does not converge.
"""


class Conditioning(NamedTuple):
    """How data determine a set of parameters: number of directions, and condition number of their
    columns in tolerances; infinite where the rank is below the number of parameters.
    """

    rank: int
    condition: float


@dataclass(frozen=True, eq=False)
class Candidate:
    """One set of free parameters.

    Attributes
    ----------
    name : of the set. parameters : their names.
    validation : cross-validation; None where without a fold too few equations remain, or the fit
        does not converge.
    conditioning : by all data, at the values before calibration.
    """

    name: str
    parameters: tuple[str, ...]
    validation: CrossValidation | None
    conditioning: Conditioning

    @property
    def score(self) -> float:
        """Mean square error on held-out poses [sigma^2]; infinite where it is not known."""
        return np.inf if self.validation is None else self.validation.score

    @property
    def standard_error(self) -> float:
        """Standard error of the score; NaN where it is not known."""
        return np.nan if self.validation is None else self.validation.standard_error

    JSON_FIELDS: ClassVar[Mapping[str, str]] = {
        "name": "name",
        "parameters": "parameters",
        "score": "score",
        "standard_error": "standard_error",
        "rank": "conditioning.rank",
        "condition": "conditioning.condition",
    }


@dataclass(frozen=True, eq=False)
class ModelChoice(TableResult):
    """The comparison of sets of free parameters.

    Attributes
    ----------
    candidates : the set with the fewest parameters first. chosen : the set to use.
    best : the one with the lowest score. robot : the robot with only the chosen parameters free.
    """

    candidates: tuple[Candidate, ...]
    chosen: Candidate
    best: Candidate
    robot: Mechanism

    @property
    def finding(self) -> Finding:
        """The choice."""
        compared = [c for c in self.candidates if c.validation is not None]
        code = "simpler-suffices" if self.chosen.parameters else "nothing-gained"
        if self.chosen is compared[-1]:
            code = "all-needed"
        return report_finding(
            f"model.{code}",
            chosen=self.chosen.name,
            parameters=len(self.chosen.parameters),
            best=self.best.name,
            best_parameters=len(self.best.parameters),
            not_compared=tuple(c.name for c in self.candidates if c.validation is None),
        )

    def __repr__(self) -> str:
        return f"<ModelChoice: {self.chosen.name} of {', '.join(c.name for c in self.candidates)}>"

    def __str__(self) -> str:
        heading = f"{'free':<12} {'parameters':>10} {'rank':>4} {'condition':>9}"
        lines = [f"{heading} {'held-out score':>14} {'+/-':>9}"]
        for c in self.candidates:
            rank, condition = c.conditioning
            lines.append(
                f"{c.name:<12} {len(c.parameters):>10} {rank:>4} {condition:>9.3g} "
                f"{c.score:>14.4g} {c.standard_error:>9.2g}"
            )
        return "\n".join([*lines, str(self.finding)])

    def to_dict(self) -> dict[str, Any]:
        """Return scores, conditions, choice and finding for JSON."""
        return {
            "candidates": self.candidates,
            "chosen": self.chosen.name,
            "best": self.best.name,
            "finding": self.finding,
        }


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


def list_parameter_sets(robot: Mechanism) -> dict[str, tuple[str, ...]]:
    """Return the nested sets of a robot, and the set that its controller stores, by size.

    The controller's set, `Assembly.stored_parameters`, takes the place of a nested one that is
    equal. Parameters that are fixed are left out.
    """
    sets = nest_parameter_sets(robot)
    free = [p.name for p in robot.parameters.entries if p.free]
    stored = tuple(name for name in free if name in robot.assembly.stored_parameters)
    if stored:
        sets = {name: names for name, names in sets.items() if names != stored}
        sets[CONTROLLER] = stored
    return dict(sorted(sets.items(), key=lambda item: len(item[1])))


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
    nested : name -> parameters, each set within the next; default `list_parameter_sets`. The set
        "nothing" is always compared as well.
    progress : receives the fits that are done.

    Raises
    ------
    EstimationError
        The stated sets are not nested. Sets with too few equations, and those that do not converge,
        are listed, but not compared.
    """
    check_types(robot, data)
    if nested is not None:
        _check_nested(nested)
    sets = list_parameter_sets(robot) if nested is None else nested
    named = [(NOTHING, ()), *((name, tuple(names)) for name, names in sets.items())]
    options = merge_options(options, method)

    def validate_set(place: int, names: Sequence[str]) -> CrossValidation | None:
        def count_fits(done: int, _total: int, _what: str) -> None:
            progress(place * count + done, len(named) * count, "comparing parameter sets")

        only = free_only(robot, names)
        try:
            return cross_validate(
                only,
                data,
                options=options,
                count=count,
                seed=seed,
                must_converge=True,
                progress=count_fits,
            )
        except EstimationError as error:
            if error.code not in NOT_COMPARED:
                raise
            return None

    conditions = _rate_conditioning(robot, data, [names for _, names in named], options)
    candidates = tuple(
        Candidate(name, names, validate_set(i, names), conditions[i])
        for i, (name, names) in enumerate(named)
    )
    best = min(candidates, key=lambda c: c.score)
    limit = best.score + best.standard_error if np.isfinite(best.score) else np.inf
    chosen = next(c for c in candidates if c.score <= limit)
    return ModelChoice(candidates, chosen, best, free_only(robot, chosen.parameters))


def _check_nested(nested: Mapping[str, Sequence[str]]) -> None:
    """Refuse sets of which one is not within the next."""
    named = [(NOTHING, ()), *nested.items()]
    for (small, inner), (large, outer) in pairwise(named):
        if not set(inner) < set(outer):
            raise EstimationError(
                f"the set {small!r} is not within {large!r}, or equal to it; give each set within "
                "the next"
            )


def _rate_conditioning(
    robot: Mechanism, data: Measurements, sets: Sequence[Sequence[str]], options: FitOptions
) -> list[Conditioning]:
    """Return rank and condition of the columns of each set, in tolerances."""
    if not robot.parameters.free.any():
        return [Conditioning(0, 1.0) for _ in sets]
    free = select_free_parameters(robot)
    data = exclude_poses(fill_in_reading_sigma(robot, data), options.excluded_poses)
    columns: FloatArray = collect_information(free, data)[0][0, :-1, :-1]
    rated = []
    for names in sets:
        if not names:
            rated.append(Conditioning(0, 1.0))
            continue
        s = np.linalg.svd(columns[:, [free.names.index(name) for name in names]], compute_uv=False)
        rank = int(are_nonzero(s, options.rank_tolerance).sum())
        is_full = rank == len(names)
        rated.append(Conditioning(rank, float(s[0] / s[-1]) if is_full else np.inf))
    return rated
