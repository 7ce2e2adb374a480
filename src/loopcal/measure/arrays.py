# SPDX-License-Identifier: Apache-2.0
"""Arrays as they are stored in measurements: float64, read-only, of a stated shape."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError
from loopcal.typing import FloatArray


def stored(
    value: ArrayLike, what: str, shape: Sequence[int | None], *, allow_nan: bool = False
) -> FloatArray:
    """Read-only float64 copy of an array, after checking its shape and its numbers.

    Parameters
    ----------
    value : array_like
    what : str
        How a message calls it.
    shape : sequence of int or None
        The shape it must have; None allows any length.
    allow_nan : bool
        Whether NaN (not measured) may occur; infinity never may.

    Returns
    -------
    array : ndarray, read-only

    Raises
    ------
    DataError
        If the shape differs or a number is not finite.
    """
    array = np.array(value, dtype=float)
    if array.ndim != len(shape) or any(
        n is not None and n != m for n, m in zip(shape, array.shape, strict=True)
    ):
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise DataError(f"{what} has shape {array.shape}; give an array of shape ({wanted})")
    wrong = np.isinf(array) if allow_nan else ~np.isfinite(array)
    if np.any(wrong):
        place = tuple(int(i) + 1 for i in np.argwhere(wrong)[0])
        where = f"row {place[0]}" + (f", column {place[1]}" if len(place) > 1 else "")
        value = array[tuple(i - 1 for i in place)]
        raise DataError(
            f"{what}: {where} is {value}; give a finite number" + (" or NaN" if allow_nan else "")
        )
    array.setflags(write=False)
    return array


def stored_pose(value: ArrayLike, what: str) -> FloatArray:
    """Read-only pose (4, 4), after checking that it is one.

    Raises
    ------
    DataError
        If it is not a rotation and a translation, to 1e-9.
    """
    T = stored(value, what, (4, 4))
    R = T[:3, :3]
    error = float(np.max(np.abs(R @ R.T - np.eye(3))))
    if error > 1e-9 or np.linalg.det(R) < 0.0 or not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise DataError(
            f"{what} is not a pose: its rotation part is off by {error:.2g} from a right-handed "
            "rotation or its last"
            " row is not 0 0 0 1; give R with R R' = 1 to 1e-9, det R = 1, and the translation [m] "
            "in the last column"
        )
    return T
