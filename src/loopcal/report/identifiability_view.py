# SPDX-License-Identifier: Apache-2.0
"""Identifiability as people read it: what the data determine, then each parameter."""

from __future__ import annotations

from collections.abc import Sequence

from loopcal.diagnose import UsefulAccuracy
from loopcal.findings import report_finding
from loopcal.findings.wording import list_names
from loopcal.report.numbers import format_number
from loopcal.report.tables import Column, Table, build_table, word_column
from loopcal.report.text_page import Block
from loopcal.typing import FloatArray
from loopcal.workflow.identifiability_report import IdentifiabilityReport

SD_MEANING = (
    "sd / tolerance: standard deviation with the tolerances as a prior; 1 means that the data add "
    "nothing."
)


MOST_COMBINATIONS = 8
"""Combinations and suggestions that a page lists; the rest is counted."""

COMBINATIONS = ("fit.unidentifiable", "fit.hardly-observable")

FEW_PARAMETERS = 12
"""Parameters that a summary lists one by one."""


def view_identifiability(report: IdentifiabilityReport, verbose: bool = False) -> list[Block]:
    """Return the page of an identifiability analysis.

    Rank, what is undetermined, what to measure, and a table of the parameters of small robots. With
    `verbose` also every combination, the singular values, the table of every robot and the
    observability indices.
    """
    blocks: list[Block] = [str(finding) for finding in report.summary]
    if report.suggestions:
        blocks.append(str(report_finding("identifiability.known-frames-assumed")))
    if verbose:
        blocks += ["", *_view_findings(report)]
    if report.useful is not None and verbose:
        blocks += _view_useful(report.useful)
    if verbose or report.analysis.n_parameters <= FEW_PARAMETERS:
        blocks += _view_parameters(report)
    if verbose:
        blocks.append(_view_indices(report))
    if report.subset is not None:
        blocks += ["", str(report.subset)]
    return blocks


def _view_findings(report: IdentifiabilityReport) -> list[Block]:
    """Return the findings that the summary leaves out, and the measurement for each combination."""
    said = {finding.code for finding in report.summary}
    findings = [f for f in report.analysis.findings if f.code not in said]
    combinations = [f for f in findings if f.code in COMBINATIONS]
    others = [str(f) for f in findings if f.code not in COMBINATIONS]
    return [
        *others,
        *_shorten([str(f) for f in combinations], "combinations"),
        *_shorten([str(suggestion) for suggestion in report.suggestions], "suggestions"),
    ]


def _shorten(lines: list[str], what: str) -> list[Block]:
    """Return the first lines and the number of the others."""
    left = len(lines) - MOST_COMBINATIONS
    more = [f"and {left} more {what}"] if left > 0 else []
    return [*lines[:MOST_COMBINATIONS], *more]


def _view_useful(useful: UsefulAccuracy) -> list[Block]:
    """Return the best and the worst known combinations about the useful accuracy."""
    rows = [*useful.determined[-MOST_COMBINATIONS:], *useful.undetermined[:MOST_COMBINATIONS]]
    table = build_table(
        "Combinations next to the useful accuracy",
        rows,
        (
            word_column("combination of length one", wraps=True),
            lambda row: _name_terms(row.names, row.coefficients),
        ),
        (Column("sd / useful accuracy"), lambda row: format_number(row.sd, 3)),
    )
    return [table]


def _name_terms(names: Sequence[str], coefficients: FloatArray) -> str:
    """Return the strongest terms of a combination."""
    terms = [f"{c:+.2f} {name}" for name, c in zip(names, coefficients, strict=True)]
    return list_names(terms, 4).replace(" and ", ", ")


def _view_parameters(report: IdentifiabilityReport) -> list[Block]:
    """Return what the data determine of each parameter."""
    states = {"determined": "yes", "not at all": "no"}
    table = build_table(
        "Parameters",
        report.analysis.parameters,
        (word_column("name"), lambda row: row.name),
        (
            word_column("determined", wraps=True),
            lambda row: (
                states.get(row.state)
                or f"only with {list_names(row.others, MOST_COMBINATIONS // 2)}"
            ),
        ),
        (Column("sd / tolerance"), lambda row: f"{row.left:.2f}"),
    )
    return [table, SD_MEANING]


def _view_indices(report: IdentifiabilityReport) -> Table:
    """Return the observability indices."""
    return build_table(
        "Observability",
        report.analysis.indices.rows(),
        (word_column("index"), lambda row: row[0]),
        (word_column("meaning", wraps=True), lambda row: row[2]),
        (Column("value"), lambda row: format_number(row[1], 3)),
    )
