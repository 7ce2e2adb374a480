# SPDX-License-Identifier: Apache-2.0
"""What every swap would gain, from one factor: a block of rows added, another taken away.

With Y = X R^-1 for a unit's rows X, G_kk = Y_k Y_k', U = Y_k Y_j' and W_k = (I + G_kk)^-1, adding
unit k and taking away unit j multiplies the determinant of the information by

    det(I + G_kk) det(S),    S = I - Y_j Y_j' + U' W_k U

and makes the trace |P|^2 of I and A, with V = Y P',

    |P|^2 - tr(W_k V_k V_k') + tr(S^-1 B B'),    B = V_j - U' W_k V_k

Adding first keeps both exact where the design without j is singular. The own unknowns' part of the
determinant, which D does not count, is the same formula in their columns alone, since R is
triangular with these first. Derivation: docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.planning.scoring import Scoring
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Seen:
    """Units seen through the factor of the present design.

    Attributes
    ----------
    Y : (N, r, Q). W : (N, r, r). added : (N,) log det(I + G_kk).
    own : the same in the own columns; None without any. V : (N, r, j) for I and A; None for D.
        trace : |P|^2.
    gram : (N, r, r) V V'; None for D.
    """

    Y: FloatArray
    W: FloatArray
    added: FloatArray
    own: Seen | None = None
    V: FloatArray | None = None
    gram: FloatArray | None = None
    trace: float = 0.0


def see(scoring: Scoring, R: FloatArray, ready: FloatArray) -> Seen:
    """Look at ready rows (N, r, Q) through a nonsingular factor R (Q, Q)."""
    Y = ready @ np.linalg.inv(R)
    if scoring.spread is None:
        return _seen(Y, scoring.own)
    P = scoring.spreading(R)
    V = Y[:, :, scoring.own :] @ P.T
    base = _seen(Y, 0)
    return Seen(Y, base.W, base.added, None, V, V @ V.swapaxes(1, 2), float((P**2).sum()))


def _seen(Y: FloatArray, own: int) -> Seen:
    """What D needs."""
    total = np.eye(Y.shape[1]) + Y @ Y.swapaxes(1, 2)
    added = np.asarray(np.linalg.slogdet(total)[1], dtype=np.float64)
    return Seen(
        Y,
        np.asarray(np.linalg.inv(total), dtype=np.float64),
        added,
        _seen(Y[:, :, :own], 0) if own else None,
    )


def additions(seen: Seen) -> FloatArray:
    """Return the change of score (N,) when a unit is added and none is taken away."""
    if seen.V is None or seen.gram is None:
        return seen.added - (seen.own.added if seen.own is not None else 0.0)
    left = seen.trace - (seen.W * seen.gram).sum(axis=(1, 2))
    return np.log(seen.trace) - np.log(np.maximum(left, np.finfo(np.float64).tiny))


def swaps(seen: Seen, Y: FloatArray, V: FloatArray | None = None) -> FloatArray:
    """Return the change of score (N,) when each unit comes in for the one of Y (r, Q), V (r, j),
    now in the design.

    -inf where the design would be singular.
    """
    U = seen.Y @ Y.T
    E = seen.W @ U
    S = np.eye(len(Y)) - Y @ Y.T + U.swapaxes(1, 2) @ E
    sign, logdet = np.linalg.slogdet(S)
    regular = sign > 0.0
    if V is None or seen.V is None or seen.gram is None:
        own = swaps(seen.own, Y[:, : seen.own.Y.shape[2]]) if seen.own is not None else 0.0
        return np.where(regular, seen.added + logdet - own, -np.inf)
    cross = E.swapaxes(1, 2) @ (seen.V @ V.T)
    product = V @ V.T - cross - cross.swapaxes(1, 2) + E.swapaxes(1, 2) @ seen.gram @ E
    S = np.where(regular[:, None, None], S, np.eye(len(Y)))
    back = np.trace(np.linalg.solve(S, product), axis1=1, axis2=2)
    left = seen.trace - (seen.W * seen.gram).sum(axis=(1, 2)) + back
    return np.where(
        regular & (left > 0.0),
        np.log(seen.trace) - np.log(np.where(left > 0.0, left, 1.0)),
        -np.inf,
    )
