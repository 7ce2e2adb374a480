# SPDX-License-Identifier: Apache-2.0
"""Identifiability as people read it: what the data determine, then each parameter."""

from __future__ import annotations

from loopcal.findings import report_finding
from loopcal.findings.wording import list_names
from loopcal.report.numbers import format_number
from loopcal.report.tables import Column, Table, word_column
from loopcal.report.text_page import Block
from loopcal.workflow.identifiability_report import IdentifiabilityReport


def view_identifiability(report: IdentifiabilityReport) -> list[Block]:
    """Return the page of an identifiability analysis."""
    analysis = report.analysis
    blocks: list[Block] = [str(finding) for finding in analysis.findings]
    blocks += [str(suggestion) for suggestion in report.suggestions]
    if report.suggestions:
        blocks.append(str(report_finding("identifiability.known-frames-assumed")))
    states = {"determined": "yes", "not at all": "no"}
    rows = tuple(
        (
            parameter.name,
            states.get(parameter.state) or f"only with {list_names(parameter.others)}",
            f"{parameter.left:.2f}",
        )
        for parameter in analysis.parameters
    )
    columns = (word_column("name"), word_column("determined", wraps=True), Column("sd / tolerance"))
    blocks.append(Table("Parameters", columns, rows))
    blocks.append(
        "sd / tolerance: standard deviation with the tolerances as a prior; 1 means that the data "
        "add nothing."
    )
    indices = tuple(
        (name, meaning, format_number(value, 3)) for name, value, meaning in analysis.indices.rows()
    )
    columns = (word_column("index"), word_column("meaning", wraps=True), Column("value"))
    blocks.append(Table("Observability", columns, indices))
    if report.subset is not None:
        blocks += ["", str(report.subset)]
    return blocks
