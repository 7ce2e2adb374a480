# SPDX-License-Identifier: Apache-2.0
"""Kind `joint`: sensors on passive or driven joints; on a driven joint it is a noisy encoder."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.kinds.kind import Column, Evaluation, Kind, check_unknown
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class JointSensor(Kind):
    """Values of joints. Residual: `joint + offset - measured`, angles wrapped.

    The residual depends on the values of the joints, not on the pose. The mechanism gives these
    values and their derivatives by the robot's parameters. The value of a driven joint is its
    actuator reading. If readings are uncertain, true readings are unknowns of their pose, and this
    kind relates them to the value that the encoder showed.

    Parameters
    ----------
    joints : tuple of str
        Passive joints as `limb.joint`, driven ones by the name of their actuator. The columns have
        the same names.
    measures : str
        "length" or "angle": the dimension of the joints.
    unknown : tuple of str
        "offset": the value that each sensor shows where its joint is zero.

    Raises
    ------
    DataError
        If no joint is named or one twice, or `unknown` lists something else.
    """

    joints: tuple[str, ...] = ("q1",)
    measures: str = "length"
    unknown: tuple[str, ...] = ()

    name: ClassVar[str] = "joint"
    allowed_unknown: ClassVar[tuple[str, ...]] = ("offset",)
    changes_with_pose: ClassVar[bool] = False
    scope: ClassVar[str] = "session"
    sign: ClassVar[float] = 1.0

    def __post_init__(self) -> None:
        joints = (self.joints,) if isinstance(self.joints, str) else tuple(self.joints)
        if not joints or len(set(joints)) < len(joints):
            raise DataError(
                f"the joints are {', '.join(joints) or 'empty'}; name at least one, and each once"
            )
        if self.measures not in ("length", "angle"):
            raise DataError(f"the joints measure {self.measures!r}; use length or angle")
        object.__setattr__(self, "joints", joints)
        object.__setattr__(
            self, "unknown", check_unknown(self.unknown, self.allowed_unknown, self.name)
        )

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

    @property
    def setup_items(self) -> Mapping[str, tuple[Parameter, ...]]:
        """One offset for each joint, if unknown."""
        offsets = tuple(
            Parameter(f"{joint}.{self.name}", self.dimension, 0.0, scope=self.scope)
            for joint in self.joints
        )
        return {"offset": offsets} if self.unknown else {}

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        residual = self.predict(joints, values) - measured
        if self.dimension is Dimension.ANGLE:
            residual = geometry.wrap_angle(residual)
        m = len(self.joints)
        by_twist = np.zeros((*residual.shape, 6))
        by_joint = np.broadcast_to(np.eye(m), (*residual.shape, m))
        by_offset = self.sign * by_joint if self.unknown else None
        return Evaluation(residual, by_twist, by_offset, by_joint)

    def predict(self, joints: FloatArray, values: FloatArray) -> FloatArray:
        """Return the values (t, r, m) that the sensors show."""
        offset = self.item_values(values, "offset")
        return joints if offset is None else joints + self.sign * offset

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return offsets of zero: poses alone do not determine them, and they enter linearly."""
        return self.nominal_values[None]

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        nuisance: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Return columns (t, r, m) with noise added."""
        true = np.zeros_like(noise) if joints is None else joints
        return self.predict(true, self.values_or_nominal(nuisance)) + noise
