# SPDX-License-Identifier: Apache-2.0
"""Whole tasks as one call each: what the commands do, for Python users."""

from typing import TYPE_CHECKING

from loopcal.lazy_names import import_lazily

if TYPE_CHECKING:
    from loopcal.workflow.calibration import calibrate as calibrate
    from loopcal.workflow.calibration_options import CalibrationOptions as CalibrationOptions
    from loopcal.workflow.calibration_report import CalibrationReport as CalibrationReport
    from loopcal.workflow.calibration_report import Provenance as Provenance
    from loopcal.workflow.data_split import DataSplit as DataSplit
    from loopcal.workflow.data_split import split_data as split_data
    from loopcal.workflow.verdict import Verdict as Verdict
else:
    __getattr__ = import_lazily(
        __name__,
        {
            "loopcal.workflow.calibration": "calibrate",
            "loopcal.workflow.calibration_options": "CalibrationOptions",
            "loopcal.workflow.calibration_report": "CalibrationReport Provenance",
            "loopcal.workflow.data_split": "DataSplit split_data",
            "loopcal.workflow.verdict": "Verdict",
        },
    )
