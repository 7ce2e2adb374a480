# SPDX-License-Identifier: Apache-2.0
"""`loopcal view`: a robot, or a calibration, as an interactive 3-D view in the browser."""

from __future__ import annotations

from pathlib import Path

import click

from loopcal.cli import terminal
from loopcal.cli.options.shared_options import (
    complete_robot,
    file_option,
    flag_option,
    force_option,
    json_option,
)

OUTPUT = Path("view.html")


@click.command()
@click.argument("source", metavar="RUN|ROBOT", shell_complete=complete_robot)
@file_option(
    "-o", "--output", help=f"HTML file to write; its name ends in .html. Default: {OUTPUT}."
)
@flag_option("--no-browser", help="Do not open the view in the browser.")
@force_option("the output file")
@json_option
def view(source: str, output: Path | None, no_browser: bool, force: bool, as_json: bool) -> int:
    """Show RUN, a run folder, or a robot file as an interactive 3-D view in the browser.

    The view is one HTML file that needs no network. It shows the robot at home; of a run also at
    the measured poses, with the position errors before calibration and the uncertainty over the
    workspace.

    The exit code is 2 where the calibration of RUN failed; the view is written and says so.

    \b
    Examples:
      loopcal view hexapod-42
      loopcal view run -o hexapod.html --no-browser
    """  # noqa: D301
    from loopcal.documents.view_writing import open_page, write_view
    from loopcal.documents.writing import check_ending
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.runs.run_folder import load_run_or_robot

    output = output or OUTPUT
    check_ending(output, "view")
    run = load_run_or_robot(source)
    files = [Path(source) / name for name in run.result.get("files", {})]
    refuse_outputs((output,), files or (Path(source),), force)
    with terminal.ProgressBar() as progress:
        progress(0, 1, "writing the view")
        write_view(output, run if run.result else run.robot)
    is_open = not no_browser and open_page(output.resolve().as_uri())
    failure = run.failure
    failures = [] if failure is None else [failure]
    if as_json:
        terminal.print_json({"output": output, "opened": is_open, "reasons": failures})
    else:
        unopened = "" if is_open or no_browser else "; no browser could be started here"
        terminal.print_page([f"Written to {output}{unopened}"])
    return terminal.print_failures(failures)
