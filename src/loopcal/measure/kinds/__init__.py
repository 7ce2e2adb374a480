# SPDX-License-Identifier: Apache-2.0
"""Kinds of measurements, one file each, grouped by the measured object.

`KINDS` is the registry that files, templates, documentation and tests read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from loopcal.lazy_names import LazyRegistry, import_lazily

if TYPE_CHECKING:
    from loopcal.measure.kinds.directions.autocollimation import Autocollimation as Autocollimation
    from loopcal.measure.kinds.directions.direction import Direction as Direction
    from loopcal.measure.kinds.directions.inclination import Inclination as Inclination
    from loopcal.measure.kinds.joints.actuator_readings import ActuatorReadings as ActuatorReadings
    from loopcal.measure.kinds.joints.closure import Closure as Closure
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
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.measure.kinds.directions.autocollimation": "Autocollimation",
            "loopcal.measure.kinds.directions.direction": "Direction",
            "loopcal.measure.kinds.directions.inclination": "Inclination",
            "loopcal.measure.kinds.joints.actuator_readings": "ActuatorReadings",
            "loopcal.measure.kinds.joints.closure": "Closure",
            "loopcal.measure.kinds.joints.joint_sensor": "JointSensor Locked",
            "loopcal.measure.kinds.kind": "Kind",
            "loopcal.measure.kinds.points.bearing": "Bearing",
            "loopcal.measure.kinds.points.distance": "Distance",
            "loopcal.measure.kinds.points.position": "Position",
            "loopcal.measure.kinds.points.separation": "Separation",
            "loopcal.measure.kinds.poses.component": "Component",
            "loopcal.measure.kinds.poses.pose": "Pose",
            "loopcal.measure.kinds.rows": "Column Evaluation",
            "loopcal.measure.kinds.surfaces.line": "Line",
            "loopcal.measure.kinds.surfaces.plane": "Plane",
            "loopcal.measure.kinds.surfaces.sphere": "Sphere",
        },
    )

READINGS, CLOSURE = "readings", "closure"
"""Names of the kinds that contain actuator readings alone: uncertain ones, and those of poses
without a measured value.
"""

KINDS: LazyRegistry[type[Kind]] = LazyRegistry(
    {
        "pose": "loopcal.measure.kinds.poses.pose:Pose",
        "component": "loopcal.measure.kinds.poses.component:Component",
        "position": "loopcal.measure.kinds.points.position:Position",
        "bearing": "loopcal.measure.kinds.points.bearing:Bearing",
        "distance": "loopcal.measure.kinds.points.distance:Distance",
        "separation": "loopcal.measure.kinds.points.separation:Separation",
        "plane": "loopcal.measure.kinds.surfaces.plane:Plane",
        "line": "loopcal.measure.kinds.surfaces.line:Line",
        "sphere": "loopcal.measure.kinds.surfaces.sphere:Sphere",
        "direction": "loopcal.measure.kinds.directions.direction:Direction",
        "inclination": "loopcal.measure.kinds.directions.inclination:Inclination",
        "autocollimation": "loopcal.measure.kinds.directions.autocollimation:Autocollimation",
        "joint": "loopcal.measure.kinds.joints.joint_sensor:JointSensor",
        "locked": "loopcal.measure.kinds.joints.joint_sensor:Locked",
        "closure": "loopcal.measure.kinds.joints.closure:Closure",
    }
)
"""From the name of a kind in files to its class, which is imported when it is looked up."""
