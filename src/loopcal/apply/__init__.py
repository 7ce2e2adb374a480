# SPDX-License-Identifier: Apache-2.0
"""Use a calibration: validation, accuracy over the workspace, compensation."""

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.apply.accuracy import PoseUncertainty as PoseUncertainty
    from loopcal.apply.accuracy import pose_uncertainty as pose_uncertainty
    from loopcal.apply.accuracy_simulation import AccuracySimulation as AccuracySimulation
    from loopcal.apply.accuracy_simulation import simulate_accuracy as simulate_accuracy
    from loopcal.apply.compensation import Compensation as Compensation
    from loopcal.apply.compensation import compensate as compensate
    from loopcal.apply.conformity import Conformity as Conformity
    from loopcal.apply.conformity import Decision as Decision
    from loopcal.apply.conformity import judge_estimate as judge_estimate
    from loopcal.apply.conformity import judge_largest_error as judge_largest_error
    from loopcal.apply.error_budget import ErrorBudget as ErrorBudget
    from loopcal.apply.error_budget import ErrorSources as ErrorSources
    from loopcal.apply.error_budget import compute_error_budget as compute_error_budget
    from loopcal.apply.height_errors import HeightErrors as HeightErrors
    from loopcal.apply.height_errors import map_height_errors as map_height_errors
    from loopcal.apply.repeatability import assess_repeatability as assess_repeatability
    from loopcal.apply.repeatability_result import Repeatability as Repeatability
    from loopcal.apply.reused_rows import report_reused_rows as report_reused_rows
    from loopcal.apply.run_comparison import PairComparison as PairComparison
    from loopcal.apply.run_comparison import RunComparison as RunComparison
    from loopcal.apply.run_comparison import StoredRun as StoredRun
    from loopcal.apply.run_comparison import compare_runs as compare_runs
    from loopcal.apply.validation import Validation as Validation
    from loopcal.apply.validation import validate as validate
    from loopcal.apply.workspace_accuracy import AccuracyMap as AccuracyMap
    from loopcal.apply.workspace_accuracy import accuracy_map as accuracy_map
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.apply.accuracy": "PoseUncertainty pose_uncertainty",
            "loopcal.apply.accuracy_simulation": "AccuracySimulation simulate_accuracy",
            "loopcal.apply.compensation": "Compensation compensate",
            "loopcal.apply.conformity": "Conformity Decision judge_estimate judge_largest_error",
            "loopcal.apply.error_budget": "ErrorBudget ErrorSources compute_error_budget",
            "loopcal.apply.height_errors": "HeightErrors map_height_errors",
            "loopcal.apply.repeatability": "assess_repeatability",
            "loopcal.apply.repeatability_result": "Repeatability",
            "loopcal.apply.reused_rows": "report_reused_rows",
            "loopcal.apply.run_comparison": "PairComparison RunComparison StoredRun compare_runs",
            "loopcal.apply.validation": "Validation validate",
            "loopcal.apply.workspace_accuracy": "AccuracyMap accuracy_map",
        },
    )
