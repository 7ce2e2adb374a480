# SPDX-License-Identifier: Apache-2.0
"""Kinds `joint` and `locked`: sensors on joints, and joints that are fixed at unknown values.

The residual depends on the values of joints, not on the pose. The mechanism gives these values and
their derivatives by the robot's parameters. The value of a driven joint is its actuator reading. If
readings are uncertain, true readings are unknowns of their pose, and these kinds relate them to the
value that the encoder showed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from loopcal.errors import DataError
from loopcal.measure.array_checks import check_names, set_fields
from loopcal.measure.kinds import CLOSURE
from loopcal.measure.kinds import setup_parameters as setup
from loopcal.measure.kinds.kind import Column, Evaluation, Kind
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class JointSensor(Kind):
    """Values of joints. Residual: `joint + offset - measured`, angles wrapped.

    On a driven joint it is a noisy encoder.

    Setup parameters: `NAME.joint` [m or rad], the offset of each joint.

    Parameters
    ----------
    joints : passive joints as `limb.joint`, driven ones by the name of their actuator. The columns
        have equal names.
    measures : "length" or "angle": the dimension of the joints.
    unknown : "offset": the value that each sensor shows where its joint is zero.

    Raises
    ------
    DataError : no joint is named or one twice, or `unknown` lists something else.
    """

    joints: tuple[str, ...] = ("q1",)
    measures: str = "length"
    unknown: tuple[str, ...] = ()

    name: ClassVar[str] = "joint"
    length_error: ClassVar[str] = "joint length"
    angle_error: ClassVar[str] = "joint angle"
    allowed_unknown: ClassVar[tuple[str, ...]] = ("offset",)
    changes_with_pose: ClassVar[bool] = False
    scope: ClassVar[str] = "session"
    sign: ClassVar[float] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        set_fields(self, joints=check_names(self.joints, "joints"))
        if self.measures not in ("length", "angle"):
            raise DataError(f"the joints measure {self.measures!r}. Use length or angle")

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return encoders, and one of unknown offset."""
        return (cls(joints=("q1", "q2", "q3")), cls(joints=("q2",), unknown=("offset",)))

    @property
    def dimension(self) -> Dimension:
        """Dimension of the joints."""
        return Dimension(self.measures)

    @property
    def columns(self) -> tuple[Column, ...]:
        """One column for each joint."""
        return tuple(Column(name, self.dimension) for name in self.joints)

    @property
    def sensed_joints(self) -> tuple[str, ...]:
        """The joints."""
        return self.joints

    @cached_property
    def possible_setup(self) -> Mapping[str, setup.SetupItem]:
        """One offset for each joint."""
        offsets = (
            setup.make_parameters(joint, (self.name,), self.dimension, scope=self.scope)
            for joint in self.joints
        )
        return {"offset": setup.SetupItem(tuple(offset for (offset,) in offsets))}

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        offset = self.item_values(values, "offset")
        shown = joints if offset is None else joints + self.sign * offset
        m = len(self.joints)
        by_joint = np.broadcast_to(np.eye(m), (*shown.shape, m))
        by_offset = None if offset is None else self.sign * by_joint
        return Evaluation(shown, np.zeros((*shown.shape, 6)), by_offset, by_joint)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Locked(JointSensor):
    """Locked joints. Residual: `joint - constant - slip`, with one unknown constant for each group
    of rows.

    The column is the slip of the lock, usually 0. Its noise is the play of the lock.

    Setup parameters: `NAME.locked` [m or rad], the constant of each joint.

    Parameters
    ----------
    unknown : always "offset": the constant of each joint.
    Others : see `JointSensor`.
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


@dataclass(frozen=True, eq=False, repr=False)
class ActuatorReadings(Kind):
    """Recorded readings of all actuators. Residual: `true - recorded`; angles are not wrapped,
    because a full turn too much is an error of a full turn.
    """

    name: ClassVar[str] = "readings"
    description: ClassVar[str] = "the readings of the actuators"
    wraps_angles: ClassVar[bool] = False
    actuators: Mapping[str, Dimension]  # name -> dimension, in the order of the readings

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return a slide and a motor."""
        return (cls({"q1": Dimension.LENGTH, "q2": Dimension.ANGLE}),)

    @property
    def columns(self) -> tuple[Column, ...]:
        """One column for each actuator."""
        return tuple(Column(name, dimension) for name, dimension in self.actuators.items())

    @property
    def sensed_joints(self) -> tuple[str, ...]:
        """The actuators."""
        return tuple(self.actuators)

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        m = len(self.actuators)
        by_joint = np.broadcast_to(np.eye(m), (*joints.shape, m))
        return Evaluation(joints, np.zeros((*joints.shape, 6)), None, by_joint)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Closure(Kind):
    """Actuator readings alone: the closed loops of a robot with redundant actuators.

    Rows have no measured column, no noise and no setup. The robot must have more actuators than
    degrees of freedom. The `sigma` of its readings is the noise.
    """

    name: ClassVar[str] = CLOSURE
    description: ClassVar[str] = "the readings of redundant actuators"
    changes_with_pose: ClassVar[bool] = False

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Return the only one: it has no settings."""
        return (cls(),)

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        shape = (max(len(T), len(values)), T.shape[1], 0)
        return Evaluation(np.zeros(shape), np.zeros((*shape, 6)))
