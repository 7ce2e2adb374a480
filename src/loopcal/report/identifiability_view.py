# SPDX-License-Identifier: Apache-2.0
"""Identifiability as people read it: what the data determine, then each parameter."""

from __future__ import annotations

from loopcal.findings import report_finding
from loopcal.findings.wording import list_names
from loopcal.report.numbers import format_number
from loopcal.report.tables import Column, build_table, word_column
from loopcal.report.text_page import Block
from loopcal.workflow.identifiability_report import IdentifiabilityReport

SD_MEANING = (
    "sd / tolerance: standard deviation with the tolerances as a prior; 1 means that the data add "
    "nothing."
)


def view_identifiability(report: IdentifiabilityReport, verbose: bool = False) -> list[Block]:
    """Return the page of an identifiability analysis.

    Rank, what is undetermined, and what to measure. With `verbose` also every combination, the
    singular values, a statement on each parameter and the observability indices.
    """
    blocks: list[Block] = [str(finding) for finding in report.summary]
    if report.suggestions:
        blocks.append(str(report_finding("identifiability.known-frames-assumed")))
    if verbose:
        blocks += ["", *_view_details(report)]
    if report.subset is not None:
        blocks += ["", str(report.subset)]
    return blocks


def _view_details(report: IdentifiabilityReport) -> list[Block]:
    """Return everything that the summary leaves out."""
    analysis, said = report.analysis, {finding.code for finding in report.summary}
    blocks: list[Block] = [str(f) for f in analysis.findings if f.code not in said]
    blocks += [str(suggestion) for suggestion in report.suggestions]
    states = {"determined": "yes", "not at all": "no"}
    return [
        *blocks,
        build_table(
            "Parameters",
            analysis.parameters,
            (word_column("name"), lambda row: row.name),
            (
                word_column("determined", wraps=True),
                lambda row: states.get(row.state) or f"only with {list_names(row.others)}",
            ),
            (Column("sd / tolerance"), lambda row: f"{row.left:.2f}"),
        ),
        SD_MEANING,
        build_table(
            "Observability",
            analysis.indices.rows(),
            (word_column("index"), lambda row: row[0]),
            (word_column("meaning", wraps=True), lambda row: row[2]),
            (Column("value"), lambda row: format_number(row[1], 3)),
        ),
    ]
