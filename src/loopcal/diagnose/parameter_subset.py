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

import numpy as np

from loopcal.diagnose.identifiable_parameters import Identifiability
from loopcal.estimate.free_parameters import FreeParameters, free_only
from loopcal.estimate.inference.null_space import NEGLIGIBLE, choose_pivots
from loopcal.findings import Finding, report_finding
from loopcal.findings.catalog.phrases import effect
from loopcal.measure.array_checks import check_type
from loopcal.mechanism import LinearMap, Mechanism
from loopcal.presentation import HtmlResult
from loopcal.typing import FloatArray, IntArray

SETTABLE, NONZERO = 0.1, 0.3
"""Weights of parameters that a controller can set (those of a transmission), and of dimensions that
are not zero: they are kept against others of as much as ten and three times their share.
"""


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
class IdentifiableSubset(HtmlResult):
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


def choose_identifiable_subset(identifiability: Identifiability) -> IdentifiableSubset:
    """Choose a minimal set of parameters for what measurements determine.

    The result has as many free parameters as the rank, and does not depend on the machine.

    Parameters
    ----------
    identifiability : as from `identifiability(robot, data)`.

    Returns
    -------
    IdentifiableSubset; its `robot` has the chosen parameters free and the others fixed at their
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
    places = _choose_fixed(free, null)
    kept = np.setdiff1d(np.arange(len(free)), places)
    B = null @ np.linalg.inv(null[places]) if len(places) else null
    dropped = tuple(_merge(free, int(place), B[:, i], kept) for i, place in enumerate(places))
    s = np.linalg.svd(identifiability.factor[:, kept], compute_uv=False)
    names = tuple(free.names[i] for i in kept)
    condition = float(s[0] / s[-1]) if len(s) else 1.0
    return IdentifiableSubset(names, dropped, condition, free_only(free.robot, names))


def _choose_fixed(free: FreeParameters, null: FloatArray) -> IntArray:
    """Return the places (d,) of the parameters to fix, in the order of the robot's file."""
    # of equal parameters the last one in the file is fixed
    return choose_pivots((null * _weights(free)[:, None]).T, first=False)


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
