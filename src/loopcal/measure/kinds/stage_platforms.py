# SPDX-License-Identifier: Apache-2.0
"""Rows that measure the platform of a stage of a chain, by the twelve numbers of its pose.

The pose of the end platform does not determine that of a stage. A kind `of` a stage senses the
numbers [R t] of its platform as others sense the values of joints. Derivation:
docs/theory/stages.md.
"""

from __future__ import annotations

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.kinds.rows import Evaluation
from loopcal.mechanism import name_platform_entries
from loopcal.typing import FloatArray


def check_stage(kind: str, of: str, poses_per_row: int) -> None:
    """Refuse a stage of a kind that compares poses; raises DataError."""
    if of and poses_per_row > 1:
        raise DataError(
            f"the kind {kind!r} compares poses of the end platform; leave out `of: {of}`"
        )


def list_sensed_numbers(of: str) -> tuple[str, ...]:
    """Return the names of the numbers of the platform of a stage; none without a stage."""
    return name_platform_entries(of) if of else ()


def find_platform(of: str, T: FloatArray, joints: FloatArray) -> FloatArray:
    """Return the measured platforms (.., 4, 4): T, or those of the stage `of`.

    joints : (.., 12) of a stage.

    Raises
    ------
    DataError
        The numbers of the stage's platform are missing.
    """
    if not of:
        return T
    if joints.shape[-1] != 12:
        raise DataError(f"the platform of stage {of!r} is not given; pass its numbers as `joints`")
    rows = joints.reshape(*joints.shape[:-1], 3, 4)
    last = np.broadcast_to(np.eye(4)[3:], (*rows.shape[:-2], 1, 4))
    return np.concatenate([rows, last], axis=-2)


def depend_on_platform(of: str, result: Evaluation, T: FloatArray) -> Evaluation:
    """Return an evaluation at platforms T (t, r, 4, 4), of a stage by the numbers of its platform.

    Its rows do not depend on the twist of the end platform.
    """
    if not of:
        return result
    by_entries = result.jacobian @ geometry.differentiate_by_entries(T)
    return result._replace(jacobian=np.zeros_like(result.jacobian), joints=by_entries)
