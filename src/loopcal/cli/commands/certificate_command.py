# SPDX-License-Identifier: Apache-2.0
"""`loopcal certificate`: a digital calibration certificate of a run."""

from __future__ import annotations

from pathlib import Path

import click

from loopcal.cli import terminal
from loopcal.cli.options.shared_options import FILE, flag_option, json_option
from loopcal.errors import DataError


@click.command()
@click.argument("run", metavar="[RUN]", type=FILE, required=False)
@click.argument("facts", metavar="[FACTS]", type=FILE, required=False)
@flag_option("--new", help="Print a file FACTS to fill in.")
@json_option
def certificate(run: Path | None, facts: Path | None, new: bool, as_json: bool) -> int:
    """Print a digital calibration certificate of RUN: XML by PTB's schema DCC 3.3.0.

    FACTS is a YAML file with what a run does not know: laboratory, customer, dates, serial number.
    Instruments are those that the measurement files state.

    \b
    Examples:
      loopcal certificate --new > facts.yaml
      loopcal certificate run facts.yaml > certificate.xml
    """  # noqa: D301
    from loopcal.io.runs.certificate import format_certificate
    from loopcal.io.runs.certificate_settings import TEMPLATE, load_administration
    from loopcal.io.runs.run_folder import load_run_or_robot

    if new:
        if run is not None:
            raise DataError("--new prints a file to fill in; leave out RUN and FACTS")
        return _print("facts", TEMPLATE, as_json)
    if run is None or facts is None:
        raise DataError("RUN and FACTS are needed; loopcal certificate --new prints a file FACTS")
    text = format_certificate(load_run_or_robot(run), load_administration(facts))
    return _print("certificate", text, as_json)


def _print(name: str, text: str, as_json: bool) -> int:
    """Print a text, or a JSON object that holds it, and return the exit code."""
    if as_json:
        terminal.print_json({name: text})
    else:
        click.echo(text, nl=False)
    return 0
