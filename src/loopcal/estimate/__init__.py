# SPDX-License-Identifier: Apache-2.0
"""Estimate the parameters of a robot from measurements."""

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.estimate.identification import identify as identify
    from loopcal.estimate.identified_trials import IdentifiedTrials as IdentifiedTrials
    from loopcal.estimate.inference.null_space import Combination as Combination
    from loopcal.estimate.inference.posterior import Posterior as Posterior
    from loopcal.estimate.inference.prior import Prior as Prior
    from loopcal.estimate.inference.prior import prior_from as prior_from
    from loopcal.estimate.inference.residual_test import ResidualTest as ResidualTest
    from loopcal.estimate.methods.inflated_tolerances import (
        InflatedTolerances as InflatedTolerances,
    )
    from loopcal.estimate.methods.losses import Huber as Huber
    from loopcal.estimate.methods.losses import Tukey as Tukey
    from loopcal.estimate.methods.penalties import MAP as MAP
    from loopcal.estimate.methods.penalties import LeastSquares as LeastSquares
    from loopcal.estimate.methods.penalties import Ridge as Ridge
    from loopcal.estimate.methods.penalties import TruncatedSVD as TruncatedSVD
    from loopcal.estimate.methods.prior_conflict import PriorConflict as PriorConflict
    from loopcal.estimate.methods.regularization_rules import GCV as GCV
    from loopcal.estimate.methods.regularization_rules import (
        MarginalLikelihood as MarginalLikelihood,
    )
    from loopcal.estimate.methods.regularization_rules import TruncationGCV as TruncationGCV
    from loopcal.estimate.minimization.descent import StepControl as StepControl
    from loopcal.estimate.options import FitOptions as FitOptions
    from loopcal.estimate.recalibration import Change as Change
    from loopcal.estimate.recalibration import recalibrate as recalibrate
    from loopcal.estimate.result import Identification as Identification
    from loopcal.estimate.trial_identification import identify_trials as identify_trials
    from loopcal.numerics.gauss_newton import DescentStatus as DescentStatus
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.estimate.identification": "identify",
            "loopcal.estimate.identified_trials": "IdentifiedTrials",
            "loopcal.estimate.inference.null_space": "Combination",
            "loopcal.estimate.inference.posterior": "Posterior",
            "loopcal.estimate.inference.prior": "Prior prior_from",
            "loopcal.estimate.inference.residual_test": "ResidualTest",
            "loopcal.estimate.methods.inflated_tolerances": "InflatedTolerances",
            "loopcal.estimate.methods.losses": "Huber Tukey",
            "loopcal.estimate.methods.penalties": "MAP LeastSquares Ridge TruncatedSVD",
            "loopcal.estimate.methods.prior_conflict": "PriorConflict",
            "loopcal.estimate.methods.regularization_rules": "GCV MarginalLikelihood TruncationGCV",
            "loopcal.estimate.minimization.descent": "StepControl",
            "loopcal.estimate.options": "FitOptions",
            "loopcal.estimate.recalibration": "Change recalibrate",
            "loopcal.estimate.result": "Identification",
            "loopcal.estimate.trial_identification": "identify_trials",
            "loopcal.numerics.gauss_newton": "DescentStatus",
        },
    )
