# SPDX-License-Identifier: Apache-2.0
"""Kind `locked`: joints that stand still over a group of rows, at values nobody knows."""

from dataclasses import dataclass
from typing import ClassVar, Self

from loopcal.measure.kinds.joint import JointSensor
from loopcal.measure.kinds.kind import Column


@dataclass(frozen=True, eq=False, kw_only=True)
class Locked(JointSensor):
    """Joints held fixed. Residual: `joint - constant - slip`, with one unknown constant for each
    group of rows.

    The column is the slip of the lock, 0 where nothing else is known; its noise is the play of the
    lock.

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
        """Two joints at once."""
        return (cls(joints=("q1", "q4")),)

    @property
    def columns(self) -> tuple[Column, ...]:
        """The slip of each joint."""
        return tuple(Column(f"{name}.slip", self.dimension) for name in self.joints)
