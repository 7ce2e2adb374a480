# SPDX-License-Identifier: Apache-2.0
"""The command `loopcal`: its groups of commands, and the one place where an error becomes a
sentence and an exit code.

Exit codes: 0 good, 1 wrong use or wrong input, 2 a quality gate is not met, 3 a defect of loopcal.
Nothing heavier than click is imported before a command runs, so that
`loopcal --help` answers at once.
"""

from __future__ import annotations

import keyword
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import click

from loopcal.cli import terminal
from loopcal.cli.command_group import CommandGroup
from loopcal.cli.hints import find_hint, word_hint
from loopcal.cli.interrupts import repeat_lost_interrupts
from loopcal.errors import LoopcalError
from loopcal.findings import Finding
from loopcal.output_record import record_outputs
from loopcal.threads import THREADS

SECTIONS = {
    "Describe the robot": {
        "new": "Write a robot file, and a measurement file, to fill in.",
        "check": "Read a robot file and show what it contains.",
        "view": "Show a robot, or a calibration, as a 3-D view in the browser.",
        "import": "Read the file of a controller as a robot file.",
        "export": "Write identified numbers into the file of a controller.",
    },
    "Prepare measurements": {
        "identifiability": "Show which parameters measurements determine.",
        "plan": "Plan which poses to measure, and write a sheet for them.",
        "gcode": "Write a program that moves a machine to the poses of a plan.",
        "fill": "Fill in the sheet of a plan from the export of an instrument.",
        "simulate": "Write a measurement file of a simulated machine.",
    },
    "Calibrate": {
        "calibrate": "Identify the parameters of a robot and validate them.",
        "report": "Write the report of a calibration as HTML, JSON and PDF.",
        "validate": "Validate a calibration, or a robot file, with measurements.",
        "repeatability": "Compute pose accuracy and repeatability by ISO 9283.",
        "budget": "Show the uncertainty of a calibration by source.",
        "compare": "Compare calibrations side by side: has the machine changed, and where?",
        "certificate": "Print a digital calibration certificate of a calibration.",
        "compensate": "Compute readings or commands that reach targets.",
        "regularize": "Show the error at held-out poses by the strength of regularization.",
    },
    "Examine the uncertainty": {
        "bootstrap": "Resample a calibration and compare the scatter with its intervals.",
        "sample": "Draw from the exact posterior of a calibration.",
    },
    "Simulate many calibrations": {
        "study": "Compare instruments, numbers of poses and methods by simulation."
    },
    "Published studies": {
        "reproduce": "Repeat a published study and compare its numbers.",
        "per-leg": "Identify a hexapod leg by leg, to compare with calibrate.",
    },
    "Begin": {
        "example": "Write the files of an example, to try the commands with.",
        "completion": "Print the script with which a shell completes commands.",
    },
}
"""Headings of the help, and the commands below each."""

MODULES = {
    "robot_commands": ("new", "check"),
    "exchange_commands": ("import", "export"),
    "measurement_commands": ("identifiability", "simulate"),
    "plan_command": ("plan",),
    "sheet_commands": ("gcode", "fill"),
    "certificate_command": ("certificate",),
    "repeatability_command": ("repeatability",),
    "calibration_commands": ("calibrate", "budget", "validate", "compensate"),
    "compare_command": ("compare",),
    "report_command": ("report",),
    "view_command": ("view",),
    "regularize_command": ("regularize",),
    "sampling_commands": ("bootstrap", "sample"),
    "study_commands": ("study",),
    "paper_commands": ("reproduce", "per-leg"),
    "help_commands": ("example", "completion"),
}
"""Modules of `loopcal.cli.commands`, and the commands in each; imported when they run."""


NO_PLUGINS = ("PYDANTIC_DISABLE_PLUGINS", "__all__")
"""The records of loopcal need no plugins of pydantic, which are searched in all installed packages.
"""


class SectionedGroup(CommandGroup):
    """A group whose help lists its commands below headings, in the order of the work."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return [name for members in SECTIONS.values() for name in members]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command; None where there is none of this name."""
        return find_command(cmd_name)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections."""
        for heading, members in SECTIONS.items():
            with formatter.section(heading):
                formatter.write_dl(list(members.items()))


def find_command(name: str) -> click.Command | None:
    """Import a command; None where there is none of this name."""
    module = next((module for module, names in MODULES.items() if name in names), None)
    if module is None:
        return None
    function = name.replace("-", "_") + "_" * keyword.iskeyword(name)
    return getattr(import_module(f"loopcal.cli.commands.{module}"), function)


def find_running_command(words: Sequence[str]) -> click.Command | None:
    """Import the command of the words of a command line, also one of a group; None without one."""
    command = find_command(words[0]) if words else None
    if isinstance(command, click.Group) and len(words) > 1:
        return command.commands.get(words[1], command)
    return command


@click.group(
    cls=SectionedGroup,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "max_content_width": 100,
        "show_default": True,
    },
)
@click.option(
    "-V",
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=lambda context, _option, is_asked: _print_version(context, is_asked),
    help="Show the version and the engine, and exit.",
)
def command_line() -> None:
    """Calibrate the geometry of robots with closed kinematic loops.

    \b
    From measurements to a calibrated hexapod:
      loopcal check hexapod-42
      loopcal calibrate hexapod-42 measurements.csv -o run --hold-out 0.25
      loopcal validate run more-measurements.csv

    \b
    Exit codes:
      0  good
      1  wrong use, or input that is refused
      2  a quality gate is not met (see calibrate, validate, compensate, import and export)
      3  a defect of loopcal; the message names a report to send to the developers
    """  # noqa: D301


def _print_version(context: click.Context, is_asked: bool) -> None:
    """Print the version of loopcal and the engine that computes, and exit."""
    if not is_asked or context.resilient_parsing:
        return
    from importlib.metadata import version

    from loopcal.engine import get_current_engine

    click.echo(f"loopcal {version('loopcal')}\nengine {get_current_engine()}")
    context.exit()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Parameters
    ----------
    arguments : words after `loopcal`; default: those of the process.
    """
    os.environ.update(dict.fromkeys(THREADS, "1"))
    os.environ.setdefault(*NO_PLUGINS)
    words = list(sys.argv[1:] if arguments is None else arguments)
    terminal.prepare_streams()
    command = None
    with repeat_lost_interrupts(), record_outputs() as list_outputs:
        try:
            command = find_running_command(words)
            if command is not None and not _has_working_folder():
                return _refuse("the working folder was removed; change to a folder that exists.")
            code = command_line.main(words, prog_name="loopcal", standalone_mode=False)
            terminal.flush_output()
            return code if isinstance(code, int) else 0
        except BrokenPipeError:  # the reader of our output stopped (`loopcal ... | head`)
            terminal.silence_output()
            return 1
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 the one place for all of them
            return _report(error, command, words, list_outputs())


def _has_working_folder() -> bool:
    """Return whether the working folder exists, from which relative paths count."""
    try:
        return Path.cwd().is_dir()
    except OSError:
        return False


def _report(
    error: BaseException,
    command: click.Command | None,
    words: Sequence[str],
    outputs: Sequence[Path],
) -> int:
    """Print what an exception means for the user, and return the exit code.

    Parameters
    ----------
    command : that ran, if known. words : of the command line. outputs : that were written before.
    """
    if outputs:
        names = " and ".join(str(path) for path in outputs)
        terminal.print_message(f"loopcal: written completely before the following: {names}")
    unwritten = "" if outputs else "; no result was written"
    match error:
        case click.exceptions.NoArgsIsHelpError():
            terminal.print_message(error.format_message())
            return 1
        case click.BadParameter() | click.NoSuchOption():
            path = "loopcal" if error.ctx is None else error.ctx.command_path
            return _refuse(error.format_message(), f"see {path} --help")
        case click.ClickException():
            return _refuse(error.format_message())
        case LoopcalError():
            finding = error.args[0] if error.args else None
            hint = find_hint(error.code, command)
            return _refuse(
                str(error), word_hint(finding, hint) if isinstance(finding, Finding) else hint
            )
        case KeyboardInterrupt() | click.exceptions.Abort():
            return _refuse(f"stopped before the end{unwritten}.")
        case OSError():
            place = f"{error.filename}: " if error.filename else ""
            reason = (error.strerror or str(error)).lower()
            return _refuse(
                f"{place}the operating system refused ({reason}); check the path and its "
                "permissions."
            )
        case MemoryError():
            return _refuse("there is not enough memory for this; use fewer poses at a time.")
        case _:
            from loopcal.cli.defect_report import DEFECT_CODE, describe_defect

            _refuse(describe_defect(error, words))
            return DEFECT_CODE


def _refuse(sentence: str, hint: str | None = None) -> int:
    """Print a sentence, and a hint where there is one, on standard error; return exit code 1."""
    terminal.print_message(f"loopcal: {' '.join(sentence.split())}")
    if hint:
        terminal.print_message(f"Hint: {hint}")
    return 1
