# SPDX-License-Identifier: Apache-2.0
"""Plan which poses to measure."""

from loopcal.planning.constraints import Constraints as Constraints
from loopcal.planning.constraints import LineOfSight as LineOfSight
from loopcal.planning.options import PlanOptions as PlanOptions
from loopcal.planning.options import Target as Target
from loopcal.planning.plane_line_planning import SurfaceOptions as SurfaceOptions
from loopcal.planning.plane_line_planning import SurfacePlan as SurfacePlan
from loopcal.planning.plane_line_planning import plan_surfaces as plan_surfaces
from loopcal.planning.pose_planning import plan as plan
from loopcal.planning.result import Plan as Plan
from loopcal.planning.route import check_route as check_route
