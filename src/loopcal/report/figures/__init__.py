# SPDX-License-Identifier: Apache-2.0
"""Results as figures of matplotlib, in one style: each function takes a result, returns a Figure.

`loopcal.report.pictures` makes files of them.
"""

from loopcal.report.figures.accuracy_figure import draw_accuracy_map as draw_accuracy_map
from loopcal.report.figures.comparison_figures import draw_run_errors as draw_run_errors
from loopcal.report.figures.comparison_figures import draw_run_parameters as draw_run_parameters
from loopcal.report.figures.comparison_figures import draw_run_shifts as draw_run_shifts
from loopcal.report.figures.convergence_figure import draw_convergence as draw_convergence
from loopcal.report.figures.height_figure import draw_height_errors as draw_height_errors
from loopcal.report.figures.identifiability_figure import (
    draw_identifiability as draw_identifiability,
)
from loopcal.report.figures.parameter_figures import draw_correlation as draw_correlation
from loopcal.report.figures.parameter_figures import draw_parameters as draw_parameters
from loopcal.report.figures.plan_figures import draw_curve as draw_curve
from loopcal.report.figures.plan_figures import draw_plan as draw_plan
from loopcal.report.figures.regularization_figure import draw_regularization as draw_regularization
from loopcal.report.figures.residual_figure import draw_residual_rows as draw_residual_rows
from loopcal.report.figures.residual_figure import draw_residuals as draw_residuals
from loopcal.report.figures.result_figures import draw_budget as draw_budget
from loopcal.report.figures.result_figures import draw_repeatability as draw_repeatability
from loopcal.report.figures.robot_figure import draw_robot as draw_robot
from loopcal.report.figures.scene_figure import draw_scene as draw_scene
from loopcal.report.figures.surface_plan_figure import draw_surface_plan as draw_surface_plan
from loopcal.report.figures.validation_figure import draw_validation as draw_validation
