# SPDX-License-Identifier: Apache-2.0
"""Forms of orientation in columns: rotation vector, quaternion, tilt and torsion, Euler angles.

Each form converts both ways and gives `rates`, the matrix E by which errors of its columns become a
rotation error, `omega = E d(columns)`. The noise of a rotation vector or a quaternion is stated as
a rotation error about the axes of the frame, so E is the identity there.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.typing import FloatArray
from loopcal.units import Dimension


class OrientationForm(ABC):
    """A form in which a rotation is written.

    Attributes
    ----------
    name : str
        Its name in files.
    columns : tuple of str
        Names of its c columns.
    dimension : Dimension
        Of the columns.
    noise_columns : tuple of str
        Names of the three noises.
    angles : bool
        Whether the columns are three angles, of which any may be measured alone.
    """

    columns: ClassVar[tuple[str, ...]] = ("rx", "ry", "rz")
    noise_columns: ClassVar[tuple[str, str, str]] = ("rx", "ry", "rz")
    dimension: ClassVar[Dimension] = Dimension.ANGLE
    angles: ClassVar[bool] = False

    _name: ClassVar[str]

    @property
    def name(self) -> str:
        """Name in files."""
        return self._name

    @abstractmethod
    def to_matrix(self, values: FloatArray) -> FloatArray:
        """Return rotations (..., 3, 3) of columns (..., c)."""

    @abstractmethod
    def from_matrix(self, rotation: FloatArray) -> FloatArray:
        """Return columns (..., c) of rotations (..., 3, 3)."""

    def rates(self, values: FloatArray) -> FloatArray:
        """Return E (..., 3, 3) with `omega = E d(columns)`.

        It is the identity if the noise is stated as a rotation error.
        """
        return np.broadcast_to(np.eye(3), (*values.shape[:-1], 3, 3))

    def rates_inverse(self, values: FloatArray) -> FloatArray:
        """Return the inverse of `rates`, (..., 3, 3)."""
        return np.broadcast_to(np.eye(3), (*values.shape[:-1], 3, 3))


@dataclass(frozen=True)
class RotationVector(OrientationForm):
    """`R = exp(r)`, columns rx ry rz."""

    _name = "rotation-vector"

    def to_matrix(self, values: FloatArray) -> FloatArray:
        """Return rotations (..., 3, 3) of rotation vectors (..., 3) [rad]."""
        return geometry.exp_so3(values)

    def from_matrix(self, rotation: FloatArray) -> FloatArray:
        """Return rotation vectors (..., 3) [rad], of length at most pi."""
        return geometry.log_so3(rotation)


@dataclass(frozen=True)
class Quaternion(OrientationForm):
    """Scalar first, columns qw qx qy qz, of any length."""

    _name = "quaternion"
    columns = ("qw", "qx", "qy", "qz")
    dimension = Dimension.RATIO

    def to_matrix(self, values: FloatArray) -> FloatArray:
        """Return rotations (..., 3, 3) of quaternions (..., 4)."""
        return geometry.quaternion_to_matrix(values)

    def from_matrix(self, rotation: FloatArray) -> FloatArray:
        """Return unit quaternions (..., 4), scalar not negative."""
        return geometry.matrix_to_quaternion(rotation)


@dataclass(frozen=True)
class TiltTorsion(OrientationForm):
    """`R = Rz(phi) Ry(theta) Rz(psi - phi)`, columns phi theta psi."""

    _name = "tilt-torsion"
    columns = ("phi", "theta", "psi")
    noise_columns = ("phi", "theta", "psi")
    angles = True

    def to_matrix(self, values: FloatArray) -> FloatArray:
        """Return rotations (..., 3, 3) of azimuth, tilt and torsion (..., 3) [rad]."""
        return geometry.tilt_torsion_to_matrix(values[..., 0], values[..., 1], values[..., 2])

    def from_matrix(self, rotation: FloatArray) -> FloatArray:
        """Return azimuth, tilt and torsion (..., 3) [rad]."""
        return np.stack(geometry.matrix_to_tilt_torsion(rotation), axis=-1)

    def rates(self, values: FloatArray) -> FloatArray:
        """Return E (..., 3, 3), singular at zero tilt."""
        return geometry.tilt_torsion_rates(values[..., 0], values[..., 1], values[..., 2])

    def rates_inverse(self, values: FloatArray) -> FloatArray:
        """Return E^-1 (..., 3, 3), its first row huge at zero tilt."""
        return geometry.tilt_torsion_rates_inverse(values[..., 0], values[..., 1], values[..., 2])


@dataclass(frozen=True)
class Euler(OrientationForm):
    """Three rotations a, b, c about the axes of the order, see `geometry.euler_to_matrix`.

    Parameters
    ----------
    order : str
        One of `geometry.EULER_ORDERS`: lower case fixed axes, upper case moving axes.
    """

    order: str

    columns = ("a", "b", "c")
    noise_columns = ("a", "b", "c")
    angles = True

    def __post_init__(self) -> None:
        geometry.euler_to_matrix(np.zeros(3), self.order)

    @property
    def name(self) -> str:
        """Name in files, e.g. "euler-xyz"."""
        return f"euler-{self.order}"

    def to_matrix(self, values: FloatArray) -> FloatArray:
        """Return rotations (..., 3, 3) of angles (..., 3) [rad]."""
        return geometry.euler_to_matrix(values, self.order)

    def from_matrix(self, rotation: FloatArray) -> FloatArray:
        """Return angles (..., 3) [rad]."""
        return geometry.matrix_to_euler(rotation, self.order)

    def rates(self, values: FloatArray) -> FloatArray:
        """Return E (..., 3, 3), singular if two axes are parallel."""
        return geometry.euler_rates(values, self.order)

    def rates_inverse(self, values: FloatArray) -> FloatArray:
        """Return E^-1 (..., 3, 3), huge if two axes are parallel."""
        return geometry.euler_rates_inverse(values, self.order)


_SIMPLE: dict[str, OrientationForm] = {
    form.name: form for form in (RotationVector(), Quaternion(), TiltTorsion())
}


def parse_orientation(name: str) -> OrientationForm:
    """Return the form of orientation with this name.

    Parameters
    ----------
    name : str
        "rotation-vector", "quaternion" (scalar first), "tilt-torsion", or "euler-" and one of
        the 24 orders.

    Returns
    -------
    form : OrientationForm

    Raises
    ------
    DataError
        Unknown name.
    """
    if name in _SIMPLE:
        return _SIMPLE[name]
    if name.startswith("euler-"):
        return Euler(name.removeprefix("euler-"))
    raise DataError(
        f"unknown orientation form {name!r}; use {', '.join(_SIMPLE)}, or euler- and an order "
        "such as euler-xyz"
    )
