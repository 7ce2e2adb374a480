# SPDX-License-Identifier: Apache-2.0
"""Families of robots: the record of a robot file and its expansion into limbs and parameters.

To add a family, write its file and add its name here; no other package knows the families.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from loopcal.registry import Registry

if TYPE_CHECKING:
    from loopcal.mechanism.families.records import RobotRecord

# Records by the name of their family, imported when a robot file names it.
FAMILIES: Registry[type[RobotRecord]] = Registry(
    "family of robots",
    "",
    {
        "3-prs": "loopcal.mechanism.families.prs:ThreePrs",
        "gough": "loopcal.mechanism.families.gough:Gough",
        "limbs": "loopcal.mechanism.families.limbs:Limbs",
        "linear-delta": "loopcal.mechanism.families.linear_delta:LinearDelta",
        "ru-pus-prs": "loopcal.mechanism.families.prs:RuPusPrs",
        "stages": "loopcal.mechanism.families.stages:Stages",
    },
)
