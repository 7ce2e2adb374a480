# SPDX-License-Identifier: Apache-2.0
"""The report of a calibration: its sections in the order in which readers ask."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from loopcal.apply.verdict import Verdict
from loopcal.report.calibration_view import (
    build_budget_table,
    build_height_map,
    build_height_summary,
    build_last_value_table,
    build_parameter_table,
    build_share_table,
)
from loopcal.report.document.elements import (
    CalibrationRecord,
    Code,
    Document,
    Element,
    Listing,
    Section,
    describe_call,
    list_options,
)
from loopcal.report.document.figures import (
    compute_accuracy,
    draw_accuracy_picture,
    draw_correlation_picture,
    draw_height_picture,
    draw_parameter_picture,
    draw_residual_picture,
    draw_scene_picture,
    draw_validation_picture,
)
from loopcal.report.validation_view import (
    READING_NOISE,
    describe_commanded,
    describe_improvements,
    view_error_statistics,
    view_errors,
)
from loopcal.results.tables import ABSENT, Table, format_number, word_column

# --- Verdict and scope: may the values be used, what does that cover, and how accurate are poses.

MEANING = {
    Verdict.CALIBRATED: "All quality gates are met, held-out poses were predicted, and there is no "
    "warning. The recommendation below states whether to use the corrected values.",
    Verdict.RESERVATIONS: "All quality gates are met, but the warnings below affect the accuracy "
    "of the corrected values. The recommendation below states whether to use them.",
    Verdict.UNDECIDED: "No quality gate failed, but the held-out poses do not suffice to state the "
    "accuracy at poses that were not fitted.",
    Verdict.NOT_CALIBRATED: "A quality gate is not met. Do not write these values to a machine.",
}
"""What each verdict means for the user."""

SCOPE = (
    "Scope: the verdict concerns the geometry of {robot} in the region and under the conditions of "
    "the measured poses ({fitted} fitted, {held_out} held out). It does not cover errors that did "
    "not act during the measurement, such as those of other loads, temperatures or speeds."
)

CONFORMITY = "conformity."
"""Beginning of the codes of statements on limits."""

OPEN = ("fit.unidentifiable", "fit.hardly", "workflow.undetermined", "workflow.frame", "setup.")
OUTLYING = ("outliers.", "validation.blunder", "validation.unreachable", "fit.excluded", "fit.low")
OF_RESIDUALS = ("noise.", "residuals.", "prior.")
"""Beginnings of the codes of findings that other sections list."""

TOP = 3
"""Findings that this section shows, beside all failures and warnings."""

IMPORTANT = ("refusal", "failure", "warning")


def build_verdict_section(record: CalibrationRecord) -> Section:
    """Return verdict, scope, expected error with its sources, limits, findings and next step."""
    result = record.result
    fitted, held_out = len(record.fitted_labels), len(record.held_out_labels)
    scope = SCOPE.format(
        robot=record.robot.name, fitted=fitted or "an unknown number", held_out=held_out
    )
    elements: list[Element] = [MEANING[record.verdict], scope]
    budget = result.get("expected_error")
    if budget and result.get("states_expected_error"):
        elements.append(budget["finding"]["text"])
        elements.append(build_share_table(budget))
    judged = [f for f in record.findings if f["code"].startswith(CONFORMITY)]
    if judged:
        elements.append(list_findings(judged))
        commanded = "" if record.validation is None else describe_commanded(record.validation)
        elements += [commanded] if commanded else []
    important = [f for f in select_important(record.findings) if f not in judged]
    if important:
        elements.append(list_findings(important))
    recommendation = result.get("recommendation")  # absent in runs of earlier versions
    if recommendation:
        elements.append(f"Recommendation: {recommendation['text']}")
    next_step = result.get("next_step")
    if next_step:
        elements.append(f"Next: {next_step['text']}")
    return Section("verdict", "Verdict and scope", tuple(elements))


def select_important(findings: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return failures and warnings, which other sections repeat, and as many of the others that no
    other section lists as make up TOP.
    """
    listed = list(findings)
    elsewhere = (CONFORMITY, *OPEN, *OUTLYING, *OF_RESIDUALS)
    urgent = [finding for finding in listed if finding["severity"] in IMPORTANT]
    others = [f for f in listed if f not in urgent and not f["code"].startswith(elsewhere)]
    return [*urgent, *others[: max(TOP - len(urgent), 0)]]


def list_findings(findings: Iterable[Mapping[str, Any]]) -> Listing:
    """Return findings with their severity."""
    return Listing(tuple((finding["severity"], finding["text"]) for finding in findings))


# --- Errors at held-out poses, and the accuracy over the workspace.

BASELINE = (
    "Before: the geometry before calibration, with frames, targets, surfaces and offsets fitted to "
    "the rows of the calibration. After: the calibrated geometry. Noise floor: the error that the "
    "stated noise of the measured values alone causes."
)
STATED_FRAME = "The stated frame is the one in which the measurement files state their values."

HEIGHTS = (
    "A height error is the height that a geometry predicts at the recorded readings minus the "
    "measured one: positive where the bed seems too high. Before: the geometry before calibration, "
    "with frames, surfaces and offsets fitted to the rows of the calibration. Errors at fitted "
    "points are optimistic, those at held-out points are not."
)

NOT_HELD_OUT = (
    "No pose was held out of this fit, so the report states no error at poses that were not fitted."
)
NOT_STORED = (
    "This run folder was written by an earlier version, whose errors at held-out poses cannot be "
    "shown here. Repeat the calibration to see them."
)


def build_error_section(record: CalibrationRecord) -> Section:
    """Return the errors at held-out poses before and after, with the noise floor."""
    errors = record.validation
    if errors is None:
        stored = record.result.get("validation")
        reason = NOT_HELD_OUT if not record.held_out_labels else NOT_STORED
        if record.held_out_labels and stored is None:
            reason = "The errors at the held-out poses could not be computed; see the findings."
        return Section("errors", "Errors at held-out poses", (reason,))
    explained = f"{BASELINE} {STATED_FRAME}" if "stated frame" in errors.frame else BASELINE
    if record.result.get("reading_errors"):
        explained = f"{explained} {READING_NOISE}"
    elements: list[Element] = [explained, *view_errors(errors, "held-out")]
    elements += [" ".join(describe_improvements(errors)), *draw_validation_picture(record)]
    elements += [table for table in view_error_statistics(errors) if not isinstance(table, str)]
    return Section("errors", "Errors at held-out poses", tuple(e for e in elements if e))


def build_height_section(record: CalibrationRecord) -> Section:
    """Return the errors of heights over x and y, where heights were measured."""
    heights, title = record.heights, "Height errors"
    if heights is None:
        return Section("heights", title, ())
    tables = (build_height_summary(heights), build_height_map(heights))
    return Section("heights", title, (HEIGHTS, tables[0], *draw_height_picture(record), tables[1]))


def build_workspace_section(record: CalibrationRecord) -> Section:
    """Return the robot with its measured poses, and the uncertainty over its workspace."""
    accuracy = compute_accuracy(record)
    if isinstance(accuracy, str):
        elements = (*draw_scene_picture(record, None), accuracy)
    else:
        elements = (*draw_scene_picture(record, accuracy), *draw_accuracy_picture(record, accuracy))
    return Section("workspace", "Measured poses and accuracy over the workspace", elements)


# --- Parameters with their uncertainty, correlations, and the uncertainty budget.

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


# --- What the data say of the fit: open combinations, outlying rows, residuals, other findings.

NO_RESIDUALS = (
    "This run folder was written by an earlier version and does not contain the labels of its "
    "residuals. Repeat the calibration to see them."
)


def build_open_section(record: CalibrationRecord) -> Section:
    """Return what the data do not determine, and which measurement would determine it."""
    fit = record.result["fit"]
    names = [row["name"] for row in fit["parameters"]]
    elements: list[Element] = []
    if not record.converged:
        elements.append("The fit did not converge, so it does not state what the data determine.")
    elif fit["rank"] == len(names):
        elements.append(f"The data determine all {len(names)} parameters.")
    else:
        elements.append(
            f"The data determine {fit['rank']} of {len(names)} combinations of the parameters."
        )
    stated = [f for f in record.findings if f["code"].startswith(OPEN)]
    if stated:
        elements.append(list_findings(stated))
    elements += [
        f"Suggested measurement: {suggestion['finding']['text']}"
        for suggestion in record.result.get("remedies") or ()
    ]
    return Section("determined", "What the data do not determine", tuple(elements))


def build_outlier_section(record: CalibrationRecord) -> Section:
    """Return which rows do not fit, and which poses were excluded."""
    stated = [f for f in record.findings if f["code"].startswith(OUTLYING)]
    elements: list[Element] = [list_findings(stated)] if stated else []
    excluded = record.result["fit"].get("dropped") or ()
    if excluded:
        elements.append(f"Excluded from the fit by its options: {', '.join(excluded)}.")
    if not elements:
        elements.append("Outlying rows were not searched for, because the fit did not converge.")
    return Section("outliers", "Outlying rows", tuple(elements))


def build_residual_section(record: CalibrationRecord) -> Section:
    """Return the residuals against the noise, in words and as a figure."""
    fit = record.result["fit"]
    elements: list[Element] = []
    if record.converged and fit["degrees"]:
        elements.append(
            f"Chi-square is {format_number(fit['chi_square'], 4)} with "
            f"{format_number(fit['degrees'], 4)} degrees of freedom (p = "
            f"{format_number(fit['p_value'], 2)})."
        )
    elements += _draw_residuals(record)
    stated = [f for f in record.findings if f["code"].startswith(OF_RESIDUALS)]
    if stated:
        elements.append(list_findings(stated))
    return Section("residuals", "Residuals of the fit", tuple(elements))


def _draw_residuals(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the figure of the residuals, and of how many it shows some."""
    if not record.converged:
        return
    if not record.residuals:
        yield NO_RESIDUALS
        return
    yield from draw_residual_picture(record)


def build_finding_section(record: CalibrationRecord) -> Section:
    """Return the findings that no other section shows."""
    shown = (CONFORMITY, *OPEN, *OUTLYING, *OF_RESIDUALS)
    top = [finding["text"] for finding in select_important(record.findings)]
    rest = [
        finding
        for finding in record.findings
        if not finding["code"].startswith(shown) and finding["text"] not in top
    ]
    return Section("findings", "Other findings", (list_findings(rest),) if rest else ())


# --- Values for controllers, where the result comes from, and the poses that it uses.

LINES = 40
"""Lines of a controller's file that the report shows."""

MOST = 3000
"""Labels of poses that the report lists."""

EVERYWHERE = (
    "The command loopcal export writes the parameters to a file: of every robot as csv or json, "
    "and in the formats of controllers that can express it."
)
NO_CONTROLLER = "No format of a controller that loopcal writes can express this robot."
FAILED = "The calibration failed, so the report states no values for a controller."


def build_controller_section(record: CalibrationRecord) -> Section:
    """Return what to write into which controller."""
    title = "Values for the controller"
    if record.verdict is Verdict.NOT_CALIBRATED:
        return Section("controller", title, (FAILED,))
    elements: list[Element] = [] if record.controllers else [NO_CONTROLLER]
    for values in record.controllers:
        lines = values.text.strip("\n").splitlines()
        if len(lines) <= LINES:
            elements.append(Code(f"{values.format}: {values.what}", "\n".join(lines)))
        else:
            sentence = (
                f"{values.format} ({values.what}): {len(lines)} lines, too many for this page"
            )
            elements.append(f"{sentence}; the command loopcal export writes them to a file.")
        if values.notes:
            elements.append(Listing(tuple(("note", note) for note in values.notes)))
    return Section("controller", title, (*elements, EVERYWHERE))


def build_provenance_section(record: CalibrationRecord) -> Section:
    """Return command, versions, seeds, options and digests of the files."""
    made_by = record.result.get("made_by") or {}
    command = " ".join(made_by.get("command") or ()) or "called from Python"
    rows = [
        ("command", command),
        *((_label_version(name), value) for name, value in made_by.get("versions", {}).items()),
        *((f"seed: {name}", str(seed)) for name, seed in made_by.get("seeds", {}).items()),
        ("method", describe_call(str(record.result["fit"].get("method") or "unknown"))),
        *list_options(record.result.get("options")),
    ]
    files = [
        *((f"input: {i}", f["path"], f["sha256"]) for i, f in made_by.get("inputs", {}).items()),
        *(("result", name, digest) for name, digest in record.result.get("files", {}).items()),
    ]
    columns = (word_column("item"), word_column("value", wraps=True))
    elements: list[Element] = [Table("Origin of this result", columns, tuple(rows))]
    if files:
        columns = (
            word_column("role"),
            word_column("file", wraps=True),
            word_column("SHA-256", wraps=True),
        )
        elements.append(Table("Files and their digests", columns, tuple(files)))
    return Section("provenance", "Provenance", tuple(elements))


def _label_version(name: str) -> str:
    """Return the label of an entry of `versions`; that of the engine states its name, too."""
    return name if name == "engine" else f"version of {name}"


def build_pose_section(record: CalibrationRecord) -> Section:
    """Return the labels of the fitted and held-out poses."""
    elements: list[Element] = []
    fitted = record.fitted_labels
    if fitted:
        elements.append(_list_labels("fitted", fitted))
    else:
        elements.append(
            "This run folder was written by an earlier version and does not name its fitted poses."
        )
    if record.held_out_labels:
        elements.append(_list_labels("held-out", record.held_out_labels))
    else:
        elements.append("No pose was held out.")
    return Section("poses", "Fitted and held-out poses", tuple(elements))


def _list_labels(what: str, labels: Sequence[str]) -> str:
    """Return the labels in one sentence; of many the first."""
    count = len(labels)
    noun = "pose" if count == 1 else "poses"
    limit = f", of which the first {MOST:,} are listed" if count > MOST else ""
    return f"{count:,} {what} {noun}{limit}: {', '.join(labels[:MOST])}."


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


def build_calibration_document(record: CalibrationRecord) -> Document:
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
