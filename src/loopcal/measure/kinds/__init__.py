# SPDX-License-Identifier: Apache-2.0
"""Kinds of measurements, one file each, grouped by the measured object.

`KINDS` is the registry that files, templates, documentation and tests read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from loopcal.lazy_names import LazyRegistry

if TYPE_CHECKING:
    from loopcal.measure.kinds.kind import Kind

READINGS, CLOSURE = "readings", "closure"
"""Names of the kinds that contain actuator readings alone: uncertain ones, and those of poses
without a measured value.
"""

KINDS: LazyRegistry[type[Kind]] = LazyRegistry(
    {
        "pose": "loopcal.measure.kinds.poses:Pose",
        "component": "loopcal.measure.kinds.poses:Component",
        "position": "loopcal.measure.kinds.position:Position",
        "bearing": "loopcal.measure.kinds.bearing:Bearing",
        "distance": "loopcal.measure.kinds.distance:Distance",
        "separation": "loopcal.measure.kinds.distance:Separation",
        "plane": "loopcal.measure.kinds.surfaces:Plane",
        "line": "loopcal.measure.kinds.surfaces:Line",
        "sphere": "loopcal.measure.kinds.surfaces:Sphere",
        "direction": "loopcal.measure.kinds.directions:Direction",
        "inclination": "loopcal.measure.kinds.directions:Inclination",
        "autocollimation": "loopcal.measure.kinds.directions:Autocollimation",
        "joint": "loopcal.measure.kinds.joints:JointSensor",
        "locked": "loopcal.measure.kinds.joints:Locked",
        "closure": "loopcal.measure.kinds.joints:Closure",
    }
)
"""From the name of a kind in files to its class, which is imported when it is looked up."""
