# SPDX-License-Identifier: Apache-2.0
"""Kind `joint`: sensors on joints, passive ones or driven ones; a driven joint's is its noisy
encoder.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.kinds.kind import Column, Evaluation, Kind, chosen
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension


@dataclass(frozen=True, eq=False, kw_only=True)
class JointSensor(Kind):
    """Values of joints. Residual: `joint + offset - measured`, angles wrapped.

    The poses do not matter, but the joints' values do: they and their derivatives by the robot's
    parameters come from the mechanism. A driven joint's value is the reading itself; where readings
    are uncertain they are unknowns of their pose, and this kind is the row that ties them to what
    the encoder showed.

    Parameters
    ----------
    joints : tuple of str
        Passive joints as `limb.joint`, driven ones by the name of their actuator; these are the
        columns, too.
    measures : str
        "length" or "angle", what the joints move by.
    unknown : tuple of str
        "offset": what each sensor shows where its joint is zero.

    Raises
    ------
    DataError
        If no joint is named or one twice, or something else is said to be unknown.
    """

    joints: tuple[str, ...] = ("q1",)
    measures: str = "length"
    unknown: tuple[str, ...] = ()

    name: ClassVar[str] = "joint"
    scope: ClassVar[str] = "session"
    changes_with_pose: ClassVar[bool] = False
    sign: ClassVar[float] = 1.0

    def __post_init__(self) -> None:
        joints = (self.joints,) if isinstance(self.joints, str) else tuple(self.joints)
        if not joints or len(set(joints)) < len(joints):
            raise DataError(
                f"the joints are {', '.join(joints) or 'none'}: name at least one, and each once"
            )
        if self.measures not in ("length", "angle"):
            raise DataError(f"the joints measure {self.measures!r}; use length or angle")
        object.__setattr__(self, "joints", joints)
        object.__setattr__(self, "unknown", chosen(self.unknown, ("offset",), self.name))

    @classmethod
    def examples(cls) -> tuple[Self, ...]:
        """Encoders, and one of unknown offset."""
        return (cls(joints=("q1", "q2", "q3")), cls(joints=("q2",), unknown=("offset",)))

    @property
    def dimension(self) -> Dimension:
        """Of the joints."""
        return Dimension(self.measures)

    @property
    def columns(self) -> tuple[Column, ...]:
        """One for each joint."""
        return tuple(Column(name, self.dimension) for name in self.joints)

    @property
    def sensed_joints(self) -> tuple[str, ...]:
        """The joints."""
        return self.joints

    @property
    def setup_items(self) -> Mapping[str, tuple[Parameter, ...]]:
        """An offset for each joint."""
        made = tuple(
            Parameter(f"{joint}.{self.name}", self.dimension, 0.0, scope=self.scope)
            for joint in self.joints
        )
        return {"offset": made} if self.unknown else {}

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        residual = self.predict(joints, values) - measured
        if self.dimension is Dimension.ANGLE:
            residual = geometry.wrap_angle(residual)
        m = len(self.joints)
        still = np.zeros((*residual.shape, 6))
        slope = np.broadcast_to(np.eye(m), (*residual.shape, m))
        return Evaluation(residual, still, self.sign * slope if self.unknown else None, slope)

    def predict(self, joints: FloatArray, values: FloatArray) -> FloatArray:
        """What the sensors show (t, r, m)."""
        own = self.item_values(values, "offset")
        return joints if own is None else joints + self.sign * own

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Nothing is known from poses alone; offsets start at zero and enter linearly."""
        return self.nominal_values[None]

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        unknowns: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Columns (t, r, m) with noise added."""
        return (
            self.predict(np.zeros_like(noise) if joints is None else joints, self.values(unknowns))
            + noise
        )
