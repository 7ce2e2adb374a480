# SPDX-License-Identifier: Apache-2.0
"""Kinds of measurements, one file each, grouped by the measured object.

`KINDS` is the registry that files, templates, documentation and tests read.
"""

from loopcal.measure.kinds.directions.autocollimation import Autocollimation as Autocollimation
from loopcal.measure.kinds.directions.direction import Direction as Direction
from loopcal.measure.kinds.directions.inclination import Inclination as Inclination
from loopcal.measure.kinds.joints.actuator_readings import ActuatorReadings as ActuatorReadings
from loopcal.measure.kinds.joints.joint_sensor import JointSensor as JointSensor
from loopcal.measure.kinds.joints.joint_sensor import Locked as Locked
from loopcal.measure.kinds.kind import Kind as Kind
from loopcal.measure.kinds.points.bearing import Bearing as Bearing
from loopcal.measure.kinds.points.distance import Distance as Distance
from loopcal.measure.kinds.points.position import Position as Position
from loopcal.measure.kinds.points.separation import Separation as Separation
from loopcal.measure.kinds.poses.component import Component as Component
from loopcal.measure.kinds.poses.pose import Pose as Pose
from loopcal.measure.kinds.rows import Column as Column
from loopcal.measure.kinds.rows import Evaluation as Evaluation
from loopcal.measure.kinds.surfaces.line import Line as Line
from loopcal.measure.kinds.surfaces.plane import Plane as Plane
from loopcal.measure.kinds.surfaces.sphere import Sphere as Sphere

_CLASSES: tuple[type[Kind], ...] = (
    Pose,
    Component,
    Position,
    Bearing,
    Distance,
    Separation,
    Plane,
    Line,
    Sphere,
    Direction,
    Inclination,
    Autocollimation,
    JointSensor,
    Locked,
)

KINDS: dict[str, type[Kind]] = {kind.name: kind for kind in _CLASSES}
"""From the name of a kind in files to its class."""
