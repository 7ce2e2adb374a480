# SPDX-License-Identifier: Apache-2.0
"""Files: robot files and those of other programs, controllers and instruments, written, checked,
viewed and read; the files of an example; completion of commands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

import loopcal as lc
from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.hints import suggest_command, with_hint
from loopcal.cli.terminal import Output
from loopcal.errors import DataError
from loopcal.findings import report_finding
from loopcal.findings.wording import name_count
from loopcal.units import Dimension, find_unit, list_symbols

if TYPE_CHECKING:
    from loopcal.results.tables import Block

# Kind of file, or output of all commands -> what makes its JSON Schema.
SCHEMAS = {
    "robot": "loopcal.io.file_schemas:build_robot_schema",
    "settings": "loopcal.io.file_schemas:build_settings_schema",
    "profile": "loopcal.io.file_schemas:build_profile_schema",
    "study": "loopcal.studies.files.study_file:build_study_schema",
    "output": "loopcal.cli.terminal:read_output_schema",
}


@opt.command()
def new(
    family: str | None = opt.argument("[FAMILY]", required=False),
    output: Path | None = opt.path("Robot file to write, which names the robot.", "-o"),
    measurements: Path | None = opt.path("Also write a measurement file with columns but no rows."),
    report_facts: Path | None = opt.path(
        "Write a file to fill in with facts for reports and certificates, such as customer and "
        "serial number. Needs no FAMILY."
    ),
    unknown: dict[str, Any] = opt.UNKNOWN,
    instrument: dict[str, Any] = opt.INSTRUMENT,
    force: bool = opt.force("an output file"),
) -> Output:
    """Write a robot file of FAMILY: gough, linear-delta, 3-prs, ru-pus-prs, limbs, stages, or the
    name of a shipped robot.

    The file contains a complete robot. Replace its numbers with your own. The options of the
    instrument are for --measurements.

    Examples:
      loopcal new gough -o my-hexapod.yaml --measurements tracker.csv
      loopcal new linear-delta -o printer.yaml --measurements heights.csv \\
          --kind component --components z
      loopcal new gough -o my-hexapod.yaml --measurements tracker.csv \\
          --kind position --targets SMR1,SMR2,SMR3 --frames base --sigma-position 15um
      loopcal new --report-facts facts.yaml
    """
    from loopcal.io.core.csv_table import refuse_settings_beside
    from loopcal.io.core.limits import make_name
    from loopcal.io.core.outputs import refuse_outputs, write_files
    from loopcal.io.core.text_file import to_json
    from loopcal.io.core.yaml_file import parse_yaml
    from loopcal.io.data.measurement_file import format_template
    from loopcal.io.robot.robot_file import EDITOR_SCHEMA, build_robot, format_new_robot
    from loopcal.io.runs.certificate import read_template

    stated = unknown | instrument
    opt.make_instrument(stated)  # refuses wrong options before anything is written
    refuse_outputs((output, measurements, report_facts), (), force)
    texts: dict[Path, str] = {}
    page: list[Block] = []
    following: list[Block] = []
    if family is not None and output is not None:
        texts[output] = format_new_robot(family, make_name(output.stem))
        robot = build_robot(parse_yaml(texts[output], output, "robot file"))
        template = format_template(robot, opt.make_instrument(stated, robot))
        schema_file = output.with_name(EDITOR_SCHEMA)
        if not schema_file.exists():
            texts[schema_file] = to_json(opt.look_up(SCHEMAS["robot"])())
        page.append(f"{output}: a complete robot. Replace its numbers with yours.")
        page.append(f"{schema_file}: the keys of robot files, which editors complete and check.")
        following = [suggest_command("check", output)]
        if measurements is not None:
            refuse_settings_beside(measurements)
            texts[measurements] = template
            page.append(f"{measurements}: columns without rows. Fill in your measurements.")
            following = [suggest_command("calibrate", output, measurements, "-o", "run")]
    elif family or output or measurements or report_facts is None:
        raise DataError("a new robot file needs FAMILY and -o. Give both")
    if report_facts is not None:
        texts[report_facts] = read_template()
        page.append(f"{report_facts}: facts for reports and certificates. Fill in what you know.")
        following = following or [
            suggest_command("report", "run", "--facts", report_facts, "--pdf")
        ]
    write_files(texts)
    written = {"robot": output, "measurements": measurements, "report_facts": report_facts}
    return Output(written, lambda: [*page, *following])


@opt.command()
def schema(
    file: str = opt.argument("KIND", type=click.Choice(list(SCHEMAS))),
    output: Path | None = opt.path("File to write. Default: standard output.", "-o"),
    force: bool = opt.force("the file"),
) -> Output:
    """Print the JSON Schema of a kind of file: robot, settings (of a measurement file), profile or
    study. Of output: of the documents that commands print with --json.

    An editor with the schema completes keys, shows their meaning and marks mistakes. The first line
    of a file from `loopcal new` names it.

    Examples:
      loopcal schema robot -o robot.schema.json
      loopcal schema study > study.schema.json
    """
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.core.text_file import to_json, write_text

    content = opt.look_up(SCHEMAS[file])()
    if output is None:
        return Output(content, lambda: to_json(content))
    refuse_outputs((output,), (), force)
    write_text(output, to_json(content))
    return Output({"schema": output}, lambda: [f"Written to {output}"])


@opt.command()
def check(
    robot: str = opt.ROBOT,
    plot: Path | None = opt.path(
        "Draw the robot at home into FILE (.png, .svg or .pdf).", metavar="FILE"
    ),
    force: bool = opt.force("the picture"),
    expand: bool = opt.flag("Also show links, joints, transmissions, and how parameters enter."),
) -> Output:
    """Read ROBOT, a robot file or the name of a shipped robot, and show its actuators and
    parameters.

    Errors in the file (units, joints, dimensions, mobility) have a line number.

    Examples:
      loopcal check hexapod-42
      loopcal check my-robot.yaml --json
      loopcal check linear-delta --expand
      loopcal check 3-prs --plot 3-prs.png
    """
    from loopcal.apply.inspection import inspect_robot
    from loopcal.io.core.text_file import write_bytes
    from loopcal.results.serialization import json_fields

    inspection = inspect_robot(opt.open_robot(robot, (plot,), (), force))
    if plot is not None:
        from loopcal.report.pictures import save_figure
        from loopcal.report.scene.scene import draw_robot

        save_figure(plot, draw_robot(inspection.robot), write=write_bytes)

    def view() -> list[Block]:
        from loopcal.report.robot_view import view_assembly, view_robot

        page = view_robot(inspection)
        page += view_assembly(inspection.robot) if expand else []
        return page if plot is None else [*page, "", f"Picture: {plot}"]

    assembly = {"assembly": inspection.robot.assembly} if expand else {}
    return Output(json_fields(inspection) | assembly, view)


@opt.command()
def view(
    source: str = opt.argument("RUN|ROBOT", shell_complete=opt.complete_robot),
    output: Path = opt.path("HTML file to write, with a name in .html.", "-o", default="view.html"),
    no_browser: bool = opt.flag("Do not open the view in the browser."),
    force: bool = opt.force("the output file"),
) -> Output:
    """Show RUN, a run folder, or a robot file as an interactive 3-D view in the browser.

    The view is one HTML file that needs no network. It shows the robot at home. For a run, it also
    shows the measured poses, with the position errors before calibration and the uncertainty over
    the workspace.

    If the calibration of RUN failed, the view says so and the exit code is 2.

    Examples:
      loopcal view hexapod-42
      loopcal view run -o hexapod.html --no-browser
    """
    from loopcal.documents import check_ending, open_page, save_view
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.runs.run_folder import load_run_or_robot

    check_ending(output, "view")
    run = load_run_or_robot(source)
    files = [Path(source) / name for name in run.result.get("files", {})]
    refuse_outputs((output,), files or (Path(source),), force)
    with terminal.TerminalProgress("writing the view"):
        save_view(run if run.result else run.robot, output)
    is_open = not no_browser and open_page(output.resolve().as_uri())
    failures = [] if run.failure is None else [run.failure]
    unopened = "" if is_open or no_browser else ", but no browser starts here"
    document = {"output": output, "opened": is_open, "reasons": failures}
    return Output(document, lambda: [f"Written to {output}{unopened}"], failures)


@opt.command()
def example(
    name: str | None = opt.argument("[NAME]", required=False),
    output: Path | None = opt.path("Folder to make. Default: the name of the example.", "-o"),
) -> Output:
    """Write the files of an example into a new folder. Without NAME, list the examples.

    Examples:
      loopcal example
      loopcal example hexapod-42
      loopcal example delta-printer -o printer
    """
    from loopcal.io.example_folders import describe_example, list_examples, write_example
    from loopcal.results.tables import Table, word_column

    if name is None:
        titles = {name: describe_example(folder) for name, folder in list_examples().items()}
        columns = (word_column("example"), word_column("content", wraps=True))
        table = Table("Examples: loopcal example NAME writes one", columns, tuple(titles.items()))
        return Output({"examples": titles}, lambda: [table])
    folder = Path(name) if output is None else output
    files = write_example(name, folder)
    document = {"example": name, "folder": str(folder), "files": files}
    return Output(document, lambda: [f"Written to {folder}: {', '.join(files)}"])


@opt.command()
def completion(shell: str = opt.argument(type=click.Choice(("bash", "zsh", "fish")))) -> Output:
    """Print the script with which SHELL completes commands, options, names of robots and files.

    Add to the start-up file of your shell:
      bash  ~/.bashrc                        eval "$(loopcal completion bash)"
      zsh   ~/.zshrc                         eval "$(loopcal completion zsh)"
      fish  ~/.config/fish/config.fish       loopcal completion fish | source

    Examples:
      loopcal completion bash
    """
    from click.shell_completion import get_completion_class

    from loopcal.cli.entry_point import command_line

    writer = get_completion_class(shell)
    assert writer is not None  # click has one for each of these shells
    script = writer(command_line, {}, "loopcal", "_LOOPCAL_COMPLETE")
    text = script.source_template % script.source_vars()
    return Output({"shell": shell, "script": text}, lambda: text)


SHOWN = 20  # lines that do not match a profile that are listed


@opt.command()
def gcode(
    robot: str = opt.ROBOT,
    plan: Path = opt.argument("PLAN", type=opt.FILE),
    feed: float | None = opt.option(
        "Feed per minute, in the unit of the program.  [default: 300 mm, in inches as fast]",
        type=opt.POSITIVE,
        metavar="NUMBER",
    ),
    pause: float | None = opt.option(
        "Time to wait at each pose (G4).  [default: stop until the operator continues, M0]",
        type=opt.POSITIVE,
        metavar="SECONDS",
    ),
    unit: Literal["mm", "in"] | None = opt.option(
        "Unit of lengths in the program.  [default: unit of ROBOT, or mm]",
        type=click.Choice(("mm", "in")),
    ),
    output: Path = opt.path("Program to write, such as poses.ngc.", "-o", required=True),
    force: bool = opt.force("the output file"),
) -> Output:
    """Write G-code that moves ROBOT to the poses of PLAN, a folder or its plan.csv, in order.

    The program starts at home, waits at each pose, passes home as the plan does, and returns to
    home. X Y Z A B C are machine coordinates (G53) of the platform. Each straight path is checked
    for strokes, joint limits and singularities.

    Examples:
      loopcal gcode hexapod.yaml plan -o poses.ngc
      loopcal gcode hexapod.yaml plan -o poses.ngc --feed 600 --pause 5
    """
    from loopcal.io.core.text_file import write_text
    from loopcal.io.formats import gcode_program
    from loopcal.planning.path import check_route

    machine = opt.open_robot(robot, (output,), (plan,), force)
    is_in_inches = machine.units[Dimension.LENGTH] == "in"
    program_unit: Literal["mm", "in"] = unit or ("in" if is_in_inches else "mm")
    feed_unit = find_unit(program_unit).factor_to_si / 60.0  # [m/s]
    speed = gcode_program.DEFAULT_FEED if feed is None else feed * feed_unit
    stops = gcode_program.read_stops(plan, machine)
    labels, _, coordinates = stops
    home = check_route(machine, labels, coordinates)
    text = gcode_program.format_gcode(machine, stops, home, speed, pause, program_unit)
    write_text(output, text)
    counts = {"stops": len(labels), "unit": program_unit}
    page = [f"{output}: {counts['stops']} stops, lengths in {program_unit}"]
    return Output({"program": output, **counts}, lambda: page)


@opt.command()
def fill(
    robot: str = opt.ROBOT,
    sheet: Path = opt.argument("SHEET", type=opt.FILE),
    exports: tuple[Path, ...] = opt.argument("EXPORT...", type=opt.FILE, nargs=-1, required=True),
    profile: str = opt.profile("How to read EXPORT.", required=True),
    unit: str | None = opt.option(
        "Unit of lengths in EXPORT.  [default: from the profile]",
        type=click.Choice(list_symbols(Dimension.LENGTH)),
    ),
    decimal: str | None = opt.DECIMAL,
    by_order: bool = opt.flag(
        "Ignore names: EXPORT has the points of all targets of the first pose, then of the "
        "second, and so on."
    ),
    one_session: bool = opt.flag(
        "Several EXPORTs: the instrument stayed in place between them. Otherwise each is a session."
    ),
    allow_implausible: bool = opt.flag(
        "Accept points far from the expected place, or in another unit."
    ),
    output: Path = opt.path("Measurement file to write.", "-o", required=True),
    force: bool = opt.force("the output file"),
) -> Output:
    """Fill in SHEET, the measurements.csv of a plan of ROBOT, with the points of an instrument's
    EXPORT.

    Points have names POSE_TARGET, such as 12_SMR1. The command lists missing, unknown and repeated
    points, and refuses points at the place of others.

    Examples:
      loopcal fill hexapod.yaml plan/measurements.csv points.txt --profile spatial-analyzer \\
          -o measured.csv
      loopcal fill hexapod.yaml plan/measurements.csv points.txt --profile leica --by-order \\
          --decimal comma -o measured.csv
      loopcal fill hexapod.yaml plan/measurements.csv monday.txt tuesday.txt --profile faro \\
          --unit in -o measured.csv
    """
    from loopcal.diagnose.conventions.convention_check import check_conventions
    from loopcal.diagnose.measured_points import examine_points
    from loopcal.io.exports.conversion import fill_sheet, save_converted
    from loopcal.io.exports.profile import find_profile_file, read_profile, with_local_settings

    path = find_profile_file(profile)
    machine = opt.open_robot(robot, (output,), (sheet, *exports, path), force)
    filled = fill_sheet(
        machine,
        sheet,
        exports,
        with_local_settings(read_profile(path), unit, decimal == "comma"),
        by_order=by_order,
        has_one_session=one_session,
    )
    examined = () if allow_implausible else examine_points(machine, filled.data, filled.unit)
    conventions = check_conventions(
        machine, filled.data.fitted, allow_implausible=allow_implausible
    )
    opt.print_convention_note(conventions, exports)
    save_converted(filled.text, output)
    findings = (*filled.findings, *examined)
    misfits = [{"file": f, "line": n, "reason": reason} for f, n, reason in filled.misfits]
    document = {"measurements": output, "misfits": misfits, "findings": findings}
    first, *others = (with_hint(finding) for finding in findings)
    page = [
        f"{output}: {first}",
        *(f"note: {text}" for text in others),
        *_note_misfits(filled.misfits),
        suggest_command("calibrate", robot, output, "-o", "run"),
    ]
    return Output(document, lambda: page)


def _note_misfits(misfits: Sequence[tuple[Any, int, str]], where: str = "") -> list[str]:
    """Return notes on lines (file, number, reason) that do not match a profile."""
    notes = [f"note: {file}:{line} does not match: {why}" for file, line, why in misfits[:SHOWN]]
    more = len(misfits) - SHOWN
    return notes if more <= 0 else [*notes, f"note: {more} more lines do not match{where}"]


def convert_instrument_export(
    file: Path, profile: str, local: tuple[str | None, bool], output: Path, force: bool
) -> Output:
    """Write the measurements of an export; report lines that were skipped or do not match.

    `local` : the unit of lengths in place of that of the profile, and whether commas are decimal.
    """
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.exports.conversion import convert_export, save_converted
    from loopcal.io.exports.profile import find_profile_file, read_profile, with_local_settings

    used = {"file", "profile", "output", "force", "as_json", "length_unit", "decimal"}
    names = (option.name or "" for option in click.get_current_context().command.params)
    opt.refuse_given(
        (name for name in names if name not in used),
        "with --profile, which defines how to read the file",
    )
    path = find_profile_file(profile)
    refuse_outputs((output,), (file, path), force)
    converted = convert_export(file, with_local_settings(read_profile(path), *local))
    save_converted(converted.text, output)
    document = {
        "measurements": output,
        "rows": converted.rows,
        "passed": converted.passed,
        "misfits": [{"line": line, "reason": reason} for line, reason in converted.misfits],
        "notes": [str(finding) for finding in converted.findings],
        "findings": converted.findings,
    }
    rows, passed = name_count(converted.rows, "row"), name_count(converted.passed, "line")
    page = [
        f"{output}: {rows}, {passed} skipped by the profile",
        *(f"note: {with_hint(finding)}" for finding in converted.findings),
        *_note_misfits([(file, *misfit) for misfit in converted.misfits], f", listed in {output}"),
    ]
    return Output(document, lambda: page)


CORRECTED_ALONE = (
    "--corrected calibrates with the measurements in the file. Name a file for them, such as "
    "--data data.csv"
)


def _setting(text: str, *names: str, **settings: Any) -> Any:
    """Declare an option of reading FILE; its text may contain `{option}`, the formats that read it,
    and `{height}`, the noise of a sort of numbers that is assumed.
    """

    def write_help() -> str:
        from loopcal.io.formats import FORMATS
        from loopcal.io.formats.program_format import ASSUMED_NOISE

        readers: dict[str, dict[str, list[str]]] = {}
        for name, entry in FORMATS.items():
            for key, what in entry.read_options.items():
                readers.setdefault(key, {}).setdefault(what, []).append(name)
        words = {key: opt.POSITIVE_LENGTH.show(value) for key, value in ASSUMED_NOISE.items()}
        for key, groups in readers.items():
            parts = (f"{what} ({', '.join(formats)})" for what, formats in groups.items())
            words[key] = ", ".join(parts).strip()
        return text.format_map(words)

    return opt.option(write_help, *names, **settings)


def _sigma(what: str, default: str) -> Any:
    return _setting(f"Noise of {what}.  [default: {default}]", type=opt.POSITIVE_LENGTH)


# How FILE is read.
SETTINGS: Any = opt.Group(
    sigma_height=_sigma("the probe {sigma_height}", "{height}"),
    sigma_distance=_sigma("distances {sigma_distance}", "{distance}"),
    sigma_line=_sigma("lines {sigma_line}", "{line}"),
    sigma_position=_sigma("known positions {sigma_position}", "{position}"),
    sigma_tape=_sigma(
        "lengths measured by hand, which become prior knowledge: {sigma_tape}", "{tape} for lines"
    ),
    sigma_anchor=_sigma("anchors in FILE {sigma_anchor}", "none: they are first guesses"),
    length_unit=_setting(
        "Unit of lengths {length_unit}. Replaces the unit of --profile.",
        "--unit",
        type=click.Choice(list_symbols(Dimension.LENGTH)),
    ),
    home_height=_setting("Height of the home pose {home_height}.", "--home-z", type=opt.LENGTH),
    closures=_setting(
        "Loops that FILE closes {closures}. Default: FILE with the ending .yaml.", type=opt.FILE
    ),
    platform=_setting(
        "Link that is the platform {platform}. Default: the one on a fixed joint.", metavar="LINK"
    ),
)


@opt.command("import")
def import_(
    file: Path = opt.argument("FILE", type=opt.FILE),
    format_name: str | None = opt.option(
        "Format of FILE. Default: by the ending of its name.",
        "--format",
        type=opt.Words("loopcal.io.formats:FORMATS", property="read"),
    ),
    profile: str | None = opt.profile(
        "Instead of --format: how to read FILE, the export of an instrument."
    ),
    decimal: str | None = opt.DECIMAL,
    output: Path = opt.path(
        "Robot file to write, which names the robot. With --profile: the measurement file.",
        "-o",
        required=True,
    ),
    data: Path | None = opt.path("Also write the measurements that FILE or --probes contain."),
    probes: tuple[Path, ...] = _setting(
        "What the firmware printed when it probed the bed: {probes}. Repeatable.",
        type=opt.FILE,
        multiple=True,
        metavar="REPORT",
    ),
    corrected: Path | None = opt.path(
        "Also calibrate with them, and write FILE with the corrected numbers."
    ),
    settings: dict[str, Any] = SETTINGS,
    force: bool = opt.force(
        "an output file", ", and write --corrected even if the calibration failed"
    ),
) -> Output:
    """Read FILE of another program as a robot file and, if it contains any, measurements.

    With --profile, FILE is text that an instrument exported, and becomes a measurement file (see
    docs/exports.md).

    With --corrected, the exit code is 2 if the calibration failed, as in loopcal calibrate. Only
    --force then writes the corrected file.

    Examples:
      loopcal import printer.cfg -o printer.yaml --data heights.csv
      loopcal import printer.cfg -o printer.yaml --data heights.csv --corrected corrected.cfg
      loopcal import config-override.g --format reprap -o printer.yaml
      loopcal import m503.txt --format marlin --probes g30.txt -o printer.yaml --data heights.csv
      loopcal import export.txt --profile tracker.yaml -o measurements.csv
      loopcal import export.txt --profile spatial-analyzer --unit in -o measurements.csv
      loopcal import hexapod.hal --unit mm --home-z 200mm -o hexapod.yaml
      loopcal import samples.json --format hangprinter -o robot.yaml --data samples.csv
      loopcal import five-bar.urdf --closures five-bar-loops.yaml -o five-bar.yaml
    """
    from loopcal.apply.base_motion import choose_base
    from loopcal.diagnose.fit_examination import compare_stored_geometry
    from loopcal.io.core.limits import make_name
    from loopcal.io.core.outputs import refuse_outputs, restore_on_failure
    from loopcal.io.core.text_file import write_text
    from loopcal.io.formats.import_export import (
        choose_format,
        export_robot,
        list_formats,
        save_imported,
    )
    from loopcal.io.formats.linkages.closures import find_closures
    from loopcal.io.formats.program_format import ExportSource, ImportOptions
    from loopcal.io.runs.run_folder import list_reasons

    settings |= {"probes": probes}
    if profile is not None:
        local = (settings["length_unit"], decimal == "comma")
        return convert_instrument_export(file, profile, local, output, force)
    opt.refuse_given(("decimal",), "without --profile")
    source = choose_format(file, format_name)
    if source.read is None:
        raise DataError(
            f"loopcal writes the format {source.name}, but cannot read it. It reads "
            f"{', '.join(list_formats('read'))}, and an instrument's export with a profile "
            "(--profile, docs/exports.md)"
        )
    if corrected is not None and data is None:
        raise DataError(CORRECTED_ALONE)
    beside = find_closures(file) if "closures" in source.read_options else None
    inputs = (file, settings["closures"] or beside, *probes)
    refuse_outputs((output, data), inputs, force)
    refuse_outputs((output, data, corrected), (), force)  # FILE itself may be corrected
    stated = {key: value for key, value in settings.items() if value not in (None, ())}
    for key in stated:
        if key not in source.read_options:
            raise DataError(
                f"{opt.name_option(key)} does not belong to the format {source.name}. Leave it out"
            )
    imported = source.read(file, ImportOptions(make_name(output.stem), **stated))
    report, changes, failures = None, [], []
    with restore_on_failure((output, data)):
        robot = save_imported(file, imported, output, data)
        noted = list(imported.findings)
        if source.stores_fit and imported.measurements is not None:
            stored = compare_stored_geometry(robot, imported.measurements)
            noted += [] if stored is None else [stored.finding]
        if corrected is not None and data is not None:
            report = lc.calibrate(robot, opt.read_measurements([data], robot))
            opt.print_convention_note(report.conventions, [data])
            is_written = force or not report.has_failed
            if report.has_failed:
                failure = report_finding(
                    "gates.correction-not-written",
                    file=str(corrected),
                    reasons=list_reasons(report.failures),
                    is_written=is_written,
                )
                failures.append(with_hint(failure))
            if is_written:
                moved = choose_base(report.to_dict(), robot, report.robot, keep_frame=False)[1]
                exported = export_robot(ExportSource(report.robot, findings=moved), source, file)
                write_text(corrected, exported.text)
                changes = [str(finding) for finding in exported.findings]
            else:
                corrected = None
    document: dict[str, Any] = {
        "robot": output,
        "data": data,
        "corrected": corrected,
        "notes": [str(finding) for finding in noted],
        "findings": imported.findings,
        "fit": report and report.identification,
        "verdict": report and report.verdict,
        "reasons": report and report.failures,
        "changes": report and changes,
    }
    return Output(document, lambda: _view_import(robot, document, noted), failures)


def _view_import(
    robot: lc.Mechanism, document: Mapping[str, Any], noted: Sequence[lc.Finding]
) -> list[Block]:
    """Return what was read, what was identified, and which lines were changed."""
    from loopcal.report.calibration_view import view_fit

    n, free = len(robot.parameters), int(robot.parameters.free.sum())
    actuators, parameters = name_count(len(robot.actuators), "actuator"), name_count(n, "parameter")
    page: list[Block] = [f"{document['robot']}: {actuators}, {parameters}, {free} free"]
    if document["data"] is not None:
        page.append(f"{document['data']}: the measurements of the file")
    page += [f"note: {with_hint(finding)}" for finding in noted]
    if document["fit"] is not None:
        page += [*view_fit(document["fit"]), *document["changes"]]
    if document["corrected"] is None:
        files = document["robot"], document["data"] or "DATA"
        return [*page, suggest_command("calibrate", *files, "-o", "run")]
    return [*page, f"Written to {document['corrected']}. Its other lines are as before"]


@opt.command()
def export(
    source: str = opt.argument("RUN|ROBOT"),
    format_name: str | None = opt.option(
        "Format to write. Default: by the ending of -o.",
        "--format",
        type=opt.Words("loopcal.io.formats:FORMATS", property="write"),
    ),
    into: Path | None = opt.path(
        "File of the controller to correct. Everything else in it stays as it is.", metavar="FILE"
    ),
    output: Path | None = opt.path(
        "File to write. Without it, --format prints what to type, with sensible digits.", "-o"
    ),
    keep_frame: bool = opt.option(
        "Write values of equal relative accuracy that leave programs in place.", is_flag=True
    ),
    controller: str | None = opt.option(
        "Robot file with the geometry of the controller, for a table of corrections (--format "
        "grid). Default: as before the calibration.",
        metavar="ROBOT",
    ),
    table_error: float | None = opt.option(
        "Largest error that a table may leave between its nodes.  [default: a tenth of the error]",
        type=opt.POSITIVE_LENGTH,
    ),
    force: bool = opt.force(
        "the output file", ", and write also the numbers of a calibration that failed"
    ),
) -> Output:
    """Write the parameters of RUN, or of a robot file, as another program reads them.

    The formats klipper-skew, grid and grid-.. are corrections for a controller that keeps its
    geometry: a skew, or tables. A note states the error that remains, between the nodes of a table.

    Without -o, the command prints lines to type: each identified value with three digits of its
    uncertainty, at most the decimals that the controller keeps. Files have all digits. A note
    names what the format cannot express. If the calibration of RUN failed, the exit code is 2, and
    only --force writes files.

    Examples:
      loopcal export run --format marlin
      loopcal export run --format klipper --into printer.cfg -o corrected.cfg
      loopcal export run --format reprap -o config-override.g
      loopcal export run -o parameters.csv
      loopcal export run --format grid --table-error 5um -o grid.csv
    """
    from loopcal.apply.base_motion import choose_base
    from loopcal.apply.compensation import TableSize, make_tables
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.core.text_file import write_text
    from loopcal.io.formats.import_export import build_source, choose_format, export_robot
    from loopcal.io.runs.run_folder import find_failure, load_run_or_robot

    if output is None and (format_name is None or into is not None):
        raise DataError(
            "name the file to write with -o, such as -o parameters.csv. Without it, --format "
            "prints the lines of a controller, and --into is impossible"
        )
    target = choose_format(output or Path(), format_name, is_written=True)
    refuse_outputs((output,), (Path(source),), force)  # the file of --into may be corrected
    if target.table is None:
        opt.refuse_given(("controller", "table_error"), "without --format grid")
    failure = find_failure(source)
    failures = [] if failure is None else [failure]
    if failures and not force:
        document = {"output": None, "written_as": target.name, "notes": [], "reasons": failures}
        return Output(document, list, [with_hint(failure) for failure in failures])
    run = load_run_or_robot(source)
    old = run.initial_robot if controller is None else lc.load_robot(controller)
    settings = (
        {"keep_frame": keep_frame} if target.table is None else {"keep_frame": True, "visible": 0.0}
    )
    try:  # a table leaves out any motion of frames, which are conventions
        robot, moved = choose_base(run.result, old, run.robot, **settings)
    except DataError:  # no values do without it
        if keep_frame:
            raise
        robot, moved = choose_base(run.result, old, run.robot, keep_frame=False)
    loaded = build_source(replace(run, robot=robot))
    if target.table is not None:
        tables, noted = make_tables(robot, old, TableSize(*target.table), table_error)
        stem = target.name if output is None else output.stem
        loaded = replace(loaded, tables=tables, stem=stem)
        is_whole = TableSize(*target.table).what in ("commands", "readings")
        moved = (*moved, noted) if is_whole else (noted,)  # heights and skews move no program
    findings = (*loaded.findings, *moved)
    loaded = replace(loaded, is_for_people=output is None, findings=findings)
    exported = export_robot(loaded, target, into)
    written: dict[Path, str] = {}
    if output is not None:
        beside = {output.parent / name: text for name, text in exported.beside.items()}
        written = {output: exported.text, **beside}
        refuse_outputs(tuple(written), (Path(source),), force)
    for file, text in written.items():
        write_text(file, text)
    notes = [str(finding) for finding in exported.findings]
    document = {"output": output, "written_as": target.name, "notes": notes, "reasons": failures}
    document |= {"text": exported.text} if output is None else {}

    def view() -> list[str] | str:
        noted = [with_hint(finding) for finding in exported.findings]
        if output is not None:
            return [*noted, f"Written to {', '.join(map(str, written))}"]
        for note in noted:
            terminal.print_note(note)
        return exported.text

    return Output(document, view, failures)
