# SPDX-License-Identifier: Apache-2.0
"""Families of robots: the record of a robot file and its expansion into limbs and parameters.

To add a family, write its file and add its name here; no other package knows the families.
"""

from collections.abc import Mapping

from loopcal.mechanism.families.gough import Gough
from loopcal.mechanism.families.limbs import Limbs
from loopcal.mechanism.families.linear_delta import LinearDelta
from loopcal.mechanism.families.records import RobotRecord
from loopcal.mechanism.families.ru_pus_prs import RuPusPrs
from loopcal.mechanism.families.three_prs import ThreePrs

FAMILIES: Mapping[str, type[RobotRecord]] = {
    record.family: record for record in (ThreePrs, Gough, Limbs, LinearDelta, RuPusPrs)
}
"""Records by the name of their family."""
