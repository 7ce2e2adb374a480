# SPDX-License-Identifier: Apache-2.0
"""Plan which poses to measure."""

from loopcal.planning.constraints import Constraints as Constraints
from loopcal.planning.constraints import Sight as Sight
from loopcal.planning.pose_planning import plan as plan
from loopcal.planning.result import Plan as Plan
from loopcal.planning.surface_groups import plan_surfaces as plan_surfaces
