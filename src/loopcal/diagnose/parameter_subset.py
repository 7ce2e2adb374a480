# SPDX-License-Identifier: Apache-2.0
"""A minimal named set of parameters: which of them to leave out, so that nothing that was measured
is lost.

With a basis N (p, d) of the null space, in tolerances, leaving out d parameters loses nothing if
their rows N_d are nonsingular. Then B = N N_d^-1 has the identity in those rows, and to first order
a change z of a parameter left out is the change -B z of the kept ones. Which are left out is
decided by QR with column pivoting on N', each column multiplied by a weight: what is known worst
beforehand in its tolerance, and what nobody sets or measures, goes first. See
docs/theory/observability.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal.diagnose.identifiability_analysis import Identifiability
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.null_space import NEGLIGIBLE, SHOWN, listed
from loopcal.mechanism import LinearMap, Mechanism
from loopcal.typing import FloatArray

SET, SIZED = 0.1, 0.3
"""Weights of parameters that a controller can set (those of a transmission), and of dimensions that
are not zero: kept
against others of as much as ten and three times their share. Among equals the first in the robot's
file is kept."""

FIRST = 1e-6
"""How much the weight grows from parameter to parameter, so that equals are told apart alike on
every machine.
"""


@dataclass(frozen=True, eq=False)
class MergedParameter:
    """A parameter that is left out.

    Attributes
    ----------
    name, unit : of the parameter. into : names of kept ones that take its place. changes : (k,) of
        each for one `unit` of it.
    units : (k,) symbols. All to first order.
    """

    name: str
    unit: str
    into: tuple[str, ...]
    changes: FloatArray
    units: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.name}: {self.words()}"

    def words(self, most: int = SHOWN) -> str:
        """What becomes of it, with at most so many of the parameters that take its place."""
        if not self.into:
            return "nothing that was measured depends on it"
        parts = [
            f"{n} {c:+.4g} {u}" for n, c, u in zip(self.into, self.changes, self.units, strict=True)
        ]
        return f"1 {self.unit} of it counts as {listed(parts, most)}"

    def to_dict(self) -> dict[str, object]:
        """All attributes, and the sentence."""
        into = {
            "into": list(self.into),
            "changes": self.changes.tolist(),
            "units": list(self.units),
        }
        return {"name": self.name, "unit": self.unit, **into, "sentence": str(self)}


@dataclass(frozen=True, eq=False)
class IdentifiableSubset:
    """A set of parameters that says as much as all.

    Attributes
    ----------
    kept : names of the parameters that stay free. dropped : those to fix, and into what each is
        merged.
    condition : of the kept columns alone. robot : with the dropped parameters fixed at their
        nominal values.
    """

    kept: tuple[str, ...]
    dropped: tuple[MergedParameter, ...]
    condition: float
    robot: Mechanism

    def __str__(self) -> str:
        total = len(self.kept) + len(self.dropped)
        if not self.dropped:
            return f"all {total} parameters can be told apart: none is left out"
        lines = [
            (
                f"{len(self.kept)} of {total} parameters say all that the measurements tell "
                "(condition "
                f"{self.condition:.3g})"
            )
        ]
        return "\n".join([*lines, *(f"left out: {merged}" for merged in self.dropped)])

    def to_dict(self) -> dict[str, object]:
        """Names, what was merged into what, and the condition."""
        return {
            "kept": list(self.kept),
            "dropped": [m.to_dict() for m in self.dropped],
            "condition": self.condition,
        }


def choose_identifiable_subset(found: Identifiability) -> IdentifiableSubset:
    """Choose a minimal set of parameters for what measurements determine.

    Parameters
    ----------
    found : what `identifiability` returned.

    Returns
    -------
    IdentifiableSubset; with as many parameters as `found.rank`. The same result for the same input, whatever
    the machine.
    """
    free, null = found.unknowns, found.null_space()
    d = null.shape[1]
    places = _left_out(free, null)
    kept = np.setdiff1d(np.arange(len(free)), places)
    B = null @ np.linalg.inv(null[places]) if d else null
    dropped = tuple(_merged(free, int(place), B[:, i], kept) for i, place in enumerate(places))
    s = np.linalg.svd(found.factor[:, kept], compute_uv=False)
    names = tuple(free.names[i] for i in kept)
    robot = replace(free.robot, parameters=free.robot.parameters.with_free(names))
    return IdentifiableSubset(names, dropped, float(s[0] / s[-1]) if len(s) else 1.0, robot)


def _left_out(free: FreeParameters, null: FloatArray) -> np.ndarray:
    """Places (d,) of the parameters to leave out, in the order of the robot's file."""
    from scipy.linalg import qr

    d = null.shape[1]
    if d == 0:
        return np.zeros(0, dtype=np.int64)
    *_, order = qr((null * _weights(free)[:, None]).T, mode="r", pivoting=True)
    return np.sort(np.asarray(order)[:d])


def _weights(free: FreeParameters) -> FloatArray:
    """How readily each parameter (p,) is left out."""
    set_by_controller: set[str] = set()
    for link in free.robot.assembly.maps:
        moves = (link.address,) if isinstance(link, LinearMap) else link.outputs
        if any(address.element == "transmission" for address in moves):
            set_by_controller.update(
                (link.parameter,) if isinstance(link, LinearMap) else link.inputs
            )
    kinds = [
        SET if p.name in set_by_controller else SIZED if p.nominal != 0.0 else 1.0
        for p in free.parameters
    ]
    return np.asarray(np.array(kinds) * (1.0 + FIRST * np.arange(len(free))), dtype=np.float64)


def _merged(
    free: FreeParameters, place: int, direction: FloatArray, kept: np.ndarray
) -> MergedParameter:
    """What takes the place of a parameter whose null direction (p,) is one at its own place and
    zero at the others left out.
    """
    factor, symbols = free.display()
    amount = -direction[kept]
    chosen = kept[np.abs(amount) > NEGLIGIBLE]
    # one unit of the parameter in tolerances, then each kept one back in its unit
    changes = (
        -direction[chosen]
        * free.tolerance[chosen]
        / factor[chosen]
        * factor[place]
        / free.tolerance[place]
    )
    names = tuple(free.names[i] for i in chosen)
    return MergedParameter(
        free.names[place], symbols[place], names, changes, tuple(symbols[i] for i in chosen)
    )
