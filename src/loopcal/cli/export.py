# SPDX-License-Identifier: Apache-2.0
"""`loopcal export`: identified numbers in a file of another program."""

from __future__ import annotations

from pathlib import Path

import click

from loopcal.cli import show
from loopcal.cli.options import FILE, json_option

FORMATS = ("klipper", "marlin", "reprap", "linuxcnc", "urdf", "json", "csv")


@click.command(short_help="Write identified numbers into a controller's file.")
@click.argument("source", metavar="RUN|ROBOT")
@click.option(
    "--format",
    "format_name",
    type=click.Choice(FORMATS),
    help="What to write; by the ending of -o.",
)
@click.option(
    "--into",
    type=FILE,
    metavar="FILE",
    help="The controller's file to correct; all else in it stays byte for byte.",
)
@click.option("-o", "--output", required=True, type=FILE, help="The file to write.")
@click.option("--force", is_flag=True, help="Replace a file that is there.")
@json_option
def export(
    source: str,
    format_name: str | None,
    into: Path | None,
    output: Path,
    force: bool,
    as_json: bool,
) -> None:
    """Write the parameters of a run, or of a robot file, as another program reads them.

    What the format cannot express is said.

    \b
    Examples:
      loopcal export run --format klipper --into printer.cfg -o corrected.cfg
      loopcal export run --format reprap -o config-override.g
      loopcal export run -o parameters.csv
    """  # noqa: D301
    from loopcal.io.core.outputs import refuse_outputs
    from loopcal.io.core.text_file import write_text
    from loopcal.io.formats.import_export import choose_format, export_robot, load_source

    target = choose_format(output, format_name)
    refuse_outputs((output,), (Path(source),), force)  # --into may be corrected in place
    found = export_robot(load_source(source), target, into)
    write_text(output, found.text)
    if as_json:
        show.json_document({"output": output, "format": target.name, "notes": found.notes})
        return
    for note in found.notes:
        show.say(note)
    show.say(f"written to {output}")
