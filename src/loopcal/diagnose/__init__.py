# SPDX-License-Identifier: Apache-2.0
"""Diagnose what data can determine, and whether they agree with themselves and with a fit."""

from loopcal.diagnose.actuator_reading_errors import ReadingError as ReadingError
from loopcal.diagnose.actuator_reading_errors import (
    compute_reading_errors as compute_reading_errors,
)
from loopcal.diagnose.component_worth import CalibrationGain as CalibrationGain
from loopcal.diagnose.component_worth import estimate_calibration_gain as estimate_calibration_gain
from loopcal.diagnose.conventions import IMPLAUSIBLE as IMPLAUSIBLE
from loopcal.diagnose.conventions import ConventionCheck as ConventionCheck
from loopcal.diagnose.conventions import check_conventions as check_conventions
from loopcal.diagnose.conventions import compare_conventions as compare_conventions
from loopcal.diagnose.correlation import CorrelatedGroup as CorrelatedGroup
from loopcal.diagnose.correlation import find_correlated_groups as find_correlated_groups
from loopcal.diagnose.cross_validation import CrossValidation as CrossValidation
from loopcal.diagnose.cross_validation import cross_validate as cross_validate
from loopcal.diagnose.examination import FitExamination as FitExamination
from loopcal.diagnose.examination import examine_fit as examine_fit
from loopcal.diagnose.frame_motions import NO_MOTION as NO_MOTION
from loopcal.diagnose.frame_motions import FrameMotions as FrameMotions
from loopcal.diagnose.frame_motions import find_frame_motions as find_frame_motions
from loopcal.diagnose.frame_motions import twist_weights as twist_weights
from loopcal.diagnose.gauge import TruthComparison as TruthComparison
from loopcal.diagnose.gauge import compare_with_truth as compare_with_truth
from loopcal.diagnose.identifiability_analysis import Identifiability as Identifiability
from loopcal.diagnose.identifiability_analysis import identifiability as identifiability
from loopcal.diagnose.leave_one_out_errors import LeaveOneOut as LeaveOneOut
from loopcal.diagnose.leave_one_out_errors import (
    build_regularization_path as build_regularization_path,
)
from loopcal.diagnose.leave_one_out_errors import score_leave_one_out as score_leave_one_out
from loopcal.diagnose.model_choice import ModelChoice as ModelChoice
from loopcal.diagnose.model_choice import choose_model as choose_model
from loopcal.diagnose.model_choice import nest_parameter_sets as nest_parameter_sets
from loopcal.diagnose.outliers import OutlierCheck as OutlierCheck
from loopcal.diagnose.outliers import find_outliers as find_outliers
from loopcal.diagnose.parameter_subset import IdentifiableSubset as IdentifiableSubset
from loopcal.diagnose.parameter_subset import (
    choose_identifiable_subset as choose_identifiable_subset,
)
from loopcal.diagnose.prediction_errors import INDICES as INDICES
from loopcal.diagnose.prediction_errors import KindErrors as KindErrors
from loopcal.diagnose.prediction_errors import PoseErrors as PoseErrors
from loopcal.diagnose.prediction_errors import PosePredictions as PosePredictions
from loopcal.diagnose.prediction_errors import PredictionComparison as PredictionComparison
from loopcal.diagnose.prediction_errors import compare_predictions as compare_predictions
from loopcal.diagnose.prediction_errors import compute_kind_errors as compute_kind_errors
from loopcal.diagnose.prediction_errors import compute_pose_errors as compute_pose_errors
from loopcal.diagnose.prediction_errors import compute_row_errors as compute_row_errors
from loopcal.diagnose.prediction_errors import predict_poses as predict_poses
from loopcal.diagnose.repeats import LackOfFit as LackOfFit
from loopcal.diagnose.repeats import check_lack_of_fit as check_lack_of_fit
from loopcal.diagnose.set_up_anew import MovedSetups as MovedSetups
from loopcal.diagnose.set_up_anew import find_moved_setups as find_moved_setups
from loopcal.diagnose.start_values import StartCheck as StartCheck
from loopcal.diagnose.start_values import StartVerdict as StartVerdict
from loopcal.diagnose.start_values import check_start_values as check_start_values
from loopcal.diagnose.stored_geometry import stored_answer as stored_answer
from loopcal.diagnose.suggestions import ASSUMED_FRAMES as ASSUMED_FRAMES
from loopcal.diagnose.suggestions import MeasurementSuggestion as MeasurementSuggestion
from loopcal.diagnose.suggestions import describe_missing_equations as describe_missing_equations
from loopcal.diagnose.suggestions import suggest_measurements as suggest_measurements
