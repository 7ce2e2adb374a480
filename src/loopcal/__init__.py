# SPDX-License-Identifier: Apache-2.0
"""Geometric calibration of robots with closed kinematic loops.

These names are the public API; every other module may change. Each is imported when it is first
used, so that `import loopcal` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from loopcal.apply import Validation as Validation
    from loopcal.apply import accuracy_map as accuracy_map
    from loopcal.apply import compensate as compensate
    from loopcal.apply import pose_uncertainty as pose_uncertainty
    from loopcal.apply import validate as validate
    from loopcal.diagnose import check_conventions as check_conventions
    from loopcal.diagnose import compare_with_truth as compare_with_truth
    from loopcal.diagnose import identifiability as identifiability
    from loopcal.errors import LoopcalError as LoopcalError
    from loopcal.estimate import MAP as MAP
    from loopcal.estimate import FitOptions as FitOptions
    from loopcal.estimate import Huber as Huber
    from loopcal.estimate import Identification as Identification
    from loopcal.estimate import LeastSquares as LeastSquares
    from loopcal.estimate import Ridge as Ridge
    from loopcal.estimate import StepControl as StepControl
    from loopcal.estimate import TruncatedSVD as TruncatedSVD
    from loopcal.estimate import Tukey as Tukey
    from loopcal.estimate import identify as identify
    from loopcal.estimate import identify_trials as identify_trials
    from loopcal.estimate import prior_from as prior_from
    from loopcal.estimate import recalibrate as recalibrate
    from loopcal.io import Run as Run
    from loopcal.io import load_measurements as load_measurements
    from loopcal.io import load_robot as load_robot
    from loopcal.io import load_run as load_run
    from loopcal.io import save_measurements as save_measurements
    from loopcal.io import save_robot as save_robot
    from loopcal.io import save_run as save_run
    from loopcal.measure import KINDS as KINDS
    from loopcal.measure import Component as Component
    from loopcal.measure import Gaussian as Gaussian
    from loopcal.measure import Instrument as Instrument
    from loopcal.measure import Measurements as Measurements
    from loopcal.measure import Observations as Observations
    from loopcal.measure import Pose as Pose
    from loopcal.measure import Sensor as Sensor
    from loopcal.measure import Uniform as Uniform
    from loopcal.measure import simulate as simulate
    from loopcal.measure import simulate_trials as simulate_trials
    from loopcal.mechanism import Mechanism as Mechanism
    from loopcal.mechanism import Solution as Solution
    from loopcal.mechanism import Status as Status
    from loopcal.mechanism import find_assembly_modes as find_assembly_modes
    from loopcal.mechanism import find_working_modes as find_working_modes
    from loopcal.mechanism import forward as forward
    from loopcal.mechanism import inverse as inverse
    from loopcal.mechanism import sample_workspace as sample_workspace
    from loopcal.mechanism import trace_singularity as trace_singularity
    from loopcal.planning import Constraints as Constraints
    from loopcal.planning import LineOfSight as LineOfSight
    from loopcal.planning import Plan as Plan
    from loopcal.planning import PlanOptions as PlanOptions
    from loopcal.planning import SurfaceOptions as SurfaceOptions
    from loopcal.planning import SurfacePlan as SurfacePlan
    from loopcal.planning import plan as plan
    from loopcal.planning import plan_surfaces as plan_surfaces
    from loopcal.workflow import CalibrationOptions as CalibrationOptions
    from loopcal.workflow import CalibrationReport as CalibrationReport
    from loopcal.workflow import Verdict as Verdict
    from loopcal.workflow import calibrate as calibrate

__version__ = "0.1.0.dev0"

_WHERE = {
    name: module
    for module, names in {
        "loopcal.apply": (
            "Validation",
            "accuracy_map",
            "compensate",
            "pose_uncertainty",
            "validate",
        ),
        "loopcal.diagnose": ("check_conventions", "compare_with_truth", "identifiability"),
        "loopcal.errors": ("LoopcalError",),
        "loopcal.estimate": (
            "FitOptions",
            "Huber",
            "Identification",
            "LeastSquares",
            "MAP",
            "Ridge",
            "StepControl",
            "TruncatedSVD",
            "Tukey",
            "identify",
            "identify_trials",
            "prior_from",
            "recalibrate",
        ),
        "loopcal.io": (
            "Run",
            "load_measurements",
            "load_robot",
            "load_run",
            "save_measurements",
            "save_robot",
            "save_run",
        ),
        "loopcal.measure": (
            "Component",
            "Gaussian",
            "Instrument",
            "KINDS",
            "Measurements",
            "Observations",
            "Pose",
            "Sensor",
            "Uniform",
            "simulate",
            "simulate_trials",
        ),
        "loopcal.mechanism": (
            "Mechanism",
            "Solution",
            "Status",
            "trace_singularity",
            "find_assembly_modes",
            "forward",
            "inverse",
            "sample_workspace",
            "find_working_modes",
        ),
        "loopcal.planning": (
            "Constraints",
            "LineOfSight",
            "Plan",
            "PlanOptions",
            "SurfaceOptions",
            "SurfacePlan",
            "plan",
            "plan_surfaces",
        ),
        "loopcal.workflow": ("CalibrationOptions", "CalibrationReport", "Verdict", "calibrate"),
    }.items()
    for name in names
}

__all__ = ["__version__", *sorted(_WHERE)]  # pyright: ignore[reportUnsupportedDunderAll]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _WHERE:
        raise AttributeError(
            f"module 'loopcal' has no attribute {name!r}; public names are "
            f"{', '.join(sorted(_WHERE))}"
        )
    value = getattr(import_module(_WHERE[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names."""
    return __all__
