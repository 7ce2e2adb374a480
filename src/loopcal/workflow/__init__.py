# SPDX-License-Identifier: Apache-2.0
"""Whole tasks as one call each: what the commands do, for Python users."""

from loopcal.workflow.calibration import calibrate as calibrate
from loopcal.workflow.calibration_options import CalibrationOptions as CalibrationOptions
from loopcal.workflow.calibration_report import CalibrationReport as CalibrationReport
from loopcal.workflow.calibration_report import Provenance as Provenance
from loopcal.workflow.data_split import DataSplit as DataSplit
from loopcal.workflow.data_split import split_data as split_data
from loopcal.workflow.verdict import Verdict as Verdict
