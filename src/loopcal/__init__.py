# SPDX-License-Identifier: Apache-2.0
"""Geometric calibration of robots with closed kinematic loops.

These names are the public API; every other module may change. Each is imported when it is first
used, so that `import loopcal` costs nothing. docs/api.md lists them with their purpose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from loopcal.apply import AccuracyMap as AccuracyMap
    from loopcal.apply import AccuracySimulation as AccuracySimulation
    from loopcal.apply import Compensation as Compensation
    from loopcal.apply import Conformity as Conformity
    from loopcal.apply import HeightErrors as HeightErrors
    from loopcal.apply import PoseUncertainty as PoseUncertainty
    from loopcal.apply import Repeatability as Repeatability
    from loopcal.apply import RunComparison as RunComparison
    from loopcal.apply import Validation as Validation
    from loopcal.apply import accuracy_map as accuracy_map
    from loopcal.apply import assess_repeatability as assess_repeatability
    from loopcal.apply import compare_runs as compare_runs
    from loopcal.apply import compensate as compensate
    from loopcal.apply import judge_estimate as judge_estimate
    from loopcal.apply import judge_largest_error as judge_largest_error
    from loopcal.apply import pose_uncertainty as pose_uncertainty
    from loopcal.apply import simulate_accuracy as simulate_accuracy
    from loopcal.apply import validate as validate
    from loopcal.diagnose import ConventionCheck as ConventionCheck
    from loopcal.diagnose import CrossValidation as CrossValidation
    from loopcal.diagnose import FitExamination as FitExamination
    from loopcal.diagnose import Identifiability as Identifiability
    from loopcal.diagnose import ModelChoice as ModelChoice
    from loopcal.diagnose import OutlierCheck as OutlierCheck
    from loopcal.diagnose import RegularizationCurves as RegularizationCurves
    from loopcal.diagnose import ValueComparison as ValueComparison
    from loopcal.diagnose import check_conventions as check_conventions
    from loopcal.diagnose import choose_identifiable_subset as choose_identifiable_subset
    from loopcal.diagnose import choose_model as choose_model
    from loopcal.diagnose import compare_conventions as compare_conventions
    from loopcal.diagnose import compare_with_truth as compare_with_truth
    from loopcal.diagnose import compare_with_values as compare_with_values
    from loopcal.diagnose import compute_regularization_curves as compute_regularization_curves
    from loopcal.diagnose import cross_validate as cross_validate
    from loopcal.diagnose import examine_fit as examine_fit
    from loopcal.diagnose import find_outliers as find_outliers
    from loopcal.diagnose import identifiability as identifiability
    from loopcal.diagnose import suggest_measurements as suggest_measurements
    from loopcal.documents import write_comparison as write_comparison
    from loopcal.documents import write_report as write_report
    from loopcal.documents import write_view as write_view
    from loopcal.errors import DataError as DataError
    from loopcal.errors import EstimationError as EstimationError
    from loopcal.errors import FileError as FileError
    from loopcal.errors import LoopcalError as LoopcalError
    from loopcal.errors import MechanismError as MechanismError
    from loopcal.errors import MissingPackageError as MissingPackageError
    from loopcal.errors import StudyError as StudyError
    from loopcal.errors import UnitError as UnitError
    from loopcal.estimate import GCV as GCV
    from loopcal.estimate import MAP as MAP
    from loopcal.estimate import Combination as Combination
    from loopcal.estimate import DescentStatus as DescentStatus
    from loopcal.estimate import FitOptions as FitOptions
    from loopcal.estimate import Huber as Huber
    from loopcal.estimate import Identification as Identification
    from loopcal.estimate import IdentifiedTrials as IdentifiedTrials
    from loopcal.estimate import InflatedTolerances as InflatedTolerances
    from loopcal.estimate import LeastSquares as LeastSquares
    from loopcal.estimate import MarginalLikelihood as MarginalLikelihood
    from loopcal.estimate import Prior as Prior
    from loopcal.estimate import Ridge as Ridge
    from loopcal.estimate import StepControl as StepControl
    from loopcal.estimate import TruncatedSVD as TruncatedSVD
    from loopcal.estimate import TruncationGCV as TruncationGCV
    from loopcal.estimate import Tukey as Tukey
    from loopcal.estimate import identify as identify
    from loopcal.estimate import identify_trials as identify_trials
    from loopcal.estimate import prior_from as prior_from
    from loopcal.estimate import recalibrate as recalibrate
    from loopcal.findings import Finding as Finding
    from loopcal.findings import Quantity as Quantity
    from loopcal.findings import Severity as Severity
    from loopcal.io import Run as Run
    from loopcal.io import load_measurements as load_measurements
    from loopcal.io import load_robot as load_robot
    from loopcal.io import load_run as load_run
    from loopcal.io import load_stored_values as load_stored_values
    from loopcal.io import save_measurements as save_measurements
    from loopcal.io import save_robot as save_robot
    from loopcal.io import save_run as save_run
    from loopcal.measure import KINDS as KINDS
    from loopcal.measure import Autocollimation as Autocollimation
    from loopcal.measure import Bearing as Bearing
    from loopcal.measure import Closure as Closure
    from loopcal.measure import Component as Component
    from loopcal.measure import Direction as Direction
    from loopcal.measure import Distance as Distance
    from loopcal.measure import Gaussian as Gaussian
    from loopcal.measure import Inclination as Inclination
    from loopcal.measure import Instrument as Instrument
    from loopcal.measure import InstrumentRecord as InstrumentRecord
    from loopcal.measure import JointSensor as JointSensor
    from loopcal.measure import Line as Line
    from loopcal.measure import Locked as Locked
    from loopcal.measure import Measurements as Measurements
    from loopcal.measure import Observations as Observations
    from loopcal.measure import Plane as Plane
    from loopcal.measure import Pose as Pose
    from loopcal.measure import Position as Position
    from loopcal.measure import Sensor as Sensor
    from loopcal.measure import Separation as Separation
    from loopcal.measure import Sphere as Sphere
    from loopcal.measure import StatedValue as StatedValue
    from loopcal.measure import Trials as Trials
    from loopcal.measure import Uniform as Uniform
    from loopcal.measure import sample_truth as sample_truth
    from loopcal.measure import simulate as simulate
    from loopcal.measure import simulate_trials as simulate_trials
    from loopcal.mechanism import Jacobian as Jacobian
    from loopcal.mechanism import Mechanism as Mechanism
    from loopcal.mechanism import Solution as Solution
    from loopcal.mechanism import Status as Status
    from loopcal.mechanism import find_assembly_modes as find_assembly_modes
    from loopcal.mechanism import find_working_modes as find_working_modes
    from loopcal.mechanism import forward as forward
    from loopcal.mechanism import inverse as inverse
    from loopcal.mechanism import jacobian as jacobian
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
    from loopcal.progress_bar import ProgressBar as ProgressBar
    from loopcal.sampling import Bootstrap as Bootstrap
    from loopcal.sampling import Intervals as Intervals
    from loopcal.sampling import JointRegion as JointRegion
    from loopcal.sampling import PosteriorSample as PosteriorSample
    from loopcal.sampling import SimultaneousIntervals as SimultaneousIntervals
    from loopcal.sampling import bootstrap as bootstrap
    from loopcal.sampling import compute_joint_region as compute_joint_region
    from loopcal.sampling import compute_simultaneous_intervals as compute_simultaneous_intervals
    from loopcal.sampling import sample_posterior as sample_posterior
    from loopcal.studies import Dask as Dask
    from loopcal.studies import Processes as Processes
    from loopcal.studies import Ray as Ray
    from loopcal.studies import Serial as Serial
    from loopcal.studies import Study as Study
    from loopcal.studies import StudyResult as StudyResult
    from loopcal.studies import load_study as load_study
    from loopcal.studies.running import study as study
    from loopcal.workflow import CalibrationOptions as CalibrationOptions
    from loopcal.workflow import CalibrationReport as CalibrationReport
    from loopcal.workflow import Verdict as Verdict
    from loopcal.workflow import calibrate as calibrate

__version__ = "0.1.0.dev0"

PUBLIC_NAMES: Mapping[str, Sequence[str]] = {
    package: names.split()
    for package, names in {
        "loopcal.apply": """
            AccuracyMap AccuracySimulation Compensation Conformity HeightErrors PoseUncertainty
            Repeatability RunComparison Validation accuracy_map assess_repeatability compare_runs
            compensate judge_estimate judge_largest_error pose_uncertainty simulate_accuracy
            validate
        """,
        "loopcal.diagnose": """
            ConventionCheck CrossValidation FitExamination Identifiability ModelChoice
            OutlierCheck RegularizationCurves ValueComparison check_conventions
            choose_identifiable_subset choose_model compare_conventions compare_with_truth
            compare_with_values compute_regularization_curves cross_validate examine_fit
            find_outliers identifiability suggest_measurements
        """,
        "loopcal.documents": "write_comparison write_report write_view",
        "loopcal.errors": """
            DataError EstimationError FileError LoopcalError MechanismError
            MissingPackageError StudyError UnitError
        """,
        "loopcal.estimate": """
            Combination DescentStatus FitOptions GCV Huber Identification IdentifiedTrials
            InflatedTolerances LeastSquares MAP MarginalLikelihood Prior Ridge StepControl
            TruncatedSVD TruncationGCV Tukey identify identify_trials prior_from recalibrate
        """,
        "loopcal.findings": "Finding Quantity Severity",
        "loopcal.io": """
            Run load_measurements load_robot load_run load_stored_values save_measurements
            save_robot save_run
        """,
        "loopcal.measure": """
            Autocollimation Bearing Closure Component Direction Distance Gaussian Inclination
            Instrument InstrumentRecord JointSensor KINDS Line Locked Measurements Observations
            Plane Pose Position Sensor Separation Sphere StatedValue Trials Uniform sample_truth
            simulate simulate_trials
        """,
        "loopcal.mechanism": """
            Jacobian Mechanism Solution Status find_assembly_modes find_working_modes forward
            inverse jacobian sample_workspace trace_singularity
        """,
        "loopcal.planning": """
            Constraints LineOfSight Plan PlanOptions SurfaceOptions SurfacePlan plan
            plan_surfaces
        """,
        "loopcal.progress_bar": "ProgressBar",
        "loopcal.sampling": """
            Bootstrap Intervals JointRegion PosteriorSample SimultaneousIntervals bootstrap
            compute_joint_region compute_simultaneous_intervals sample_posterior
        """,
        "loopcal.studies": "Dask Processes Ray Serial Study StudyResult load_study",
        "loopcal.studies.running": "study",
        "loopcal.workflow": "CalibrationOptions CalibrationReport Verdict calibrate",
    }.items()
}
"""Public names by the package that defines them."""

_PACKAGES = {name: package for package, names in PUBLIC_NAMES.items() for name in names}

__all__ = ["__version__", *sorted(_PACKAGES)]  # noqa: PLE0604  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _PACKAGES:
        raise AttributeError(
            f"module 'loopcal' has no attribute {name!r}; public names are "
            f"{', '.join(sorted(_PACKAGES))}"
        )
    value = getattr(import_module(_PACKAGES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
