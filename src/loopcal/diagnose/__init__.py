# SPDX-License-Identifier: Apache-2.0
"""Diagnose what data can determine, and whether they agree with themselves and with a fit."""

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.diagnose.conventions import IMPLAUSIBLE as IMPLAUSIBLE
    from loopcal.diagnose.conventions import ConventionCheck as ConventionCheck
    from loopcal.diagnose.conventions import check_conventions as check_conventions
    from loopcal.diagnose.conventions import compare_conventions as compare_conventions
    from loopcal.diagnose.conventions import explain_outside_strokes as explain_outside_strokes
    from loopcal.diagnose.conventions import find_moved_setups as find_moved_setups
    from loopcal.diagnose.cross_validation import CrossValidation as CrossValidation
    from loopcal.diagnose.cross_validation import (
        build_regularization_path as build_regularization_path,
    )
    from loopcal.diagnose.cross_validation import cross_validate as cross_validate
    from loopcal.diagnose.cross_validation import score_leave_one_out as score_leave_one_out
    from loopcal.diagnose.error_frames import ErrorFrame as ErrorFrame
    from loopcal.diagnose.error_frames import choose_error_frame as choose_error_frame
    from loopcal.diagnose.fit_checks.all_checks import FitExamination as FitExamination
    from loopcal.diagnose.fit_checks.all_checks import examine_fit as examine_fit
    from loopcal.diagnose.fit_checks.blunders import Blunder as Blunder
    from loopcal.diagnose.fit_checks.blunders import name_blunders as name_blunders
    from loopcal.diagnose.fit_checks.cluster_covariance import ClusterCheck as ClusterCheck
    from loopcal.diagnose.fit_checks.cluster_covariance import check_clusters as check_clusters
    from loopcal.diagnose.fit_checks.correlations import (
        find_correlated_groups as find_correlated_groups,
    )
    from loopcal.diagnose.fit_checks.expected_errors import (
        estimate_calibration_gain as estimate_calibration_gain,
    )
    from loopcal.diagnose.fit_checks.held_out_rows import check_held_out_rows as check_held_out_rows
    from loopcal.diagnose.fit_checks.outliers import OutlierCheck as OutlierCheck
    from loopcal.diagnose.fit_checks.outliers import find_outliers as find_outliers
    from loopcal.diagnose.fit_checks.reading_errors import ReadingError as ReadingError
    from loopcal.diagnose.fit_checks.reading_errors import (
        compute_reading_errors as compute_reading_errors,
    )
    from loopcal.diagnose.fit_checks.repeated_poses import check_lack_of_fit as check_lack_of_fit
    from loopcal.diagnose.fit_checks.start_values import StartCheck as StartCheck
    from loopcal.diagnose.fit_checks.start_values import StartVerdict as StartVerdict
    from loopcal.diagnose.fit_checks.start_values import check_start_values as check_start_values
    from loopcal.diagnose.fit_checks.start_values import (
        compare_stored_geometry as compare_stored_geometry,
    )
    from loopcal.diagnose.frame_drift import estimate_frame_drifts as estimate_frame_drifts
    from loopcal.diagnose.frame_drift import report_base_targets as report_base_targets
    from loopcal.diagnose.frame_motions import NO_MOTION as NO_MOTION
    from loopcal.diagnose.frame_motions import FrameMotions as FrameMotions
    from loopcal.diagnose.frame_motions import find_frame_motions as find_frame_motions
    from loopcal.diagnose.frame_motions import interpret_fit as interpret_fit
    from loopcal.diagnose.frame_motions import twist_weights as twist_weights
    from loopcal.diagnose.identifiable_parameters import Identifiability as Identifiability
    from loopcal.diagnose.identifiable_parameters import identifiability as identifiability
    from loopcal.diagnose.model_choice import ModelChoice as ModelChoice
    from loopcal.diagnose.model_choice import choose_model as choose_model
    from loopcal.diagnose.model_choice import list_parameter_sets as list_parameter_sets
    from loopcal.diagnose.model_choice import nest_parameter_sets as nest_parameter_sets
    from loopcal.diagnose.parameter_subset import IdentifiableSubset as IdentifiableSubset
    from loopcal.diagnose.parameter_subset import (
        choose_identifiable_subset as choose_identifiable_subset,
    )
    from loopcal.diagnose.point_findings import examine_points as examine_points
    from loopcal.diagnose.prediction_errors import PosePredictions as PosePredictions
    from loopcal.diagnose.prediction_errors import PredictionComparison as PredictionComparison
    from loopcal.diagnose.prediction_errors import compare_predictions as compare_predictions
    from loopcal.diagnose.prediction_errors import predict_poses as predict_poses
    from loopcal.diagnose.regularization_curves import RegularizationCurve as RegularizationCurve
    from loopcal.diagnose.regularization_curves import RegularizationCurves as RegularizationCurves
    from loopcal.diagnose.regularization_curves import (
        compute_regularization_curves as compute_regularization_curves,
    )
    from loopcal.diagnose.residuals.adjusted_uncertainty import (
        adjust_uncertainty as adjust_uncertainty,
    )
    from loopcal.diagnose.residuals.heavy_tails import HeavyTails as HeavyTails
    from loopcal.diagnose.residuals.heavy_tails import check_heavy_tails as check_heavy_tails
    from loopcal.diagnose.row_errors import KindErrors as KindErrors
    from loopcal.diagnose.row_errors import NoiseFloor as NoiseFloor
    from loopcal.diagnose.row_errors import PoseErrors as PoseErrors
    from loopcal.diagnose.row_errors import QuantityErrors as QuantityErrors
    from loopcal.diagnose.row_errors import compute_kind_errors as compute_kind_errors
    from loopcal.diagnose.row_errors import compute_noise_floor as compute_noise_floor
    from loopcal.diagnose.row_errors import compute_row_errors as compute_row_errors
    from loopcal.diagnose.suggestions import MeasurementSuggestion as MeasurementSuggestion
    from loopcal.diagnose.suggestions import (
        describe_missing_equations as describe_missing_equations,
    )
    from loopcal.diagnose.suggestions import suggest_measurements as suggest_measurements
    from loopcal.diagnose.useful_accuracy import UsefulAccuracy as UsefulAccuracy
    from loopcal.diagnose.useful_accuracy import judge_useful_accuracy as judge_useful_accuracy
    from loopcal.diagnose.value_comparison import ValueComparison as ValueComparison
    from loopcal.diagnose.value_comparison import compare_with_truth as compare_with_truth
    from loopcal.diagnose.value_comparison import compare_with_values as compare_with_values
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.diagnose.conventions": """
                IMPLAUSIBLE ConventionCheck check_conventions compare_conventions
                explain_outside_strokes find_moved_setups
            """,
            "loopcal.diagnose.cross_validation": """
                CrossValidation build_regularization_path cross_validate score_leave_one_out
            """,
            "loopcal.diagnose.error_frames": "ErrorFrame choose_error_frame",
            "loopcal.diagnose.fit_checks.all_checks": "FitExamination examine_fit",
            "loopcal.diagnose.fit_checks.blunders": "Blunder name_blunders",
            "loopcal.diagnose.fit_checks.cluster_covariance": "ClusterCheck check_clusters",
            "loopcal.diagnose.fit_checks.correlations": "find_correlated_groups",
            "loopcal.diagnose.fit_checks.expected_errors": "estimate_calibration_gain",
            "loopcal.diagnose.fit_checks.held_out_rows": "check_held_out_rows",
            "loopcal.diagnose.fit_checks.outliers": "OutlierCheck find_outliers",
            "loopcal.diagnose.fit_checks.reading_errors": "ReadingError compute_reading_errors",
            "loopcal.diagnose.fit_checks.repeated_poses": "check_lack_of_fit",
            "loopcal.diagnose.fit_checks.start_values": """
                StartCheck StartVerdict check_start_values compare_stored_geometry
            """,
            "loopcal.diagnose.frame_drift": "estimate_frame_drifts report_base_targets",
            "loopcal.diagnose.frame_motions": """
                NO_MOTION FrameMotions find_frame_motions interpret_fit twist_weights
            """,
            "loopcal.diagnose.identifiable_parameters": "Identifiability identifiability",
            "loopcal.diagnose.model_choice": """
                ModelChoice choose_model list_parameter_sets nest_parameter_sets
            """,
            "loopcal.diagnose.parameter_subset": "IdentifiableSubset choose_identifiable_subset",
            "loopcal.diagnose.point_findings": "examine_points",
            "loopcal.diagnose.prediction_errors": """
                PosePredictions PredictionComparison compare_predictions predict_poses
            """,
            "loopcal.diagnose.regularization_curves": """
                RegularizationCurve RegularizationCurves compute_regularization_curves
            """,
            "loopcal.diagnose.residuals.adjusted_uncertainty": "adjust_uncertainty",
            "loopcal.diagnose.residuals.heavy_tails": "HeavyTails check_heavy_tails",
            "loopcal.diagnose.row_errors": """
                KindErrors NoiseFloor PoseErrors QuantityErrors compute_kind_errors
                compute_noise_floor compute_row_errors
            """,
            "loopcal.diagnose.suggestions": """
                MeasurementSuggestion describe_missing_equations suggest_measurements
            """,
            "loopcal.diagnose.useful_accuracy": "UsefulAccuracy judge_useful_accuracy",
            "loopcal.diagnose.value_comparison": """
                ValueComparison compare_with_truth compare_with_values
            """,
        },
    )
