# SPDX-License-Identifier: Apache-2.0
"""Families of robots: one file each, a record of what the robot file says and its expansion into
limbs and parameters.

Adding a family touches its own file and one line here; nothing below this package knows any family.
"""

from collections.abc import Mapping

from loopcal.mechanism.families.gough import Gough
from loopcal.mechanism.families.limbs import Limbs
from loopcal.mechanism.families.linear_delta import LinearDelta
from loopcal.mechanism.families.records import RobotRecord
from loopcal.mechanism.families.ru_pus_prs import RuPusPrs
from loopcal.mechanism.families.three_prs import ThreePrs

FAMILIES: Mapping[str, type[RobotRecord]] = {
    "3-prs": ThreePrs,
    "gough": Gough,
    "limbs": Limbs,
    "linear-delta": LinearDelta,
    "ru-pus-prs": RuPusPrs,
}
