# SPDX-License-Identifier: Apache-2.0
"""The result of solving for the poses and the nuisance parameters at given parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.estimate.poses.linearization import LinearizedPoses
from loopcal.estimate.poses.states import PoseStates
from loopcal.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class PoseEstimates:
    """Poses of t trials that are unknown because readings are uncertain, where all rows fit best.

    Attributes
    ----------
    states : (t, n) closed poses and true readings. is_reached : (t, n).
    rank : (t, components) coordinates of poses that rows determine.
    is_undetermined : (t, n) poses with a coordinate that no row determines; they stay where the
        search began.
    is_converged : (t,).
    """

    states: PoseStates
    is_reached: BoolArray
    rank: IntArray
    is_undetermined: BoolArray
    is_converged: BoolArray

    def take(self, trials: IntArray) -> PoseEstimates:
        """Return some trials."""
        return PoseEstimates(
            self.states.take(trials),
            self.is_reached[trials],
            self.rank[trials],
            self.is_undetermined[trials],
            self.is_converged[trials],
        )

    @staticmethod
    def join(parts: Sequence[PoseEstimates]) -> PoseEstimates:
        """Return the trials of all parts, one after the other."""
        if len(parts) == 1:
            return parts[0]
        names = ("is_reached", "rank", "is_undetermined", "is_converged")
        return PoseEstimates(
            PoseStates.join([part.states for part in parts], 0),
            *(np.concatenate([getattr(part, name) for part in parts]) for name in names),
        )


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """Poses and nuisance parameters of a trials at given deviations.

    Attributes
    ----------
    nuisance : (a, U) values that fit best, or as given; None without any.
    linearized : the poses of the only block; None where there are several, which are solved again
        block by block.
    states : (a, n) of the only block, for the next start; None as above.
    estimates : of uncertain poses; None where readings are exact.
    """

    nuisance: FloatArray | None
    linearized: LinearizedPoses | None = None
    states: PoseStates | None = None
    estimates: PoseEstimates | None = None
