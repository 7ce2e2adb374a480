# SPDX-License-Identifier: Apache-2.0
"""Results as figures of matplotlib, in one style: each function takes a result, returns a Figure.

`loopcal.report.pictures` makes files of them.
"""

from loopcal.report.figures.plan_figures import draw_curve as draw_curve
from loopcal.report.figures.plan_figures import draw_plan as draw_plan
from loopcal.report.figures.regularization_figure import draw_regularization as draw_regularization
from loopcal.report.figures.robot_figure import draw_robot as draw_robot
