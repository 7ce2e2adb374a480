# SPDX-License-Identifier: Apache-2.0
"""Kind `locked`: joints that are fixed during a group of rows, at unknown values."""

from dataclasses import dataclass
from typing import ClassVar, Self

from loopcal.measure.kinds.joints.joint_sensor import JointSensor
from loopcal.measure.kinds.kind import Column


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Locked(JointSensor):
    """Locked joints. Residual: `joint - constant - slip`, with one unknown constant for each group
    of rows.

    The column is the slip of the lock, usually 0. Its noise is the play of the lock.

    Parameters
    ----------
    See `JointSensor`; the constant is always unknown.
    """

    unknown: tuple[str, ...] = ("offset",)

    name: ClassVar[str] = "locked"
    scope: ClassVar[str] = "group"
    sign: ClassVar[float] = -1.0

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return two joints at once."""
        return (cls(joints=("q1", "q4")),)

    @property
    def columns(self) -> tuple[Column, ...]:
        """The slip of each joint."""
        return tuple(Column(f"{name}.slip", self.dimension) for name in self.joints)
