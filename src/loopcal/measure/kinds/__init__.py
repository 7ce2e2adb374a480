# SPDX-License-Identifier: Apache-2.0
"""Kinds of measurements, one file each and one line here.

`KINDS` is the registry that files, templates, documentation and tests read.
"""

from __future__ import annotations

from dataclasses import is_dataclass
from typing import TYPE_CHECKING, TypeVar

from loopcal.errors import DataError
from loopcal.registry import Registry

if TYPE_CHECKING:
    from loopcal.measure.kinds.kind import Kind

K = TypeVar("K")

CLOSURE = "closure"  # name of the kind that contains actuator readings alone

KINDS: Registry[type[Kind]] = Registry(
    "kind of measurement",
    "loopcal.kinds",
    {
        "pose": "loopcal.measure.kinds.poses:Pose",
        "component": "loopcal.measure.kinds.poses:Component",
        "position": "loopcal.measure.kinds.position:Position",
        "bearing": "loopcal.measure.kinds.position:Bearing",
        "distance": "loopcal.measure.kinds.distance:Distance",
        "separation": "loopcal.measure.kinds.distance:Separation",
        "image": "loopcal.measure.kinds.image:Image",
        "plane": "loopcal.measure.kinds.surfaces:Plane",
        "line": "loopcal.measure.kinds.surfaces:Line",
        "sphere": "loopcal.measure.kinds.surfaces:Sphere",
        "direction": "loopcal.measure.kinds.directions:Direction",
        "inclination": "loopcal.measure.kinds.directions:Inclination",
        "autocollimation": "loopcal.measure.kinds.directions:Autocollimation",
        "joint": "loopcal.measure.kinds.joints:JointSensor",
        "locked": "loopcal.measure.kinds.joints:Locked",
        "closure": "loopcal.measure.kinds.joints:Closure",
    },
)
"""From the name of a kind in files to its class, which is imported when it is looked up."""


def register_kind(kind: type[K]) -> type[K]:
    """Add a kind of measurement: a frozen dataclass that extends `Kind`; also a decorator.

    See docs/extending.md.

    Raises
    ------
    DataError : the class does not extend `Kind`, or its name is missing or one of loopcal.
    """
    from loopcal.measure.kinds.kind import Kind

    if not (isinstance(kind, type) and issubclass(kind, Kind) and is_dataclass(kind)):
        raise DataError(
            f"{kind!r} is not a dataclass that extends Kind, as a kind of measurement must be"
        )
    return KINDS.register(kind)
