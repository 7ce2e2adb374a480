# SPDX-License-Identifier: Apache-2.0
"""Parameters with their uncertainty, correlations, and the uncertainty budget."""

from __future__ import annotations

from loopcal.report.budget_view import build_budget_table
from loopcal.report.calibration_view import build_last_value_table, build_parameter_table
from loopcal.report.document.elements import Element, Section
from loopcal.report.document.figures import draw_correlation_picture, draw_parameter_picture
from loopcal.report.document.record import CalibrationRecord
from loopcal.report.numbers import ABSENT
from loopcal.report.tables import Table, word_column

TERMS = (
    "The terms are those of JCGM 100 (GUM) and JCGM 200 (VIM). The standard uncertainty u is one "
    "standard deviation. The expanded uncertainty is U = k u, with the coverage factor k of "
    "Student's t distribution for a coverage probability of 95 % and the effective degrees of "
    "freedom by Welch and Satterthwaite. The shift is the estimate minus the nominal value, "
    "divided by the tolerance (a standard deviation)."
)
BUDGET_TERMS = (
    "The budget lists standard uncertainties (k = 1). Evaluation of type A uses the scatter of "
    "these data, type B uses stated values such as the sigma of the instrument and the tolerances. "
    "A position or orientation error is the length of a vector, so the table states no coverage "
    "factor for it. The parameters above have one."
)
NOT_TRACEABLE = (
    "The data state no serial number, certificate or date of calibration of the instrument, so "
    "this report does not show traceability."
)
NO_BUDGET = "This fit has no intervals, so there is no uncertainty budget."


def build_parameter_section(record: CalibrationRecord) -> Section:
    """Return the parameters, the setup parameters, and figures of shifts and correlations."""
    fit = record.result["fit"]
    if not record.converged:
        table = build_last_value_table(fit["parameters"])
        return Section("parameters", "Parameters", (table,))
    elements: list[Element] = [
        TERMS,
        build_parameter_table("Identified parameters", fit["parameters"], is_complete=True),
    ]
    if fit.get("interval_note"):
        elements.append(fit["interval_note"])
    if fit.get("local"):
        elements.append(build_parameter_table("Setup parameters", fit["local"]))
    elements += draw_parameter_picture(record)
    elements += draw_correlation_picture(record)
    return Section("parameters", "Parameters", tuple(elements))


def build_budget_section(record: CalibrationRecord) -> Section:
    """Return the uncertainty budget by source."""
    budget = record.result.get("expected_error")
    instruments = _list_instruments(record)
    if not budget or budget.get("sources") is None:
        return Section("budget", "Uncertainty budget", (NO_BUDGET, *instruments))
    elements: list[Element] = [BUDGET_TERMS]
    if not record.result.get("states_expected_error"):
        elements.append(
            "The residuals exceed the stated noise, so these numbers are not the expected error of "
            "the machine."
        )
    elements.append(build_budget_table(budget, record.robot))
    return Section("budget", "Uncertainty budget", (*elements, *instruments))


def _list_instruments(record: CalibrationRecord) -> list[Element]:
    """Return the stated facts of each instrument, or that none are stated."""
    instruments = record.result.get("instruments") or ()
    if not instruments:
        return [NOT_TRACEABLE]
    names = dict.fromkeys(name for facts in instruments for name in facts)
    columns = tuple(word_column(name.replace("_", " "), wraps=True) for name in names)
    rows = tuple(tuple(facts.get(name, ABSENT) for name in names) for facts in instruments)
    return [Table("Instruments and their calibration, as stated with the data", columns, rows)]
