# SPDX-License-Identifier: Apache-2.0
"""Use a calibration: validation, accuracy over the workspace, compensation."""

from loopcal.apply.accuracy import AccuracyMap as AccuracyMap
from loopcal.apply.accuracy import PoseUncertainty as PoseUncertainty
from loopcal.apply.accuracy import accuracy_map as accuracy_map
from loopcal.apply.accuracy import pose_uncertainty as pose_uncertainty
from loopcal.apply.accuracy_simulation import MonteCarlo as MonteCarlo
from loopcal.apply.accuracy_simulation import monte_carlo as monte_carlo
from loopcal.apply.compensation import Compensation as Compensation
from loopcal.apply.compensation import compensate as compensate
from loopcal.apply.validation import Validation as Validation
from loopcal.apply.validation import validate as validate
