# SPDX-License-Identifier: Apache-2.0
"""The report of a calibration: its sections in the order in which readers ask."""

from __future__ import annotations

from collections.abc import Mapping

from loopcal.report.document.elements import Document
from loopcal.report.document.record import CalibrationRecord
from loopcal.report.document.sections.data import (
    build_finding_section,
    build_open_section,
    build_outlier_section,
    build_residual_section,
)
from loopcal.report.document.sections.errors import (
    build_error_section,
    build_height_section,
    build_workspace_section,
)
from loopcal.report.document.sections.parameters import (
    build_budget_section,
    build_parameter_section,
)
from loopcal.report.document.sections.provenance import (
    build_controller_section,
    build_pose_section,
    build_provenance_section,
)
from loopcal.report.document.sections.verdict import build_verdict_section

SECTIONS = (
    build_verdict_section,
    build_open_section,
    build_outlier_section,
    build_error_section,
    build_height_section,
    build_residual_section,
    build_workspace_section,
    build_parameter_section,
    build_budget_section,
    build_controller_section,
    build_finding_section,
    build_provenance_section,
    build_pose_section,
)
"""Functions that build the sections, in order."""


def build_document(record: CalibrationRecord) -> Document:
    """Return the report of a calibration; a section without content is left out."""
    sections = (build(record) for build in SECTIONS)
    return Document(
        title=f"Calibration report: {record.robot.name}",
        verdict=record.verdict.name.lower(),
        summary=summarize(record),
        made_by=describe_maker((record.result.get("made_by") or {}).get("versions", {})),
        sections=tuple(section for section in sections if section.elements),
    )


def summarize(record: CalibrationRecord) -> str:
    """Return the headline of a calibration; of older runs, which state none, the verdict."""
    verdict = record.verdict.value
    sentence = f"{verdict[0].upper()}{verdict[1:]}: {record.robot.name}."
    return str(record.result.get("headline") or sentence)


def describe_maker(versions: Mapping[str, str]) -> str:
    """Return program and version, of the versions that a run names."""
    return f"loopcal {versions.get('loopcal', '')}".strip()
