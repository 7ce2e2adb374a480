# SPDX-License-Identifier: Apache-2.0
"""What a fit found of the unknowns that measurements bring with them: frames, targets, surfaces,
offsets.

Given the machine's deviation z, the best own unknowns are b = b0 + S (z - z0) with the covariance
(F'F)^+ of their own; z has the covariance C of the fit, so that b has (F'F)^+ + S C S'. A direction
of infinite variance that moves b makes it infinite, too: a frame is then known only together with
the machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.estimate.inference.null_space import Combination, listed, sparsify_basis
from loopcal.estimate.local import Own
from loopcal.mechanism import Mechanism
from loopcal.numerics.decomposition import Decomposition
from loopcal.parameters import Parameter, ParameterTable
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import DISPLAY_UNITS, find_unit

MOVES = 1e-7
"""Share of all that the machine does to an unknown below which a direction does not move it:
rounding.
"""


@dataclass(frozen=True, eq=False)
class LocalEstimate:
    """Own unknowns of the measurements after a fit; arrays (U,) in the order of `table`, SI.

    Attributes
    ----------
    table : nominal values, priors, and which were kept fixed. start : values with which the fit
        began.
    estimate : (U,). sd : standard deviations, infinite where the data cannot tell, 0 where fixed,
        NaN without an interval.
    slope : (U, p) change of the best values by the machine's deviations in tolerances.
    open : (U,) which have a part in a direction that no row sees, whatever the machine.
    display : factor to SI and symbol of the unit in which each is shown.
    """

    table: ParameterTable
    start: FloatArray
    estimate: FloatArray
    sd: FloatArray
    slope: FloatArray
    open: BoolArray
    display: tuple[tuple[float, str], ...]

    def __len__(self) -> int:
        return len(self.table)

    @property
    def names(self) -> tuple[str, ...]:
        """Names, such as `tracker.x`."""
        return self.table.names

    @property
    def values(self) -> Mapping[str, float]:
        """Estimates by name [SI]."""
        return dict(zip(self.names, self.estimate.tolist(), strict=True))

    @property
    def starts(self) -> Mapping[str, float]:
        """Values by name [SI] that fit the machine with which the fit began."""
        return dict(zip(self.names, self.start.tolist(), strict=True))

    def rows(self, coverage: float) -> list[dict[str, Any]]:
        """Return one entry for each, in its unit, ready for JSON; coverage is the number of sd in
        `plus_minus`.
        """
        shown = []
        for i, entry in enumerate(self.table.entries):
            factor, symbol = self.display[i]
            numbers = {
                "nominal": entry.nominal,
                "estimate": self.estimate[i],
                "sd": self.sd[i],
                "plus_minus": coverage * self.sd[i],
            }
            tolerance = None if entry.tolerance is None else entry.tolerance / factor
            scaled = {name: float(value) / factor for name, value in numbers.items()}
            shown.append(
                {
                    "name": entry.name,
                    "unit": symbol,
                    **scaled,
                    "tolerance": tolerance,
                    "free": entry.free,
                }
            )
        return shown

    def notes(self) -> list[str]:
        """Say which unknowns the rows do not tell, whatever the machine: alone, or one only
        together with another.
        """
        names = list(
            dict.fromkeys(
                n.rsplit(".", 1)[0]
                for n, unseen in zip(self.names, self.open, strict=True)
                if unseen
            )
        )
        if not names:
            return []
        return [
            (
                "not identifiable, whatever the robot: "
                f"{listed(names)}{', or only together' if len(names) > 1 else ''}"
            )
        ]


def nothing_local(parameters: int) -> LocalEstimate:
    """Return the estimate of no unknowns at all."""
    nothing = np.zeros(0)
    return LocalEstimate(
        ParameterTable(()),
        nothing,
        nothing,
        nothing,
        np.zeros((0, parameters)),
        np.zeros(0, dtype=bool),
        (),
    )


def local_estimate(
    own: Own,
    robot: Mechanism,
    start: FloatArray,
    decomposition: Decomposition,
    penalty: FloatArray,
    noise: float,
    trial: int = 0,
    place: int = 0,
) -> LocalEstimate:
    """Return what the last fold says of the own unknowns of one trial.

    Parameters
    ----------
    own : after a fold at the estimate. robot : for its units. start : (U,) values with which the
        fit began.
    decomposition, penalty : of the fit (t = 1). noise : variance of the whitened rows; NaN where no
        interval is given.
    trial : which one. place : where it stood in that fold.
    """
    table = own.local.table
    estimate, variance = own.values[trial].copy(), np.zeros(len(table))
    slope, unseen = np.zeros((len(table), own.slope.shape[2])), np.zeros(len(table), dtype=bool)
    known = decomposition.variances(penalty, noise)[0]
    V = decomposition.scale[:, None] * decomposition.directions[0]
    if (done := own.solved) is not None:
        free = own.free
        estimate += done.shift[place]
        slope, unseen = done.slope[place], done.open[place]
        moved = slope[free] @ V
        infinite = np.linalg.norm(moved[:, np.isinf(known)], axis=1) > MOVES * np.linalg.norm(
            moved, axis=1
        )
        by_machine = (moved**2) @ np.where(np.isinf(known), 0.0, known)
        alone = done.variance()[place, free] * noise
        variance[free] = np.where(infinite | unseen[free], np.inf, alone + by_machine)
    shown = tuple(_shown(robot, p) for p in table.entries)
    return LocalEstimate(table, start, estimate, np.sqrt(variance), slope, unseen, shown)


def with_followers(
    found: tuple[Combination, ...], null: FloatArray, local: LocalEstimate
) -> tuple[Combination, ...]:
    """Add to combinations, those of the null space (p, d), the frames and targets that change with
    them.

    The combinations must be those of `combinations(free, null)`.
    """
    if not len(local) or not found:
        return found
    changed = np.abs(sparsify_basis(null) @ local.slope.T)
    limit = MOVES * np.abs(local.slope).max(axis=1, initial=0.0)
    told = []
    for one, moved in zip(found, changed > limit, strict=True):
        names = list(
            dict.fromkeys(n.rsplit(".", 1)[0] for n, m in zip(local.names, moved, strict=True) if m)
        )
        follows = (
            f"{listed(names)} {'moves' if len(names) == 1 else 'move'} with it" if names else ""
        )
        told.append(
            replace(one, meaning=", and ".join(part for part in (one.meaning, follows) if part))
        )
    return tuple(told)


def _shown(robot: Mechanism, entry: Parameter) -> tuple[float, str]:
    symbol = robot.units.get(entry.dimension, DISPLAY_UNITS[entry.dimension].symbol)
    return find_unit(symbol).factor_to_si, symbol
