# SPDX-License-Identifier: Apache-2.0
"""Records of calibrations from reports in memory and from run folders, with controllers' values."""

from __future__ import annotations

import json
from dataclasses import replace

from loopcal.errors import LoopcalError
from loopcal.io import Run
from loopcal.io.core.json_text import to_json
from loopcal.io.formats import FORMATS
from loopcal.io.formats.import_export import build_source, export_robot
from loopcal.io.formats.program_format import ExportSource
from loopcal.io.runs.run_folder import build_document, refuse_changed_run
from loopcal.report.document.record import CalibrationRecord, ControllerValues, build_record
from loopcal.workflow import CalibrationReport

GENERAL = ("json", "csv")
"""Formats that take every robot, and belong to no controller."""


def load_record(source: CalibrationReport | Run) -> CalibrationRecord:
    """Return what a report shows, of a calibration in memory or a run folder.

    Raises
    ------
    FileError : a file of the run folder is not the one that the calibration wrote.
    """
    if isinstance(source, Run):
        refuse_changed_run(source)
        robot, initial, arrays = source.identified_robot, source.initial_robot, source.arrays
        result, name, exported = source.result, str(source.path), build_source(source)
    else:
        fit = source.identification
        robot, initial, arrays = fit.robot, fit.initial, source.arrays()
        result, name = json.loads(to_json(build_document(source))), ""
        intervals = {row["name"]: row["plus_minus"] for row in result["fit"]["parameters"]}
        exported = ExportSource(robot, intervals)
    exported = replace(exported, is_for_people=True)
    return build_record(result, arrays, robot, initial, name, list_controllers(exported))


def list_controllers(source: ExportSource) -> tuple[ControllerValues, ...]:
    """Return the values as text of every controller's format that can express the robot."""
    controllers = []
    for target in FORMATS.values():
        if target.write is None or target.name in GENERAL:
            continue
        try:
            exported = export_robot(source, target, None)
        except LoopcalError:  # of another family, or a format that only corrects a file
            continue
        notes = tuple(str(finding) for finding in exported.findings)
        controllers.append(ControllerValues(target.name, target.what, exported.text, notes))
    return tuple(controllers)
