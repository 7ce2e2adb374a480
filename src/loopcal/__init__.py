# SPDX-License-Identifier: Apache-2.0
"""Geometric calibration of robots with closed kinematic loops.

These names are the public API; every other module may change. Each is imported when it is first used, so that
`import loopcal` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from loopcal.calibrate import MAP as MAP
    from loopcal.calibrate import Constraints as Constraints
    from loopcal.calibrate import Huber as Huber
    from loopcal.calibrate import Identification as Identification
    from loopcal.calibrate import LeastSquares as LeastSquares
    from loopcal.calibrate import Plan as Plan
    from loopcal.calibrate import Ridge as Ridge
    from loopcal.calibrate import Sight as Sight
    from loopcal.calibrate import StepControl as StepControl
    from loopcal.calibrate import TruncatedSVD as TruncatedSVD
    from loopcal.calibrate import Tukey as Tukey
    from loopcal.calibrate import Validation as Validation
    from loopcal.calibrate import accuracy_map as accuracy_map
    from loopcal.calibrate import check_arrival as check_arrival
    from loopcal.calibrate import compensate as compensate
    from loopcal.calibrate import identifiability as identifiability
    from loopcal.calibrate import identify as identify
    from loopcal.calibrate import identify_trials as identify_trials
    from loopcal.calibrate import parameter_error as parameter_error
    from loopcal.calibrate import plan as plan
    from loopcal.calibrate import plan_surfaces as plan_surfaces
    from loopcal.calibrate import pose_uncertainty as pose_uncertainty
    from loopcal.calibrate import prior_from as prior_from
    from loopcal.calibrate import recalibrate as recalibrate
    from loopcal.calibrate import validate as validate
    from loopcal.errors import LoopcalError as LoopcalError
    from loopcal.io import load_measurements as load_measurements
    from loopcal.io import load_robot as load_robot
    from loopcal.io import save_measurements as save_measurements
    from loopcal.io import save_robot as save_robot
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
    from loopcal.mechanism import along_path as along_path
    from loopcal.mechanism import assembly_modes as assembly_modes
    from loopcal.mechanism import forward as forward
    from loopcal.mechanism import inverse as inverse
    from loopcal.mechanism import sample as sample
    from loopcal.mechanism import working_modes as working_modes

__version__ = "0.1.0.dev0"

_WHERE = {
    name: module
    for module, names in {
        "loopcal.calibrate": (
            "MAP",
            "Constraints",
            "Huber",
            "Identification",
            "LeastSquares",
            "Plan",
            "Ridge",
            "Sight",
            "StepControl",
            "TruncatedSVD",
            "Tukey",
            "Validation",
            "accuracy_map",
            "check_arrival",
            "compensate",
            "identifiability",
            "identify",
            "identify_trials",
            "parameter_error",
            "plan",
            "plan_surfaces",
            "pose_uncertainty",
            "prior_from",
            "recalibrate",
            "validate",
        ),
        "loopcal.errors": ("LoopcalError",),
        "loopcal.io": ("load_measurements", "load_robot", "save_measurements", "save_robot"),
        "loopcal.measure": (
            "KINDS",
            "Component",
            "Gaussian",
            "Instrument",
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
            "along_path",
            "assembly_modes",
            "forward",
            "inverse",
            "sample",
            "working_modes",
        ),
    }.items()
    for name in names
}

__all__ = ["__version__", *sorted(_WHERE)]  # noqa: PLE0604  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _WHERE:
        raise AttributeError(f"module 'loopcal' has no attribute {name!r}; public names are {', '.join(sorted(_WHERE))}")
    value = getattr(import_module(_WHERE[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names."""
    return __all__
