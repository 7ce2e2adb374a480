# SPDX-License-Identifier: Apache-2.0
"""Errors after the alignment that the data leave open: a frame in front, a frame behind, or both.

Measurements in an unknown frame say nothing of where the base is, those of an unknown tool nothing
of where on the platform it sits. Errors of such an identification are compared after the best fit
of these frames, and it is said which.
"""

from dataclasses import dataclass

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.geometry.alignment import align_point_sets, solve_hand_eye, solve_least_squares
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Alignment:
    """Frames that bring poses nearest to others: `T_base T T_tool`.

    Attributes
    ----------
    T_base : (4, 4), T_tool : (4, 4)
        The identity where the data leave nothing open.
    sentence : str
        What was aligned, for tables and reports.
    """

    T_base: FloatArray
    T_tool: FloatArray
    sentence: str

    def __call__(self, T: FloatArray) -> FloatArray:
        """Poses (n, 4, 4), aligned."""
        return self.T_base @ T @ self.T_tool

    def errors(self, T: FloatArray, reference: FloatArray) -> FloatArray:
        """Twists (n, 6) from reference poses to aligned ones [rad, m], rotation first."""
        return geometry.pose_difference(self(T), reference)


SENTENCES = {
    (False, False): "errors without any alignment",
    (True, False): "errors after the best fit of the base frame, which the data leave open",
    (False, True): "errors after the best fit of the tool frame, which the data leave open",
    (True, True): "errors after the best fit of base and tool frames, which the data leave open",
}


def align(
    T: FloatArray, reference: FloatArray, *, base: bool, tool: bool, size: float
) -> Alignment:
    """Frames that bring poses nearest to reference poses.

    Minimises `sum |log(R R_reference')|^2 size^2 + |t - t_reference|^2`, from a closed form by
    Gauss-Newton.

    Parameters
    ----------
    T, reference : (n, 4, 4)
    base, tool : bool
        Which frames the data leave open.
    size : float [m]
        What an angle is multiplied by to compare with lengths, such as `Mechanism.size`.

    Returns
    -------
    alignment : Alignment

    Raises
    ------
    DataError
        If shapes differ or there are too few poses for the frames.
    """
    if T.shape != reference.shape or T.ndim != 3:
        raise DataError(
            f"poses of shapes {T.shape} and {reference.shape} cannot be aligned; give (n, 4, 4) "
            "twice"
        )
    if len(T) < 1 + base + tool:
        raise DataError(
            f"{len(T)} poses are too few to align {base + tool} frames; give at least "
            f"{1 + base + tool}"
        )
    one = np.eye(4)
    if not base and not tool:
        return Alignment(one, one, SENTENCES[base, tool])
    # base T tool = reference, so base seen = reference tool^-1
    found = solve_hand_eye(reference, T, None if base else one, None if tool else one)
    frames = np.stack([found[0] if base else one, geometry.invert_pose(found[1]) if tool else one])
    open_ = np.repeat([base, tool], 6)
    weight = np.array([size, size, size, 1.0, 1.0, 1.0])
    for _ in range(20):
        error, slopes = _slopes(frames, T, reference)
        J = (weight[:, None] * slopes[..., open_]).reshape(-1, int(open_.sum()))
        step = np.zeros(12)
        step[open_] = -solve_least_squares(J, (weight * error).ravel())
        frames = geometry.apply_twist(frames, step.reshape(2, 6))
        if np.abs(step).max() < 1e-14:
            break
    return Alignment(frames[0], frames[1], SENTENCES[base, tool])


def align_points(points: FloatArray, reference: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Frame (4, 4) that brings points (n, 3) nearest to reference points, and what is left (n, 3)
    [m].

    Raises
    ------
    DataError
        If there are fewer than three points, or all lie on a line, so that a turn about it stays
        open.
    """
    if len(points) < 3 or np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] < 1e-9:
        raise DataError(
            f"{len(points)} points on a line do not fix a frame; give three points that form a "
            "triangle"
        )
    T = align_point_sets(points, reference)
    return T, points @ T[:3, :3].T + T[:3, 3] - reference


def _slopes(
    frames: FloatArray, T: FloatArray, reference: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Twists (n, 6) from reference to aligned poses, and their derivative (n, 6, 12) by the twists
    of both frames.
    """
    base, tool = frames
    moved = base @ T @ tool
    error = geometry.pose_difference(moved, reference)
    inverse = geometry.left_jacobian_inverse_so3(error[:, :3])
    front = geometry.transport_matrix(moved[:, :3, 3] - base[:3, 3])
    R = base[:3, :3] @ T[:, :3, :3]
    back = geometry.transport_matrix(np.zeros(3), R)
    both = np.concatenate([front, back], axis=-1)
    return error, np.concatenate([inverse @ both[:, :3], both[:, 3:]], axis=1)
