# SPDX-License-Identifier: Apache-2.0
"""From measurements to parameters: identify, what can be identified, validate."""

from loopcal.calibrate.combinations import Combination as Combination
from loopcal.calibrate.conflict import PriorConflict as PriorConflict
from loopcal.calibrate.conflict import Widened as Widened
from loopcal.calibrate.descent import DescentStatus as DescentStatus
from loopcal.calibrate.descent import StepControl as StepControl
from loopcal.calibrate.filters import MAP as MAP
from loopcal.calibrate.filters import LeastSquares as LeastSquares
from loopcal.calibrate.filters import Ridge as Ridge
from loopcal.calibrate.filters import TruncatedSVD as TruncatedSVD
from loopcal.calibrate.identifiability import Identifiability as Identifiability
from loopcal.calibrate.identifiability import identifiability as identifiability
from loopcal.calibrate.identification import Identification as Identification
from loopcal.calibrate.identify import IdentifiedTrials as IdentifiedTrials
from loopcal.calibrate.identify import identify as identify
from loopcal.calibrate.identify import identify_trials as identify_trials
from loopcal.calibrate.losses import Huber as Huber
from loopcal.calibrate.losses import Tukey as Tukey
from loopcal.calibrate.outliers import OutlierCheck as OutlierCheck
from loopcal.calibrate.outliers import find_outliers as find_outliers
from loopcal.calibrate.per_leg import identify_per_leg as identify_per_leg
from loopcal.calibrate.pose_errors import PoseErrors as PoseErrors
from loopcal.calibrate.pose_errors import pose_errors as pose_errors
from loopcal.calibrate.rules import GCV as GCV
from loopcal.calibrate.rules import MarginalLikelihood as MarginalLikelihood
from loopcal.calibrate.rules import TruncationGCV as TruncationGCV
from loopcal.calibrate.start_check import Start as Start
from loopcal.calibrate.start_check import StartCheck as StartCheck
from loopcal.calibrate.start_check import start_check as start_check
from loopcal.calibrate.validate import Validation as Validation
from loopcal.calibrate.validate import validate as validate
