# SPDX-License-Identifier: Apache-2.0
"""Rows of targets that are fixed to the base: monuments, by which an instrument finds its frame.

They depend on the frame of the instrument and on the places of the targets, and on no pose.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from loopcal.errors import DataError
from loopcal.findings import report_finding
from loopcal.measure.kinds import Kind
from loopcal.typing import IntArray

if TYPE_CHECKING:
    from loopcal.measure.observations import Observations


def check_bodies(of_poses: Sequence[Observations], of_base: Sequence[Observations]) -> None:
    """Refuse rows of the base among those of poses, the reverse, and a target on two bodies.

    Raises
    ------
    DataError
        Also `data.target-on-two-bodies`.
    """
    for rows in of_poses:
        if rows.kind.is_of_base:
            raise DataError(
                f"rows of kind {rows.kind.name!r} measure targets on the base; pass them as "
                "`base_observations`, not as `observations`"
            )
    for rows in of_base:
        if not rows.kind.is_of_base:
            raise DataError(
                f"rows of kind {rows.kind.name!r} measure poses; pass them as `observations`, or "
                'give their kind `of="base"`'
            )
    check_targets([rows.kind for rows in (*of_poses, *of_base)])


def check_targets(kinds: Sequence[Kind]) -> None:
    """Refuse kinds that have a target on the base and on a platform.

    Raises
    ------
    DataError
        `data.target-on-two-bodies`.
    """
    for kind in (kind for kind in kinds if kind.is_of_base):
        if shared := list_moving_targets(kind, kinds):
            raise DataError(report_finding("data.target-on-two-bodies", targets=shared))


def list_moving_targets(kind: Kind, others: Iterable[Kind]) -> tuple[str, ...]:
    """Return the targets of a kind of the base that are on a platform by another kind."""
    moving = {
        target
        for other in others
        if not other.is_of_base
        for target in getattr(other, "targets", ())
    }
    return tuple(target for target in kind.target_columns if target in moving)


def anchor_rows(rows: Observations, observations: Sequence[Observations]) -> IntArray:
    """Return a pose (r,) for each row of the base, on which its numbers do not depend.

    It is the first pose of the same session that another row needs, so that nothing is solved for
    its sake, and no session is joined with another; the first one of all where there is none.
    """
    first: dict[str, int] = {}
    needed: list[int] = []
    for other in observations:
        counted = (other.weight > 0.0) & other.is_measured
        poses = other.rows.reshape(len(other), other.kind.poses_per_row)[counted, 0].tolist()
        needed += poses[:1]
        for pose, session in zip(poses, other.session[counted].tolist(), strict=True):
            first.setdefault(session, pose)
    usual = needed[0] if needed else 0
    poses = [first.get(session, usual) for session in rows.session.tolist()]
    return np.array(poses, dtype=np.intp)
