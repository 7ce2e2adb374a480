# SPDX-License-Identifier: Apache-2.0
"""Forms of orientation in columns: rotation vector, quaternion, tilt and torsion, Euler angles.

Each form converts both ways and gives `rates`, the matrix E by which errors of its columns become a
rotation error, `omega = E d(columns)`. The noise of a rotation vector or a quaternion is stated as
a rotation error about the axes of the frame, so E is the identity there.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from loopcal.errors import DataError
from loopcal.geometry import euler_angles, rotations
from loopcal.typing import FloatArray
from loopcal.units import Dimension

Conversion = Callable[[FloatArray], FloatArray]


def _repeat_identity(values: FloatArray) -> FloatArray:
    return np.broadcast_to(np.eye(3), (*values.shape[:-1], 3, 3))


@dataclass(frozen=True)
class OrientationForm:
    """A form in which a rotation is written; the name decides all else.

    Attributes
    ----------
    name : its name in files, e.g. "euler-xyz".
    columns : names of its c columns. noise_columns : names of the three noises.
    dimension : of the columns.
    to_matrix : columns (..., c) to rotations (..., 3, 3). from_matrix : the inverse.
    rates : columns to E (..., 3, 3). rates_inverse : columns to E^-1, huge where E is singular.
    angles : whether the columns are three angles, of which any may be measured alone.
    """

    name: str
    columns: tuple[str, ...] = field(compare=False)
    noise_columns: tuple[str, str, str] = field(compare=False)
    dimension: Dimension = field(compare=False)
    to_matrix: Conversion = field(compare=False, repr=False)
    from_matrix: Conversion = field(compare=False, repr=False)
    rates: Conversion = field(default=_repeat_identity, compare=False, repr=False)
    rates_inverse: Conversion = field(default=_repeat_identity, compare=False, repr=False)
    angles: bool = field(default=False, compare=False)


def _split(convert: Callable[..., FloatArray], values: FloatArray) -> FloatArray:
    """Convert azimuth, tilt and torsion (..., 3) by a function of the three."""
    return convert(values[..., 0], values[..., 1], values[..., 2])


def _stack_tilt_torsion(rotation: FloatArray) -> FloatArray:
    """Return azimuth, tilt and torsion (..., 3) [rad] of rotations."""
    return np.stack(euler_angles.matrix_to_tilt_torsion(rotation), axis=-1)


_SIMPLE = {
    form.name: form
    for form in (
        OrientationForm(
            "rotation-vector",
            ("rx", "ry", "rz"),
            ("rx", "ry", "rz"),
            Dimension.ANGLE,
            rotations.exp_so3,
            rotations.log_so3,
        ),
        OrientationForm(
            "quaternion",
            ("qw", "qx", "qy", "qz"),
            ("rx", "ry", "rz"),
            Dimension.RATIO,
            rotations.quaternion_to_matrix,
            rotations.matrix_to_quaternion,
        ),
        OrientationForm(
            "tilt-torsion",
            ("phi", "theta", "psi"),
            ("phi", "theta", "psi"),
            Dimension.ANGLE,
            partial(_split, euler_angles.tilt_torsion_to_matrix),
            _stack_tilt_torsion,
            partial(_split, euler_angles.tilt_torsion_rates),
            partial(_split, euler_angles.tilt_torsion_rates_inverse),
            angles=True,
        ),
    )
}


def parse_orientation(name: str) -> OrientationForm:
    """Return the form of orientation with this name.

    Names are "rotation-vector", "quaternion" (scalar first, any length), "tilt-torsion", and
    "euler-" with one of the 24 orders. Raises DataError for another name.
    """
    if name in _SIMPLE:
        return _SIMPLE[name]
    if not name.startswith("euler-"):
        raise DataError(
            f"unknown orientation form {name!r}; use {', '.join(_SIMPLE)}, or euler- and an order "
            "such as euler-xyz"
        )
    order = name.removeprefix("euler-")
    euler_angles.check_order(order)
    return OrientationForm(
        name,
        ("a", "b", "c"),
        ("a", "b", "c"),
        Dimension.ANGLE,
        partial(euler_angles.euler_to_matrix, order=order),
        partial(euler_angles.matrix_to_euler, order=order),
        partial(euler_angles.euler_rates, order=order),
        partial(euler_angles.euler_rates_inverse, order=order),
        angles=True,
    )
