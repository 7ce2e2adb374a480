# SPDX-License-Identifier: Apache-2.0
"""Errors of every kind of measurement in units of its sigma: what can be compared between kinds,
and summed over them.

The root mean square of W r over all components that were measured, r the residuals and W the
inverse Cholesky factor of their covariance: 1 where the geometry explains everything but the noise.
Millimetres of a touch probe and of a calliper added as they are would be judged by the calliper
alone, and a fit that follows the better instrument would seem to be worse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.diagnose.pose_error_figures import PoseErrors
from loopcal.measure import Observations
from loopcal.typing import FloatArray

FEW = 5
"""Rows below which an error is said to be judged by too few: at 4 the rms of noise alone varies by
a third.
"""


@dataclass(frozen=True)
class KindErrors:
    """Errors of one kind, or of all.

    Attributes
    ----------
    kind : its name; "all" for all kinds. count : components measured, over all its rows.
    before, after : root mean square of the whitened residuals [sigma].
    """

    kind: str
    count: int
    before: float
    after: float

    @property
    def improvement(self) -> float:
        """How many times smaller the error became."""
        return self.before / self.after if self.after > 0.0 else np.inf


def kind_errors(
    rows: Sequence[Observations], before: list[FloatArray], after: list[FloatArray]
) -> tuple[KindErrors, ...]:
    """Return the errors of each kind, and after them of all kinds.

    Parameters
    ----------
    rows : of every kind. before, after : residuals (r, m) [SI] of each.
    """
    names = list(dict.fromkeys(o.kind.name for o in rows))
    count = dict.fromkeys(names, 0)
    square = {name: np.zeros(2) for name in names}
    for o, *residuals in zip(rows, before, after, strict=True):
        count[o.kind.name] += int(o.present.sum())
        square[o.kind.name] += [_square(o, residual) for residual in residuals]
    groups = [*((name, [name]) for name in names), ("all", names)]
    found = []
    for name, parts in groups:
        n = sum(count[part] for part in parts)
        first, last = (
            np.sqrt(np.sum([square[part] for part in parts], axis=0) / n) if n else (np.nan, np.nan)
        )
        found.append(KindErrors(name, n, float(first), float(last)))
    return tuple(found)


def few(after: PoseErrors) -> tuple[str, ...]:
    """Say which errors too few rows measure to judge them by."""
    counts = {index: after.statistics(index).count for index in ("position", "orientation")}
    rows = {
        index: f"only {n} row{' measures' if n == 1 else 's measure'} {index}"
        for index, n in counts.items()
    }
    return tuple(
        f"{rows[index]}: too few to judge its errors by"
        for index, n in counts.items()
        if 0 < n < FEW
    )


def _square(o: Observations, residual: FloatArray) -> float:
    """Sum of squares of the whitened residuals (r, m) that are there."""
    there = np.where(o.present, residual, 0.0)
    return float(((o.whitener @ there[..., None]) ** 2).sum())
