# SPDX-License-Identifier: Apache-2.0
"""`loopcal compare`: calibrations side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from loopcal.cli import terminal
from loopcal.cli.options.shared_options import (
    FILE,
    data_options,
    file_option,
    force_option,
    json_option,
    read_checked_measurements,
)


@click.command()
@click.argument("runs", metavar="RUN...", type=FILE, nargs=-1, required=True)
@click.option(
    "--data",
    "data",
    type=FILE,
    multiple=True,
    metavar="DATA",
    help="Measurements at which the errors of all runs are compared. May be given several times.",
)
@file_option(
    "-o",
    "--output",
    help="File to write: .html (a page with figures), .json, or .csv (one row for each run and "
    "parameter).",
)
@data_options
@force_option("the output file")
@json_option
def compare(
    runs: tuple[Path, ...],
    data: tuple[Path, ...],
    output: Path | None,
    force: bool,
    as_json: bool,
    **flags: Any,
) -> int:
    """Compare calibrations side by side: two or more run folders, of sessions, machines or methods.

    The first RUN is the reference of the others. Where the data are independent, whether the
    machine has changed is tested in what both data sets determine, and the parameter or limb that
    explains the change is named. If nothing has changed, a change is reported in 5 % of cases, for
    all runs together. Runs that share measurements are compared without a test.

    Runs whose parameters do not mean the same are refused: other mechanisms, free parameters, or
    fixed values.

    \b
    Examples:
      loopcal compare may june
      loopcal compare map ridge --data more.csv
      loopcal compare may june july -o sessions.html
      loopcal compare may june july -o sessions.csv
    """  # noqa: D301
    from loopcal.apply import compare_runs
    from loopcal.documents.comparison import ENDINGS, write_comparison
    from loopcal.documents.writing import check_ending
    from loopcal.io import load_run
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.report.run_comparison_view import find_error_units, view_comparison

    if output is not None:
        check_ending(output, "comparison", ENDINGS)
        refuse_outputs((output,), (*runs, *data), force)
    loaded = [load_run(run) for run in runs]
    measurements = read_checked_measurements(data, loaded[0].robot, **flags) if data else None
    comparison = compare_runs(loaded, measurements)
    if output is not None:
        write_comparison(output, comparison)
    if as_json:
        terminal.print_json(comparison.to_dict())
        return 0
    units = find_error_units(comparison)
    page = view_comparison(comparison, units.__getitem__)
    terminal.print_page(page if output is None else [*page, "", f"Written to {output}"])
    return 0
