# SPDX-License-Identifier: Apache-2.0
"""Is a simpler model enough? Nested sets of free parameters compared by cross-validation.

The simplest set is chosen whose held-out score is within one standard error of the best one
(Breiman, Friedman, Olshen, Stone, Classification and Regression Trees, 1984). A robot that needs no
calibration is the simplest set of all: nothing free.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

from loopcal.diagnose.cross_validation import CrossValidation, cross_validate
from loopcal.errors import EstimationError
from loopcal.estimate.methods.losses import Loss
from loopcal.estimate.methods.penalties import Method
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism
from loopcal.units import Dimension

OFFSETS = re.compile(r"(^|\.)(offset|stop|zero|home)$|^q\d+$")
"""Names of what shifts a reading."""

LENGTHS = re.compile(r"(^|\.)(length|radius)$|^[lr]\d*$")
"""Names of the main dimensions."""

NOTHING = "nothing"


@dataclass(frozen=True, eq=False)
class Candidate:
    """One set of free parameters: its name, the parameters, and how well it predicts unseen poses."""

    name: str
    parameters: tuple[str, ...]
    validation: CrossValidation


@dataclass(frozen=True, eq=False)
class ModelChoice:
    """The comparison.

    Attributes
    ----------
    candidates : simplest first. chosen, best : the set to use, and the one with the lowest score.
    robot : the robot with just the chosen parameters free. sentence : what this means.
    """

    candidates: tuple[Candidate, ...]
    chosen: Candidate
    best: Candidate
    robot: Mechanism
    sentence: str

    def __str__(self) -> str:
        lines = [f"{'free':<12} {'parameters':>10} {'held-out score':>14} {'+/-':>9}"]
        for candidate in self.candidates:
            found = candidate.validation
            lines.append(
                f"{candidate.name:<12} {len(candidate.parameters):>10} {found.score:>14.4g} "
                f"{found.standard_error:>9.2g}"
            )
        return "\n".join([*lines, self.sentence])

    def to_dict(self) -> dict[str, Any]:
        """Return the result by name for JSON."""
        return {
            "candidates": [
                {
                    "name": c.name,
                    "parameters": list(c.parameters),
                    "score": c.validation.score,
                    "standard_error": c.validation.standard_error,
                }
                for c in self.candidates
            ],
            "chosen": self.chosen.name,
            "best": self.best.name,
            "sentence": self.sentence,
        }


def nest_parameter_sets(robot: Mechanism) -> dict[str, tuple[str, ...]]:
    """Return sets of a robot's free parameters, each within the next: offsets, with lengths, ideal
    joints, complete.

    Offsets and lengths are told by the names of the shipped families; "ideal" is every length and
    ratio (joints where they are, axes as designed), "complete" everything. A set that adds nothing
    is left out.
    """
    free = [p for p in robot.parameters.entries if p.free]
    offsets = {p.name for p in free if OFFSETS.search(p.name)}
    lengths = offsets | {p.name for p in free if LENGTHS.search(p.name)}
    ideal = lengths | {p.name for p in free if p.dimension is not Dimension.ANGLE}
    every = {p.name for p in free}
    found: dict[str, tuple[str, ...]] = {}
    size = 0
    for name, chosen in (
        ("offsets", offsets),
        ("lengths", lengths),
        ("ideal", ideal),
        ("complete", every),
    ):
        if len(chosen) > size:
            found[name] = tuple(p.name for p in free if p.name in chosen)
            size = len(chosen)
    return found


def choose_model(
    robot: Mechanism,
    data: Measurements,
    nested: Mapping[str, Sequence[str]] | None = None,
    method: Method | None = None,
    *,
    count: int = 5,
    seed: int = 1,
    noise: Literal["given", "estimated"] = "given",
    loss: Loss | None = None,
) -> ModelChoice:
    """Choose the simplest set of free parameters that predicts unseen poses as well as any.

    Parameters
    ----------
    robot, data, method, noise, loss : as for `identify`; all candidates are subsets of the free
        parameters.
    nested : name -> parameters, each set within the next; default `nested_sets`. "nothing" is
        always compared as well.
    count, seed : of the folds, which are the same for all sets.

    Raises
    ------
    EstimationError
        The sets are not nested. A set that the data cannot determine by this method is refused as
        by `identify`.
    """
    sets = {
        NOTHING: (),
        **{
            name: tuple(names)
            for name, names in (nest_parameter_sets(robot) if nested is None else nested).items()
        },
    }
    named = list(sets.items())
    for (small, inner), (large, outer) in pairwise(named):
        if not set(inner) < set(outer):
            raise EstimationError(
                f"the set {small!r} is not within {large!r}, or equal to it; give each set within "
                "the next"
            )

    def validated(names: Sequence[str]) -> CrossValidation:
        return cross_validate(
            _only(robot, names), data, method, count=count, seed=seed, noise=noise, loss=loss
        )

    candidates = tuple(Candidate(name, names, validated(names)) for name, names in named)
    best = min(candidates, key=lambda c: c.validation.score)
    enough = best.validation.score + best.validation.standard_error
    chosen = next(c for c in candidates if c.validation.score <= enough)
    return ModelChoice(
        candidates,
        chosen,
        best,
        _only(robot, chosen.parameters),
        _sentence(candidates, chosen, best),
    )


def _only(robot: Mechanism, names: Sequence[str]) -> Mechanism:
    return replace(robot, parameters=robot.parameters.with_free(names))


def _sentence(candidates: tuple[Candidate, ...], chosen: Candidate, best: Candidate) -> str:
    """Say which set is enough."""
    if chosen is candidates[-1]:
        return f"no simpler model is enough: all {len(chosen.parameters)} parameters ({chosen.name}) are needed"
    within = (
        "predicts unseen poses best"
        if chosen is best
        else f"predicts unseen poses within one standard error of {best.name} "
        f"({len(best.parameters)} parameters)"
    )
    if not chosen.parameters:
        return f"calibration gains nothing on unseen poses: the robot as it is {within}"
    return (
        f"a simpler model is enough: {chosen.name} ({len(chosen.parameters)} parameters) {within}"
    )
