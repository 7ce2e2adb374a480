# SPDX-License-Identifier: Apache-2.0
"""Which parameter, limb or pair of limbs explains the change of a machine.

A cause explains a change if the chi-square that is left, with its parameters free to change, is
what the noise lets expect. Causes are tried from the simplest on. Others that explain the change
almost as well, within the 95 % quantile of a chi-square with one degree of freedom, cannot be
distinguished from the best one, and are stated as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from loopcal.diagnose.machine_changes.parameter_changes import ParameterChanges
from loopcal.numerics.chi_square import compute_chi_square_quantile

DISTINGUISHED = 0.05
"""Probability of distinguishing the true cause from a better one by chance."""


@dataclass(frozen=True)
class ChangeCause:
    """What explains a change.

    Attributes
    ----------
    kind : "parameter", "limb", "limbs" (two of them) or "none" where no such cause suffices.
    names : the best cause: a parameter, a limb or two limbs. parameters : those that may change.
    alternatives : other causes of this kind that the data cannot distinguish from it.
    left : chi-square that it leaves. degrees : of freedom of this chi-square.
    """

    kind: str
    names: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    alternatives: tuple[tuple[str, ...], ...] = ()
    left: float = float("nan")
    degrees: int = 0


def explain_change(changes: ParameterChanges, level: float) -> ChangeCause:
    """Return the simplest cause of a change.

    Parameters
    ----------
    changes : of all parameters. level : probability with which the true cause is rejected.
    """
    limbs = group_by_limb(changes.names)
    kinds: dict[str, list[tuple[tuple[str, ...], list[int]]]] = {
        "parameter": [((name,), [i]) for i, name in enumerate(changes.names)],
        "limb": [((limb,), places) for limb, places in limbs.items()],
        "limbs": [
            ((first, second), [*limbs[first], *limbs[second]])
            for first, second in combinations(limbs, 2)
        ],
    }
    for kind, causes in kinds.items():
        cause = _choose(changes, kind, causes, level)
        if cause is not None:
            return cause
    return ChangeCause("none")


def group_by_limb(names: Sequence[str]) -> Mapping[str, list[int]]:
    """Return limb -> places of its parameters: names before the first point."""
    limbs: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        if "." in name:
            limbs.setdefault(name.split(".")[0], []).append(i)
    return limbs


def _choose(
    changes: ParameterChanges,
    kind: str,
    causes: Sequence[tuple[tuple[str, ...], list[int]]],
    level: float,
) -> ChangeCause | None:
    """Return the best of some causes; None where none of them explains the change."""
    results = [changes.project_out(places) for _, places in causes]
    p_values = [
        changes.compute_p_value(left, degrees) if degrees else 1.0 for left, degrees in results
    ]
    # a cause that leaves nothing to test explains any change
    open_causes = [i for i, (_, degrees) in enumerate(results) if degrees < changes.degrees]
    if not open_causes:
        return None
    best = max(open_causes, key=lambda i: (p_values[i], -results[i][0]))
    left, degrees = results[best]
    if p_values[best] < level or degrees == 0:
        return None
    near = left + float(compute_chi_square_quantile(1.0, DISTINGUISHED))
    others = [
        causes[i][0]
        for i in sorted(open_causes, key=lambda i: results[i][0])
        if i != best and results[i][0] <= near
    ]
    names, places = causes[best]
    parameters = tuple(changes.names[i] for i in places)
    return ChangeCause(kind, names, parameters, tuple(others), left, degrees)


def estimate_cause(changes: ParameterChanges, cause: ChangeCause) -> tuple[np.ndarray, np.ndarray]:
    """Return the change (k,) and its standard deviation (k,) [SI] of the parameters of a cause if
    nothing else has changed; NaN where the data do not determine it.
    """
    places = [changes.names.index(name) for name in cause.parameters]
    alone = ParameterChanges(
        cause.parameters,
        changes.unit[places],
        changes.slope[:, places],
        changes.value,
        changes.errors,
    )
    return alone.estimate_shifts()
