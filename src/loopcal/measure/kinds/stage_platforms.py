# SPDX-License-Identifier: Apache-2.0
"""Rows that measure another body than the end platform: that of a stage of a chain, or the base.

The pose of the end platform does not determine that of a stage. A kind `of` a stage senses the
numbers [R t] of its platform as others sense the values of joints. Derivation:
docs/theory/stages.md. The base does not move: a kind `of` the base depends on no pose.
"""

from __future__ import annotations

import numpy as np

from loopcal import geometry, mechanism
from loopcal.errors import DataError
from loopcal.measure.kinds.rows import Evaluation
from loopcal.typing import FloatArray

BASE = "base"
"""Name of the base among the bodies that a kind may be `of`; no stage has it."""


def check_stage(kind: str, of: str, poses_per_row: int, measures_points: bool) -> None:
    """Refuse a stage of a kind that compares poses, and the base of one that measures no points.

    Raises
    ------
    DataError
    """
    if of and poses_per_row > 1:
        raise DataError(
            f"the kind {kind!r} compares poses of the end platform; leave out `of: {of}`"
        )
    if of == BASE and not measures_points:
        raise DataError(
            f"the kind {kind!r} measures a moving body, but `of: {BASE}` is for targets that are "
            "fixed to the base; leave it out, or use the kind position, bearing or distance"
        )


def list_sensed_numbers(of: str) -> tuple[str, ...]:
    """Return the names of the numbers of the platform of a stage; none without a stage, or of the
    base.
    """
    return mechanism.name_platform_entries(of) if of not in ("", BASE) else ()


def find_platform(of: str, T: FloatArray, joints: FloatArray) -> FloatArray:
    """Return the measured platforms (.., 4, 4): T, those of the stage `of`, or the base.

    joints : (.., 12) of a stage.

    Raises
    ------
    DataError
        The numbers of the stage's platform are missing.
    """
    if not of:
        return T
    if of == BASE:
        return np.broadcast_to(np.eye(4), T.shape)
    if joints.shape[-1] != 12:
        raise DataError(f"the platform of stage {of!r} is not given; pass its numbers as `joints`")
    rows = joints.reshape(*joints.shape[:-1], 3, 4)
    last = np.broadcast_to(np.eye(4)[3:], (*rows.shape[:-2], 1, 4))
    return np.concatenate([rows, last], axis=-2)


def depend_on_platform(of: str, result: Evaluation, T: FloatArray) -> Evaluation:
    """Return an evaluation at platforms T (t, r, 4, 4), of a stage by the numbers of its platform.

    Its rows do not depend on the twist of the end platform, those of the base on no motion.
    """
    if not of:
        return result
    if of == BASE:
        return result._replace(jacobian=np.zeros_like(result.jacobian))
    by_entries = result.jacobian @ geometry.differentiate_by_entries(T)
    return result._replace(jacobian=np.zeros_like(result.jacobian), joints=by_entries)
