# SPDX-License-Identifier: Apache-2.0
"""Tell what data can determine, and whether they agree with themselves and with a fit."""

from loopcal.diagnose.component_worth import worth as worth
from loopcal.diagnose.conventions import Arrival as Arrival
from loopcal.diagnose.conventions import arrival as arrival
from loopcal.diagnose.conventions import check_arrival as check_arrival
from loopcal.diagnose.correlation import correlated_groups as correlated_groups
from loopcal.diagnose.cross_validation import cross_validate as cross_validate
from loopcal.diagnose.examination import Examination as Examination
from loopcal.diagnose.examination import examine as examine
from loopcal.diagnose.gauge import ParameterError as ParameterError
from loopcal.diagnose.gauge import parameter_error as parameter_error
from loopcal.diagnose.identifiability_analysis import Identifiability as Identifiability
from loopcal.diagnose.identifiability_analysis import identifiability as identifiability
from loopcal.diagnose.leave_one_out_errors import LeaveOneOut as LeaveOneOut
from loopcal.diagnose.leave_one_out_errors import leave_one_out as leave_one_out
from loopcal.diagnose.model_choice import choose_model as choose_model
from loopcal.diagnose.model_choice import nested_sets as nested_sets
from loopcal.diagnose.outliers import OutlierCheck as OutlierCheck
from loopcal.diagnose.outliers import find_outliers as find_outliers
from loopcal.diagnose.pose_error_figures import PoseErrors as PoseErrors
from loopcal.diagnose.pose_error_figures import pose_errors as pose_errors
from loopcal.diagnose.repeats import lack_of_fit as lack_of_fit
from loopcal.diagnose.start_values import Start as Start
from loopcal.diagnose.start_values import StartCheck as StartCheck
from loopcal.diagnose.start_values import start_check as start_check
