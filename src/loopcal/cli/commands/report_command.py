# SPDX-License-Identifier: Apache-2.0
"""`loopcal report`: a calibration as a document to read, sign and archive."""

from __future__ import annotations

from pathlib import Path

import click

from loopcal.cli import terminal
from loopcal.cli.options.shared_options import (
    FILE,
    file_option,
    flag_option,
    force_option,
    json_option,
)


@click.command()
@click.argument("run", metavar="RUN", type=FILE)
@file_option(
    "-o",
    "--output",
    help="HTML file to write; its name ends in .html. The same content is written as JSON beside "
    "it. Default: report.html.",
    default=Path("report.html"),
)
@flag_option(
    "--pdf", help="Also print the report to a PDF file beside it, by an installed Chromium."
)
@force_option("the output files")
@json_option
def report(run: Path, output: Path, pdf: bool, force: bool, as_json: bool) -> int:
    """Write the report of RUN, a run folder, as one HTML file that needs no network.

    It contains the verdict with its scope, what the data do not determine, errors at held-out
    poses, residuals, accuracy over the workspace, parameters, the uncertainty budget, values for
    the controller, and provenance.

    The exit code is 2 where the calibration failed; the report is written and says so.

    \b
    Examples:
      loopcal report run
      loopcal report run -o hexapod.html --pdf
    """  # noqa: D301
    from loopcal.documents.printing import check_browser, print_pdf
    from loopcal.documents.writing import name_files, write_report
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.runs.run_folder import load_run

    files = [*name_files(output), *([output.with_suffix(".pdf")] if pdf else [])]
    calibrated = load_run(run)
    refuse_outputs(files, [run / name for name in calibrated.result.get("files", {})], force)
    if pdf:
        check_browser(files[-1])
    with terminal.ProgressBar() as progress:
        progress(0, 1, "writing the report")
        write_report(output, calibrated)
        if pdf:
            progress(0, 1, "printing the report")
            print_pdf(output, files[-1])
    failure = calibrated.failure
    if as_json:
        terminal.print_json({"output": files, "reasons": [] if failure is None else [failure]})
    else:
        terminal.print_page([f"Written to {', '.join(str(file) for file in files)}"])
    return terminal.print_failures([] if failure is None else [failure])
