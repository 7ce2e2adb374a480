# SPDX-License-Identifier: Apache-2.0
"""Kinds of measurements, one file each; `KINDS` is the registry that files, templates,
documentation and tests read.
"""

from loopcal.measure.kinds.autocollimation import Autocollimation as Autocollimation
from loopcal.measure.kinds.bearing import Bearing as Bearing
from loopcal.measure.kinds.component import Component as Component
from loopcal.measure.kinds.direction import Direction as Direction
from loopcal.measure.kinds.distance import Distance as Distance
from loopcal.measure.kinds.inclination import Inclination as Inclination
from loopcal.measure.kinds.joint import JointSensor as JointSensor
from loopcal.measure.kinds.kind import Column as Column
from loopcal.measure.kinds.kind import Evaluation as Evaluation
from loopcal.measure.kinds.kind import Kind as Kind
from loopcal.measure.kinds.line import Line as Line
from loopcal.measure.kinds.locked import Locked as Locked
from loopcal.measure.kinds.plane import Plane as Plane
from loopcal.measure.kinds.pose import Pose as Pose
from loopcal.measure.kinds.position import Position as Position
from loopcal.measure.kinds.separation import Separation as Separation
from loopcal.measure.kinds.sphere import Sphere as Sphere

_POINTS: tuple[type[Kind], ...] = (Position, Bearing, Distance, Separation, Plane, Line, Sphere)
_AIMS: tuple[type[Kind], ...] = (Direction, Inclination, Autocollimation)

KINDS: dict[str, type[Kind]] = {
    kind.name: kind for kind in (Pose, Component, *_POINTS, *_AIMS, JointSensor, Locked)
}
