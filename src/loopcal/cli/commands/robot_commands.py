# SPDX-License-Identifier: Apache-2.0
"""Begin: write, check and view a robot file, write the files of an example, complete commands."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loopcal.cli import options as opt
from loopcal.cli import terminal
from loopcal.cli.hints import suggest_command
from loopcal.cli.terminal import Output
from loopcal.errors import DataError

if TYPE_CHECKING:
    from loopcal.results.tables import Block


SCHEMAS = {
    "robot": "loopcal.io.file_schemas:build_robot_schema",
    "settings": "loopcal.io.file_schemas:build_settings_schema",
    "profile": "loopcal.io.file_schemas:build_profile_schema",
    "study": "loopcal.studies.files.study_file:build_study_schema",
}
"""Kind of file -> what makes its JSON Schema."""


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
    if family is not None and output is not None:
        texts[output] = format_new_robot(family, make_name(output.stem))
        robot = build_robot(parse_yaml(texts[output], output, "robot file"))
        template = format_template(robot, opt.make_instrument(stated, robot))
        schema_file = output.with_name(EDITOR_SCHEMA)
        if not schema_file.exists():
            texts[schema_file] = to_json(opt.look_up(SCHEMAS["robot"])())
        page.append(f"{output}: a complete robot. Replace its numbers with yours.")
        page.append(f"{schema_file}: the keys of robot files, which editors complete and check.")
        page.append(suggest_command("check", output))
        if measurements is not None:
            refuse_settings_beside(measurements)
            texts[measurements] = template
            page.append(f"{measurements}: columns without rows. Fill in your measurements.")
            page.append(suggest_command("calibrate", output, measurements, "-o", "run"))
    elif family or output or measurements or report_facts is None:
        raise DataError("a new robot file needs FAMILY and -o. Give both")
    if report_facts is not None:
        texts[report_facts] = read_template()
        page.append(f"{report_facts}: facts for reports and certificates. Fill in what you know.")
        page.append(suggest_command("report", "run", "--facts", report_facts, "--pdf"))
    write_files(texts)
    written = {"robot": output, "measurements": measurements, "report_facts": report_facts}
    return Output(written, lambda: page)


@opt.command()
def schema(
    file: str = opt.argument("KIND", type=click.Choice(list(SCHEMAS))),
    output: Path | None = opt.path("File to write. Default: standard output.", "-o"),
    force: bool = opt.force("the file"),
) -> Output:
    """Print the JSON Schema of a kind of file: robot, settings (of a measurement file), profile or
    study.

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
