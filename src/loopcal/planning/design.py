# SPDX-License-Identifier: Apache-2.0
"""What every design is made of: what is known before, and which directions can be known at all.

Rows [F | A] have the unknowns of the instruments (F, to be eliminated) before those of the machine
(A). Directions of the machine that no candidate can tell from the instruments' unknowns are left
out once, by a stated tolerance, for all designs alike. See docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import EstimationError
from loopcal.numerics.decomposition import RANK_TOLERANCE
from loopcal.typing import BoolArray, FloatArray, IntArray

OWN_TOLERANCE = 1e-10
"""Share of the largest singular value (columns of length one) below which a direction of the own
unknowns is none.
"""


@dataclass(frozen=True, eq=False)
class Start:
    """What is known before the first new pose.

    Attributes
    ----------
    rows : (k, o + p) whitened and tolerance-scaled: rows already measured, or identity rows for
        tolerances. own : o.
    """

    rows: FloatArray
    own: int = 0

    @classmethod
    def nothing(cls, machine: int, own: int = 0) -> Start:
        """Know nothing of p machine unknowns and o own ones."""
        return cls(np.zeros((0, own + machine)), own)

    @classmethod
    def tolerances(cls, machine: int, own: int = 0) -> Start:
        """Know each machine unknown to its tolerance (variance 1), and nothing of the own ones."""
        return cls(np.eye(own + machine)[own:], own)

    @property
    def machine(self) -> int:
        """Number p of machine unknowns."""
        return self.rows.shape[1] - self.own

    def plus(self, rows: ArrayLike) -> Start:
        """Return this with more rows (..., o + p): poses measured already, or tolerances of own
        unknowns.
        """
        more = np.asarray(rows, dtype=np.float64).reshape(-1, self.rows.shape[1])
        return Start(triangle(np.concatenate([self.rows, more])), self.own)


@dataclass(frozen=True, eq=False)
class Directions:
    """Which directions a set of rows can know: the space in which designs are compared.

    Attributes
    ----------
    machine : (p, q) orthonormal, of the machine's unknowns. own : (o, o') of the own unknowns.
    singular_values : (p,) of the machine's columns with the own ones eliminated, descending.
    own_singular_values : (o,) of the own columns scaled to length one. tolerance : relative, of the
        machine's.
    """

    machine: FloatArray
    own: FloatArray
    singular_values: FloatArray
    own_singular_values: FloatArray
    tolerance: float

    def __len__(self) -> int:
        return self.machine.shape[1]

    @property
    def unknowns(self) -> int:
        """Own and machine directions together."""
        return self.own.shape[1] + self.machine.shape[1]

    def reduce(self, rows: FloatArray) -> FloatArray:
        """Return rows (..., o + p) in these directions, (..., o' + q), own ones first."""
        o = len(self.own)
        return np.concatenate([rows[..., :o] @ self.own, rows[..., o:] @ self.machine], axis=-1)


@dataclass(frozen=True, eq=False)
class Design:
    """A chosen set of units.

    Attributes
    ----------
    chosen : (n,) numbers of the candidates, ascending.
    value : of the criterion. history : its values, start by start and exchange by exchange of the
        best start.
    values : of each start at its end. directions : the space in which it is counted.
    """

    chosen: IntArray
    value: float
    history: tuple[float, ...]
    values: tuple[float, ...]
    directions: Directions


def triangle(rows: FloatArray) -> FloatArray:
    """Return the triangular factor R of rows (m, c), at most (c, c): R'R is the rows' information."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


def allowed(rows: FloatArray) -> BoolArray:
    """Tell which units (N,) of rows (N, r, c) have no NaN."""
    return np.asarray(np.isfinite(rows).all(axis=(1, 2)))


def directions(rows: FloatArray, start: Start, tolerance: float = RANK_TOLERANCE) -> Directions:
    """Return what all units together and the start can tell: rows (N, r, o + p), NaN where not
    allowed.

    Columns of own unknowns are scaled to length one and cut by singular values at OWN_TOLERANCE;
    what remains of the machine's columns beside them is cut at `tolerance` times its largest
    singular value.
    """
    good = rows[allowed(rows)].reshape(-1, rows.shape[-1])
    o = start.own
    R = triangle(np.concatenate([start.rows, good]))
    R = np.concatenate([R, np.zeros((max(R.shape[1] - len(R), 0), R.shape[1]))])
    own, own_s, rest = np.zeros((0, 0)), np.zeros(0), R
    if o:
        norm = np.linalg.norm(R[:o, :o], axis=0)
        scale = np.where(norm > 0.0, norm, 1.0)
        u, own_s, vt = np.linalg.svd(R[:o, :o] / scale)
        known = own_s > OWN_TOLERANCE * max(own_s[0], 1.0)
        own = vt[known].T / scale[:, None]
        rest = np.concatenate([(u.T @ R[:o, o:])[~known], R[o:, o:]])
    _, s, vt = np.linalg.svd(rest if o else R)
    used = s > tolerance * (s[0] if s.size else 0.0)
    return Directions(vt[: len(s)][used].T, own, s, own_s, tolerance)


def design_factor(rows: FloatArray, start: Start, space: Directions) -> FloatArray:
    """Return the factor (q, q) of the machine's directions of a design: rows (n, r, o + p) and
    start, own ones eliminated.
    """
    stacked = np.concatenate([start.rows, rows.reshape(-1, rows.shape[-1])])
    R = triangle(space.reduce(stacked))
    R = np.concatenate([R, np.zeros((max(R.shape[1] - len(R), 0), R.shape[1]))])
    o = space.own.shape[1]
    return R[o:, o:]


def require_enough(
    n: int, rows: FloatArray, start: Start, space: Directions, repeats: bool = True
) -> None:
    """Refuse a number of units that cannot determine all directions.

    Raises
    ------
    EstimationError
        Nothing is allowed, nothing can be known, n units have fewer rows than there are unknowns
        left open, or fewer units are allowed than asked for, none being repeated.
    """
    count = int(allowed(rows).sum())
    if count == 0:
        raise EstimationError(
            f"none of the {len(rows)} candidates is allowed; relax a constraint or widen the "
            "workspace"
        )
    if len(space) == 0:
        raise EstimationError(
            "the candidates' rows depend on no parameter that is free; choose another kind of "
            "measurement"
        )
    if n > count and not repeats:
        raise EstimationError(
            f"{n} poses were asked for and {count} candidates are allowed; make more candidates or "
            "ask for fewer"
        )
    needed = fewest(rows.shape[1], start, space)
    if n < needed:
        open_ = space.unknowns - _known(start, space)
        raise EstimationError(
            f"{n} poses were asked for, which give {n * rows.shape[1]} equations for {open_} "
            "unknowns;"
            f" ask for at least {needed} or state tolerances as prior knowledge"
        )


def fewest(equations: int, start: Start, space: Directions) -> int:
    """Return the least number of units, of so many equations each, that can determine what the
    start leaves open.
    """
    return max(-(-(space.unknowns - _known(start, space)) // equations), 1)


def _known(start: Start, space: Directions) -> int:
    """Number of directions, own and machine together, that the start knows."""
    if not start.rows.any():
        return 0
    s = np.linalg.svd(space.reduce(start.rows), compute_uv=False)
    return int((s > RANK_TOLERANCE * s[0]).sum())
