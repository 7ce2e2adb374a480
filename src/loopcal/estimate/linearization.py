# SPDX-License-Identifier: Apache-2.0
"""The result of linearizing a problem at a deviation: everything that is known there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal.estimate.nuisance.elimination import EliminatedNuisance
from loopcal.estimate.poses.solution import PoseEstimates
from loopcal.estimate.start import Start
from loopcal.typing import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Linearization:
    """A problem of t trials at deviations z, nuisance parameters and poses eliminated.

    Attributes
    ----------
    deviation : (t, p) z.
    factor : (t, p + 1, p + 1) triangular factor of the whitened rows [A | r] that are left.
    cost : (t,) sum of squares; infinite where a needed pose is not reached.
    equations : (t,) number of equations, less the directions of nuisance parameters and poses that
        the rows determine.
    next_start : warm start for a linearization nearby.
    nuisance : estimate of the nuisance parameters; None without any.
    poses : estimates of the poses; None where readings are exact.
    """

    deviation: FloatArray
    factor: FloatArray
    cost: FloatArray
    equations: IntArray
    next_start: Start
    nuisance: EliminatedNuisance | None = None
    poses: PoseEstimates | None = None

    def take(self, trials: IntArray) -> Linearization:
        """Return some trials."""
        return Linearization(
            self.deviation[trials],
            self.factor[trials],
            self.cost[trials],
            self.equations[trials],
            self.next_start.take(trials),
            self.nuisance and self.nuisance.take(trials),
            self.poses and self.poses.take(trials),
        )

    @staticmethod
    def join(parts: Sequence[Linearization]) -> Linearization:
        """Return the trials of all parts, one after the other."""
        if len(parts) == 1:
            return parts[0]
        nuisance = [part.nuisance for part in parts if part.nuisance is not None]
        poses = [part.poses for part in parts if part.poses is not None]
        return Linearization(
            np.concatenate([part.deviation for part in parts]),
            np.concatenate([part.factor for part in parts]),
            np.concatenate([part.cost for part in parts]),
            np.concatenate([part.equations for part in parts]),
            Start.join([part.next_start for part in parts]),
            EliminatedNuisance.join(nuisance) if nuisance else None,
            PoseEstimates.join(poses) if poses else None,
        )


class LeverageRows(NamedTuple):
    """Whitened rows by everything that they determine, poses eliminated.

    Attributes
    ----------
    poses : (k,) first pose of each set of rows.
    rows : (k, m, U + p + 1). The first U columns, none without nuisance parameters, are in units of
        the standard deviations of these; the next p are those of the machine as the nuisance
        parameters follow it; the last are residuals.
    kind : number of the kind; -1 where they are of several. numbers : (k,) rows of the kind.
    """

    poses: IntArray
    rows: FloatArray
    kind: int
    numbers: IntArray
