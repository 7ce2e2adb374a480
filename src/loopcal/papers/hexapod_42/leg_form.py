# SPDX-License-Identifier: Apache-2.0
"""The six least-squares problems of the paper's section 3 at one machine: changes of leg length
against parameters.

The error model of a pose, twist = D dp + S dq (S by the readings), becomes S^-1 twist = S^-1 D dp =
G dp: rows of G belong to one leg each. Derivation: docs/theory/hexapod.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.mechanism import Mechanism, Solution, differentiate_pose
from loopcal.papers.hexapod_42.published import LEGS
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class LegForm:
    """The matrices at one machine.

    Attributes
    ----------
    G : (n, 6, p) change of each leg's length with the parameters. S : (n, 6, 6) twist by leg
        length. D : (n, 6, p) twist
    by parameters. own : for each leg, the positions of its parameters.
    """

    G: FloatArray
    S: FloatArray
    D: FloatArray
    own: tuple[np.ndarray, ...]

    @classmethod
    def at(cls, machine: Mechanism, at: Solution) -> LegForm:
        """Linearise a machine at poses."""
        found = differentiate_pose(machine, machine.values[None], at.q[None], at.state)
        names = machine.parameters.names
        own = tuple(np.flatnonzero([name.startswith(f"{leg}.") for name in names]) for leg in LEGS)
        S, D = found.readings[0], found.parameters[0]
        return cls(np.linalg.solve(S, D), S, D, own)

    def lengths(self, twists: FloatArray) -> FloatArray:
        """Changes of leg length (n, 6) [m] that twists (n, 6) mean."""
        return np.asarray(np.linalg.solve(self.S, twists[..., None])[..., 0], dtype=np.float64)

    def change(self, twists: FloatArray) -> FloatArray:
        """Change (p,) of the parameters that explains twists (n, 6) best, leg by leg, unweighted."""
        lengths, change = self.lengths(twists), np.zeros(self.G.shape[2])
        for leg, own in enumerate(self.own):
            change[own] = np.linalg.lstsq(self.G[:, leg, own], lengths[:, leg])[0]
        return change

    def explained(self, twists: FloatArray) -> FloatArray:
        """Share (6,) of each leg's norm of length changes that parameters could explain; 0 for
        residuals of least squares.
        """
        lengths, shares = self.lengths(twists), []
        for leg, own in enumerate(self.own):
            q, _ = np.linalg.qr(self.G[:, leg, own])
            shares.append(
                float(np.linalg.norm(q.T @ lengths[:, leg]) / np.linalg.norm(lengths[:, leg]))
            )
        return np.array(shares)
