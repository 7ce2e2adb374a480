# SPDX-License-Identifier: Apache-2.0
"""Estimate the parameters of a robot from measurements."""

from loopcal.estimate.combinations import Combination as Combination
from loopcal.estimate.conflict import PriorConflict as PriorConflict
from loopcal.estimate.conflict import Widened as Widened
from loopcal.estimate.descent import DescentStatus as DescentStatus
from loopcal.estimate.descent import StepControl as StepControl
from loopcal.estimate.identification import IdentifiedTrials as IdentifiedTrials
from loopcal.estimate.identification import identify as identify
from loopcal.estimate.identification import identify_trials as identify_trials
from loopcal.estimate.losses import Huber as Huber
from loopcal.estimate.losses import Tukey as Tukey
from loopcal.estimate.penalties import MAP as MAP
from loopcal.estimate.penalties import LeastSquares as LeastSquares
from loopcal.estimate.penalties import Ridge as Ridge
from loopcal.estimate.penalties import TruncatedSVD as TruncatedSVD
from loopcal.estimate.posteriors import Posterior as Posterior
from loopcal.estimate.prior import Prior as Prior
from loopcal.estimate.prior import prior_from as prior_from
from loopcal.estimate.recalibration import Change as Change
from loopcal.estimate.recalibration import recalibrate as recalibrate
from loopcal.estimate.regularization_rules import GCV as GCV
from loopcal.estimate.regularization_rules import MarginalLikelihood as MarginalLikelihood
from loopcal.estimate.regularization_rules import TruncationGCV as TruncationGCV
from loopcal.estimate.result import Identification as Identification
