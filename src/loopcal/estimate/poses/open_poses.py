# SPDX-License-Identifier: Apache-2.0
"""Poses that do not close at a robot's values: which, and by how much."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loopcal.findings import Finding, Quantity, report_finding
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism, forward
from loopcal.typing import FloatArray

MOST = 0.5
"""Share of open poses above which a geometry is not one to begin with."""

MM = 1e3


class OpenPoses(NamedTuple):
    """Poses at which the loops do not close with their readings.

    Attributes
    ----------
    poses : their labels, the widest open first. gaps : (k,) [m] what is left open in the loops.
    total : number of poses with all readings.
    """

    poses: tuple[str, ...]
    gaps: FloatArray
    total: int

    @property
    def are_most(self) -> bool:
        """Whether more than a share `MOST` of the poses is open."""
        return len(self.poses) > MOST * self.total

    def report(self, code: str) -> Finding:
        """Return the finding or error of this code, with poses and gaps."""
        return report_finding(
            code,
            count=len(self.poses),
            total=self.total,
            poses=self.poses,
            gaps=tuple(Quantity(float(gap) * MM, "mm") for gap in self.gaps),
        )


def find_open_poses(robot: Mechanism, data: Measurements) -> OpenPoses:
    """Return the poses of measurements whose redundant readings do not close the loops of a robot.

    Poses with a missing reading are not tested, and robots with as many actuators as freedoms have
    none: a pose that they do not reach is refused by `check_start`.
    """
    if robot.program.sigma is None:
        return OpenPoses((), np.zeros(0), data.n_poses)
    used = np.flatnonzero(np.isfinite(data.readings).all(axis=1))
    if not len(used):
        return OpenPoses((), np.zeros(0), 0)
    solution = forward(robot, data.readings[used])
    is_open = np.flatnonzero(~solution.converged)
    gaps = solution.residual[is_open]
    order = np.argsort(-np.where(np.isfinite(gaps), gaps, np.inf), kind="stable")
    labels = tuple(data.labels[i] for i in used[is_open[order]])
    return OpenPoses(labels, gaps[order], len(used))
