# SPDX-License-Identifier: Apache-2.0
"""The result of linearizing a problem at a deviation, and the warm start of the next linearization.

A start belongs to the deviations at which it was made. It predicts nuisance parameters at other
deviations to first order; poses begin where they were, which costs one Newton step more than their
prediction and none of the products with all parameters. It only chooses where iterations begin:
their results do not depend on it beyond rounding, as long as it is near.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from loopcal import engine
from loopcal.estimate.elimination import EliminatedNuisance
from loopcal.estimate.pose_linearization import PoseEstimates, PoseStates
from loopcal.numerics.trial_batch import TrialBatch
from loopcal.typing import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Start(TrialBatch):
    """Warm start of t trials.

    Attributes
    ----------
    deviation : (t, p) where it was made.
    nuisance : (t, U) values of the nuisance parameters [SI]. slope : (t, U, p) their change.
    first_nuisance : (t, U) values with which the first linearization began.
    poses : states (t, n) of all poses; None where every solution begins at home.
    is_near : whether a linearization solved these poses, so that those at the next deviations are
        near and Newton's method need not follow a path to them.
    """

    deviation: FloatArray
    nuisance: FloatArray
    slope: FloatArray
    first_nuisance: FloatArray
    poses: PoseStates | None = None
    is_near: bool = False

    def __len__(self) -> int:
        return len(self.deviation)

    def predict_nuisance(self, deviation: FloatArray) -> FloatArray:
        """Return the nuisance parameters (t, U) at deviations (t, p), to first order."""
        change = deviation - self.deviation
        return self.nuisance + np.matmul(self.slope, change[..., None])[..., 0]

    @property
    def states(self) -> engine.State | None:
        """States (t, n) with which poses begin; None to begin at home."""
        return self.poses and self.poses.state

    def with_nuisance(self, values: FloatArray) -> Start:
        """Return this start with other nuisance parameters (t, U), which do not move."""
        values = np.broadcast_to(values, self.nuisance.shape)
        return replace(
            self, nuisance=values, first_nuisance=values, slope=np.zeros_like(self.slope)
        )


@dataclass(frozen=True, eq=False)
class Linearization(TrialBatch):
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
