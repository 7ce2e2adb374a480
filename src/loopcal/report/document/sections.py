# SPDX-License-Identifier: Apache-2.0
"""Documents: the report of a calibration, its sections in the order in which readers ask; several
calibrations side by side; the page of `loopcal view`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from loopcal.apply.calibration_report import Verdict
from loopcal.apply.error_budget import LENGTHS
from loopcal.apply.run_comparison import RunComparison
from loopcal.engine import collect_versions
from loopcal.errors import DataError, suggest_names
from loopcal.findings import sort_by_importance
from loopcal.findings.wording import FINE, SMALL, list_names, name_count
from loopcal.mechanism.model import Mechanism
from loopcal.report import calibration_view, validation_view
from loopcal.report.document import figures
from loopcal.report.document.elements import (
    CalibrationRecord,
    Code,
    Document,
    Element,
    Form,
    Listing,
    Picture,
    Section,
    list_options,
)
from loopcal.report.figures.result_figures import (
    draw_run_errors,
    draw_run_parameters,
    draw_run_shifts,
)
from loopcal.report.scene.scene import Scene, draw_scene, format_scene
from loopcal.report.words import say
from loopcal.results.tables import (
    ABSENT,
    Column,
    choose_unit,
    format_in,
    format_number,
    make_table,
    word_column,
)
from loopcal.units import Dimension, Unit

Describe = Callable[[CalibrationRecord], Iterator[Element | None]]
# Name of a section -> its title, and the function that yields its elements, and None where its
# figures are; without None they are at the end.
SECTIONS: dict[str, tuple[str, Describe]] = {}


def describes_section(name: str, title: str) -> Callable[[Describe], Describe]:
    """Return a decorator of the function that yields the elements of the next section."""

    def add(describe: Describe) -> Describe:
        SECTIONS[name] = (title, describe)
        return describe

    return add


def build_sections(record: CalibrationRecord, names: Iterable[str]) -> tuple[Section, ...]:
    """Return the sections of these names; one without content is left out.

    DataError : a figure belongs to a section that does not exist.
    """
    for name in figures.FIGURES.values():
        if name not in SECTIONS:
            raise DataError(
                f"a figure belongs to the section {name!r}, which the report does not have"
                f"{suggest_names(name, SECTIONS)}; it has {', '.join(SECTIONS)}"
            )
    sections = []
    for name in names:
        title, describe = SECTIONS[name]
        described = list(describe(record))
        elements: list[Element] = []
        for element in described if None in described else [*described, None]:
            elements += figures.draw_figures(name, record) if element is None else [element]
        sections.append(Section(name, title, tuple(elements)))
    return tuple(section for section in sections if section.elements)


# The page to sign: what was calibrated, by whom and how, the result, and the decision rule.

SIGNATURE = ("signed by", "issued")  # facts at the end of the page


@describes_section("summary", "Calibration result")
def describe_summary(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the page to sign."""
    facts, volume = record.facts, record.result.get("volume") or {}
    instruments = record.result.get("instruments") or ()
    kinds = list_names(tuple(dict.fromkeys(rows.kind for rows in record.residuals)))
    method = say(
        "summary.method",
        parameters=len(record.result["fit"]["parameters"]),
        kinds=kinds or "unknown",
        fitted=len(record.fitted_labels),
        held_out=len(record.held_out_labels),
    )
    stated = {
        **{name: text for name, text in facts.items() if name not in SIGNATURE},
        "machine": facts.get("machine") or record.robot.name,
        "instrument": "; ".join(map(_name_instrument, instruments)),
        "method": method,
    }
    yield Form(tuple(stated.items()))
    columns = ("error", *map(Column, ("before", "after", "limit")), "decision")
    result = make_table("Result", columns, _list_results(record))
    yield result if result.rows else say("summary.no-result")
    yield from select_findings(record, (CONFORMITY,))  # with their uncertainty (ISO/IEC 17025)
    judged = [each for each in (volume, record.result.get("validation") or {}) if each]
    decided = [c for each in judged if (c := each.get("conformity"))]  # one, or by quantity
    rules = [rule for c in decided for rule in ([c] if "rule" in c else c.values())]
    yield say("summary.volume", **volume) if volume else say("summary.no-volume")
    yield say("summary.rule", **rules[0]) if rules else say("summary.no-rule")
    yield say("summary.validity")
    yield Form((*((name, facts.get(name, "")) for name in SIGNATURE), ("signature", "")))


def _name_instrument(facts: Mapping[str, str]) -> str:
    """Return an instrument with its serial number and certificate."""
    made = " ".join(filter(None, (facts.get("manufacturer"), facts.get("model"))))
    known = {"serial number ": "serial_number", "certificate ": "certificate", "of ": "laboratory"}
    known |= {"calibrated ": "calibrated", "due ": "due"}
    texts = [f"{words}{facts[key]}" for words, key in known.items() if facts.get(key)]
    return ", ".join([made or facts.get("name") or "instrument", *texts])


def _list_results(record: CalibrationRecord) -> Iterator[tuple[str, ...]]:
    """Yield error, before, after, limit and decision, in the order of what they tell of the use.

    Numbers of a quantity have one unit, by the smallest error after calibration: um below 0.1 mm.
    """
    stated = list(_list_errors(record))
    units: dict[str, Unit] = {}
    for quantity, dimension in LENGTHS.items():
        after = [min((abs(x) for _, of, _, x, _ in stated if of == quantity and x), default=0.0)]
        small = FINE if dimension is Dimension.LENGTH else SMALL
        units[quantity] = choose_unit(record.robot.get_unit(dimension), after, small)
    for words, quantity, before, after, judged in stated:
        limit = judged["limit"] if judged else None
        numbers = (
            ABSENT if x is None or not math.isfinite(x) else f"{format_in(unit, x, 3)} {unit}"
            for unit in [units[quantity]]
            for x in (before, after, limit)
        )
        yield words, *numbers, judged["decision"] if judged else ABSENT


def _list_errors(
    record: CalibrationRecord,
) -> Iterator[tuple[str, str, float | None, float | None, Mapping[str, Any] | None]]:
    """Yield words, quantity, error before and after [SI], and statement on a limit."""
    if volume := record.result.get("volume"):
        words = "position, upper bound in the working volume (coverage probability 95 %)"
        yield words, "position", None, volume["simultaneous"], volume.get("conformity")
    errors = record.result.get("validation") or {}
    poses = name_count(len(record.held_out_labels), "held-out pose")
    for quantity in (name for name in LENGTHS if name in errors.get("after", ())):
        before, after = (errors[when][quantity] for when in ("before", "after"))
        decision = (errors.get("conformity") or {}).get(quantity)
        for key, name, judged in (("max", "largest", decision), ("rms", "root mean square", None)):
            yield f"{quantity}, {name} at {poses}", quantity, before[key], after[key], judged
    repeated = record.result.get("repeatability") or {}
    for symbol, words in ISO_9283.items():
        poses_visited = repeated.get("position") or ()
        values = [pose[symbol]["value"] for pose in poses_visited if symbol in pose]
        if values:
            name = f"{words}, largest of {len(values)} (ISO 9283)"
            yield name, "position", None, max(values), None


# Key of a characteristic of visited poses -> words.
ISO_9283 = {"AP_p": "pose accuracy AP of positions", "RP_l": "pose repeatability RP of positions"}


# Verdict and scope: may the values be used, what does that cover, and how accurate are poses.

CONFORMITY = "conformity."  # beginning of the codes of statements on limits
OPEN = ("fit.unidentifiable", "fit.hardly", "workflow.undetermined", "workflow.frame", "setup.")
OUTLYING = ("outliers.", "validation.blunder", "validation.unreachable", "fit.excluded", "fit.low")
OF_PARAMETERS = ("prior.", "residuals.correlated-parameters")
# Beginnings of the codes of findings that other sections list, each in the first that has it.
OF_RESIDUALS = ("noise.", "residuals.")
# Beginnings of the codes of all findings that have a section.
ELSEWHERE = (CONFORMITY, *OPEN, *OUTLYING, *OF_PARAMETERS, *OF_RESIDUALS)
TOP = 3  # findings that this section shows, beside all failures and warnings
IMPORTANT = ("refusal", "failure", "warning")


@describes_section("verdict", "Verdict and scope")
def describe_verdict(record: CalibrationRecord) -> Iterator[Element]:
    """Yield verdict, scope, expected error with its sources, limits, findings and next step."""
    result = record.result
    is_missed = record.verdict is Verdict.RESERVATIONS and result.get("passed") is False
    yield say(f"verdict.{'limit-missed' if is_missed else record.verdict.name.lower()}")
    yield say(
        "verdict.scope",
        robot=record.robot.name,
        fitted=len(record.fitted_labels),
        held_out=len(record.held_out_labels),
    )
    budget = result.get("expected_error")
    if budget and result.get("states_expected_error"):
        yield budget["finding"]["text"]
        yield calibration_view.build_share_table(budget)
    judged = [f for f in record.findings if f["code"].startswith(CONFORMITY)]
    if judged and record.validation is not None:
        yield from filter(None, [validation_view.describe_commanded(record.validation)])
    yield from list_findings(f for f in select_important(record.findings) if f not in judged)
    if recommendation := result["recommendation"]:
        yield f"Recommendation: {recommendation['text']}"
    if next_step := result.get("next_step"):
        yield f"Next: {next_step['text']}"


def select_important(findings: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return failures and warnings, which other sections repeat, and as many of the others that no
    other section lists as make up TOP.
    """
    listed = list(findings)
    urgent = [finding for finding in listed if finding["severity"] in IMPORTANT]
    others = [f for f in listed if f not in urgent and not f["code"].startswith(ELSEWHERE)]
    return [*urgent, *others[: max(TOP - len(urgent), 0)]]


def list_findings(findings: Iterable[Mapping[str, Any]]) -> list[Element]:
    """Return findings with their severity as an element; none without any."""
    items = tuple((finding["severity"], finding["text"]) for finding in findings)
    return [Listing(items)] if items else []


def select_findings(record: CalibrationRecord, codes: tuple[str, ...]) -> list[Element]:
    """Return the findings whose codes begin so as an element."""
    return list_findings(f for f in record.findings if f["code"].startswith(codes))


# Errors at held-out poses, and the accuracy over the workspace.


@describes_section("errors", "Errors at held-out poses")
def describe_errors(record: CalibrationRecord) -> Iterator[Element | None]:
    """Yield the errors at held-out poses before and after, with the noise floor."""
    errors = record.validation
    if errors is None:
        yield say(f"errors.not-{'computed' if record.held_out_labels else 'held-out'}")
        return
    explained = say("errors.baseline", is_stated_frame="stated frame" in errors.frame)
    noted = [say("errors.reading-noise")] if record.result.get("reading_errors") else []
    yield " ".join((explained, *noted))
    yield from validation_view.view_errors(errors, "held-out")
    yield from filter(None, [" ".join(validation_view.describe_improvements(errors))])
    yield from (
        table
        for table in validation_view.view_error_statistics(errors)
        if not isinstance(table, str)
    )


@describes_section("heights", "Height errors")
def describe_heights(record: CalibrationRecord) -> Iterator[Element | None]:
    """Yield the errors of heights over x and y, where heights were measured."""
    if record.heights is not None:
        yield say("errors.heights")
        yield calibration_view.build_height_summary(record.heights)
        yield None
        yield calibration_view.build_height_map(record.heights)


@describes_section("repeatability", "Pose accuracy and repeatability")
def describe_repeatability(record: CalibrationRecord) -> Iterator[Element]:
    """Yield AP and RP by ISO 9283 of positions, where poses were visited several times."""
    stated = record.result.get("repeatability") or {}
    visited = [pose for pose in stated.get("position") or () if ISO_9283.keys() <= pose.keys()]
    if not visited:
        return
    sizes = [value for pose in visited for symbol in ISO_9283 for value in pose[symbol].values()]
    unit = choose_unit(record.robot.shown_units[Dimension.LENGTH], sizes)
    held_out = set(record.held_out_labels)
    where = "held-out" if visited[0]["pose"] in held_out else "fitted, so AP is optimistic"
    columns = [Column(f"{name} [{unit}]") for name in ("AP", "from", "to", "RP", "from", "to")]
    rows = (
        (
            pose["pose"],
            pose["target"] or ABSENT,
            str(pose["visits"]),
            *(format_in(unit, value, 3) for symbol in ISO_9283 for value in pose[symbol].values()),
        )
        for pose in visited
    )
    caption = f"ISO 9283 with intervals of 95 %, {stated['frame']}. Poses: {where}."
    yield make_table(caption, ("pose", "target", Column("visits"), *columns), rows)


@describes_section("workspace", "Measured poses and accuracy over the workspace")
def describe_workspace(record: CalibrationRecord) -> Iterator[Element | None]:
    """Yield the robot with its measured poses, and the uncertainty over its workspace."""
    yield None


# Parameters with their uncertainty, correlations, and the uncertainty budget.


@describes_section("budget", "Uncertainty budget")
def describe_budget(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the uncertainty budget by source, and the stated facts of each instrument."""
    budget = record.result.get("expected_error")
    if not budget:
        yield say("budget.none")
    else:
        yield say("budget.terms")
        if not record.result.get("states_expected_error"):
            yield say("budget.not-expected")
        yield from calibration_view.build_gum_tables(budget, record.robot)
        yield calibration_view.build_budget_table(budget, record.robot)
    stated = (record.result.get("volume") or {}).get("findings", ())
    yield from (f["text"] for f in stated if not f["code"].startswith(CONFORMITY))
    instruments = record.result.get("instruments") or ()
    if not instruments:
        yield say("budget.not-traceable")
        return
    names = dict.fromkeys(name for facts in instruments for name in facts)
    columns = (word_column(name.replace("_", " "), wraps=True) for name in names)
    rows = ((facts.get(name, ABSENT) for name in names) for facts in instruments)
    yield make_table("Instruments and their calibration, from the data files", columns, rows)


@describes_section("parameters", "Parameters")
def describe_parameters(record: CalibrationRecord) -> Iterator[Element | None]:
    """Yield the parameters, the setup parameters, figures of shifts and correlations, and what was
    found about tolerances and correlations.
    """
    fit = record.result["fit"]
    if not record.converged:
        yield calibration_view.build_last_value_table(fit["parameters"])
    else:
        yield say("parameters.terms")
        yield calibration_view.build_parameter_table(
            "Identified parameters", fit["parameters"], is_complete=True
        )
        if fit.get("interval_note"):
            yield fit["interval_note"]
        if fit.get("local"):
            yield calibration_view.build_parameter_table("Setup parameters", fit["local"])
    yield None  # figures before text, which fills what they leave of a page
    yield from select_findings(record, OF_PARAMETERS)


# What the data leave open: undetermined combinations, outlying rows and residuals.


@describes_section("determined", "What the data do not determine")
def describe_open_combinations(record: CalibrationRecord) -> Iterator[Element]:
    """Yield what the data do not determine, and which measurement would determine it."""
    count, rank = len(record.result["fit"]["parameters"]), record.result["fit"]["rank"]
    known = ("all" if rank == count else "some") if record.converged else "not-converged"
    yield say(f"determined.{known}", rank=rank, count=count)
    stated = [finding for finding in record.findings if finding["code"].startswith(OPEN)]
    found = [finding for finding in stated if finding["code"] in calibration_view.COMBINATIONS]
    shown = [f for f in found if not f["data"].get("meaning")][: calibration_view.MOST_COMBINATIONS]
    yield from list_findings(f for f in stated if f in shown or f not in found)
    if others := len(found) - len(shown):
        yield say("determined.others", others=others)
    named = [set(finding["data"]["names"]) for finding in shown]
    for suggestion in record.result.get("remedies") or ():
        if set(suggestion["names"]) in named:
            yield f"Suggested measurement: {suggestion['finding']['text']}"


@describes_section("outliers", "Outlying rows")
def describe_outliers(record: CalibrationRecord) -> Iterator[Element]:
    """Yield which rows do not fit, and which poses were excluded."""
    stated = select_findings(record, OUTLYING)
    yield from stated
    if excluded := record.result["fit"].get("dropped"):
        yield f"Excluded from the fit by its options: {', '.join(excluded)}."
    elif not stated:
        yield say("outliers.not-searched")


@describes_section("residuals", "Residuals of the fit")
def describe_residuals(record: CalibrationRecord) -> Iterator[Element | None]:
    """Yield the residuals against the noise, in words and as a figure."""
    fit = record.result["fit"]
    if record.converged and fit["degrees"]:
        square, degrees = (format_number(fit[key], 4) for key in ("chi_square", "degrees"))
        p_value = format_number(fit["p_value"], 2)
        u = fit["sigma_uncertainty"] if fit["noise"] == "given" else 0.0
        yield say("residuals.test", square=square, degrees=degrees, p_value=p_value, u=u)
    yield None
    of_residuals = (f for f in record.findings if not f["code"].startswith(OF_PARAMETERS))
    yield from list_findings(f for f in of_residuals if f["code"].startswith(OF_RESIDUALS))


# Values for controllers, where the result comes from, and the poses that it uses.

LINES = 40  # lines of a controller's file that the report shows
MOST = 3000  # labels of poses that the report lists


@describes_section("controller", "Values for the controller")
def describe_controllers(record: CalibrationRecord) -> Iterator[Element]:
    """Yield what to write into which controller."""
    if record.verdict is Verdict.NOT_CALIBRATED:
        yield say("controller.failed")
        return
    if not record.controllers:
        yield say("controller.none")
    noted = [note for values in record.controllers for note in values.notes]
    of_all = {note for note in noted if 1 < noted.count(note) == len(record.controllers)}
    for values in record.controllers:
        lines = values.text.strip("\n").splitlines()
        if len(lines) <= LINES:
            yield Code(f"{values.format}: {values.what}", "\n".join(lines))
        else:
            facts = {"format": values.format, "what": values.what}
            yield say("controller.too-long", lines=len(lines), **facts)
        if notes := tuple(("note", note) for note in values.notes if note not in of_all):
            yield Listing(notes)
    if of_all:
        yield Listing(tuple(("note", note) for note in sorted(of_all)))
    yield say("controller.everywhere")


@describes_section("findings", "Other findings")
def describe_other_findings(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the findings that no other section shows."""
    top = [finding["text"] for finding in select_important(record.findings)]
    rest = (f for f in record.findings if not f["code"].startswith(ELSEWHERE))
    yield from list_findings(f for f in rest if f["text"] not in top)


@describes_section("provenance", "Provenance")
def describe_provenance(record: CalibrationRecord) -> Iterator[Element]:
    """Yield command, versions, seeds, options and digests of the files."""
    made_by = record.result["made_by"]
    versions = made_by.get("versions", {}).items()
    method = str(record.result["fit"]["method"]).partition("(")[0]  # settings are options
    rows = [
        ("command", " ".join(made_by["command"]) or "called from Python"),
        *((n if n == "engine" else f"version of {n}", value) for n, value in versions),
        *((f"seed: {name}", str(seed)) for name, seed in made_by.get("seeds", {}).items()),
        ("method", method),
        *list_options(record.result["options"]),
    ]
    value, file, digest = (word_column(t, wraps=True) for t in ("value", "file", "SHA-256"))
    yield make_table("Origin of this result", ("item", value), rows)
    files = [
        *((f"input: {i}", f["path"], f["sha256"]) for i, f in made_by["inputs"].items()),
        *(("result", *each) for each in record.result.get("files", {}).items()),
    ]
    if files:
        yield make_table("Files and their digests", ("role", file, digest), files)


@describes_section("poses", "Fitted and held-out poses")
def describe_poses(record: CalibrationRecord) -> Iterator[Element]:
    """Yield the labels of the fitted and held-out poses."""
    yield _list_labels("fitted", record.fitted_labels)
    yield _list_labels("held-out", record.held_out_labels) or say("poses.none")


def _list_labels(what: str, labels: Sequence[str]) -> str:
    """Return the labels in one sentence; of many the first; empty without any."""
    count = f"{len(labels):,} {what} {'pose' if len(labels) == 1 else 'poses'}"
    limit = f", here the first {MOST:,}" if len(labels) > MOST else ""
    return f"{count}{limit}: {', '.join(labels[:MOST])}." if labels else ""


def build_calibration_document(record: CalibrationRecord) -> Document:
    """Return the report of a calibration."""
    return replace(build_head(record), sections=build_sections(record, SECTIONS))


def build_head(record: CalibrationRecord) -> Document:
    """Return a document without sections."""
    return Document(
        title=f"Calibration report: {record.robot.name}",
        verdict=record.verdict.name.lower(),
        summary=str(record.result["headline"]),
        made_by=describe_maker(record.result["made_by"].get("versions", {})),
        sections=(),
    )


def describe_maker(versions: Mapping[str, str]) -> str:
    """Return program and version, of the versions that a run names."""
    return f"loopcal {versions.get('loopcal', '')}".strip()


# Several calibrations side by side: result, parameters, shifts, held-out errors.

# Whether a machine has changed -> the color of the head, as of a verdict.
HEADS: Mapping[bool | None, str] = {True: "not_calibrated", False: "calibrated", None: "undecided"}
# The same -> the name of the sentence below the title.
SUMMARIES: Mapping[bool | None, str] = {True: "changed", False: "equal", None: "untested"}


def build_comparison_document(comparison: RunComparison, made_by: str) -> Document:
    """Return a comparison as a document; made_by : program and version."""
    names, first = ", ".join(run.name for run in comparison.runs), comparison.runs[0].name
    result: list[Element] = [say("comparison.meaning")]
    if findings := sort_by_importance(comparison.findings):  # the most important first
        result.append(Listing(tuple((f.severity.value, str(f)) for f in findings)))
    columns = (word_column(title, wraps=True) for title in ("run", "robot, verdict, method"))
    result.append(make_table("The compared runs", columns, validation_view.list_runs(comparison)))
    estimates = figures.show_figure(draw_run_parameters(comparison), "estimates-figure")
    shifts: list[Element] = [say("comparison.no-shift")]
    if any(pair.moved is not None for pair in comparison.pairs):
        figure = figures.show_figure(draw_run_shifts(comparison), "shift-figure")
        shifts = [figure, validation_view.build_shifts(comparison)]
    errors: list[Element] = [validation_view.build_errors(comparison)]
    if any(run.common or run.own for run in comparison.errors):
        errors.append(figures.show_figure(draw_run_errors(comparison), "errors-figure"))
    sections: dict[tuple[str, str], list[Element]] = {
        ("result", "Changes of the machine"): result,
        ("parameters", "Parameters side by side"): [
            validation_view.build_estimates(comparison),
            estimates,
        ],
        ("shifts", "Shifts in standard deviations"): shifts,
        ("errors", "Held-out errors"): errors,
    }
    return Document(
        title=f"Comparison of calibrations: {names}",
        verdict=HEADS[comparison.moved],
        summary=say(f"comparison.{SUMMARIES[comparison.moved]}", first=first),
        made_by=made_by,
        sections=tuple(Section(*named, tuple(each)) for named, each in sections.items()),
    )


# The page of `loopcal view`: a robot in space, of a calibration with its poses and errors.


def build_robot_view(robot: Mechanism) -> Document:
    """Return the view of a robot at home."""
    return Document(
        title=f"3-D view: {robot.name}",
        verdict="",
        summary=f"{robot.name} at its home pose.",
        made_by=describe_maker(collect_versions()),
        sections=(Section("view", "The robot", (_draw_home(robot),)),),
    )


def build_calibration_view(record: CalibrationRecord) -> Document:
    """Return the view of a calibration; of a fit that did not converge, the robot before it."""
    elements = [*figures.draw_scene_picture(record)]
    if record.converged and isinstance(reason := figures.compute_accuracy(record), str):
        elements.append(reason)
    if all(isinstance(element, str) for element in elements):
        elements.append(_draw_home(record.robot if record.converged else record.initial))
    section = Section("view", "The robot and its measured poses", tuple(elements))
    title = f"3-D view: {record.robot.name}"
    return replace(build_head(record), title=title, sections=(section,))


def _draw_home(robot: Mechanism) -> Picture:
    """Return a robot at home."""
    scene = Scene(robot)
    return figures.show_figure(
        draw_scene(scene), "scene-figure", format_scene(scene), words="home-figure"
    )
