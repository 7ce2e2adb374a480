# SPDX-License-Identifier: Apache-2.0
"""The command `loopcal`: its groups of commands, and the one place where an error becomes a
sentence and an exit code.

Exit codes: 0 good, 1 wrong use or wrong input, 2 a quality gate is not met, 3 a defect of loopcal.
Nothing heavier than click is imported before a command runs, so that
`loopcal --help` answers at once.
"""

from __future__ import annotations

import _thread
import keyword
import os
import re
import shlex
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import click

import loopcal
from loopcal.cli import terminal
from loopcal.cli.hints import find_hint, word_hint
from loopcal.environment import pin_settings
from loopcal.errors import FileError, LoopcalError, MissingPackageError, suggest_names
from loopcal.findings import Finding
from loopcal.output_record import record_outputs

# Heading of the help -> command -> its module, imported when it runs, and what it does.
SECTIONS = {
    "Describe the robot": {
        "new": ("file", "Write a robot file, and a measurement file, to fill in."),
        "app": ("session", "Calibrate and measure on a page in the browser."),
        "check": ("file", "Read a robot file and show what it contains."),
        "view": ("file", "Show a robot, or a calibration, as a 3-D view in the browser."),
        "schema": ("file", "Print the JSON Schema of a kind of file, for editors."),
        "import": ("file", "Read the file of a controller as a robot file."),
        "export": ("file", "Write identified numbers into the file of a controller."),
    },
    "Prepare measurements": {
        "identifiability": ("measurement", "Show which parameters measurements determine."),
        "plan": ("measurement", "Plan which poses to measure, and write a sheet for them."),
        "gcode": ("file", "Write a program that moves a machine to the poses of a plan."),
        "measure": ("session", "Measure the poses of a plan with a companion."),
        "fill": ("file", "Fill in the sheet of a plan from the export of an instrument."),
        "board": ("measurement", "Draw a board to print, for pictures by a phone or camera."),
        "photos": ("measurement", "Find the corners of a printed board in pictures."),
        "simulate": ("measurement", "Write a measurement file of a simulated machine."),
    },
    "Calibrate": {
        "calibrate": ("calibration", "Identify the parameters of a robot and validate them."),
        "report": ("calibration", "Write the report of a calibration as HTML, JSON and PDF."),
        "validate": ("calibration", "Validate a calibration, or a robot file, with measurements."),
        "repeatability": ("calibration", "Compute pose accuracy and repeatability by ISO 9283."),
        "accuracy": ("calibration", "Compute the largest position error in a volume."),
        "budget": ("calibration", "Show the uncertainty of a calibration by source."),
        "compare": (
            "calibration",
            "Compare calibrations side by side: has the machine changed, and in which part?",
        ),
        "check-up": ("calibration", "Test by a few poses whether a machine has changed."),
        "certificate": ("calibration", "Print a digital calibration certificate of a calibration."),
        "compensate": ("calibration", "Compute readings or commands that reach targets."),
        "regularize": (
            "calibration",
            "Show the error at held-out poses by the strength of regularization.",
        ),
    },
    "Examine the uncertainty": {
        "bootstrap": (
            "calibration",
            "Resample a calibration and compare the scatter with its intervals.",
        ),
        "sample": ("calibration", "Draw from the exact posterior of a calibration."),
    },
    "Simulate many calibrations": {
        "study": ("study", "Compare instruments, numbers of poses and methods by simulation.")
    },
    "Published studies": {
        "reproduce": ("study", "Repeat a published study and compare its numbers."),
        "per-leg": ("study", "Identify a hexapod leg by leg, to compare with calibrate."),
    },
    "Begin": {
        "example": ("file", "Write the files of an example, to try the commands with."),
        "completion": ("file", "Print the script with which a shell completes commands."),
    },
}


def find_command(name: str) -> click.Command | None:
    """Import a command; None where there is none of this name."""
    for members in SECTIONS.values():
        if name in members:
            module = import_module(f"loopcal.cli.commands.{members[name][0]}_commands")
            return getattr(module, name.replace("-", "_") + "_" * keyword.iskeyword(name))
    return None


class CommandGroup(click.Group):
    """A command that consists of commands; a wrong name is refused with similar ones."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the work, which is that of the code."""
        return list(self.commands)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command of the first word, or fail with the names of similar ones."""
        names = self.list_commands(ctx)
        if args[0] not in names and not args[0].startswith("-"):
            similar = suggest_names(args[0], names)
            ctx.fail(f"{args[0]!r} is not a command{similar}. See {ctx.command_path} --help")
        return super().resolve_command(ctx, args)


class SectionedGroup(CommandGroup):
    """The command `loopcal`, whose help lists its commands below headings."""

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
                formatter.write_dl([(name, what) for name, (_, what) in members.items()])


def _print_version(context: click.Context, _option: click.Parameter, is_asked: bool) -> None:
    """Print the version of loopcal and the engine that computes, and exit."""
    if not is_asked or context.resilient_parsing:
        return
    from loopcal.engine import get_current_engine

    click.echo(f"loopcal {loopcal.__version__}\nengine {get_current_engine()}")
    context.exit()


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
    callback=_print_version,
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, or these words after `loopcal`, and return its exit code."""
    pin_settings()
    words = list(sys.argv[1:] if arguments is None else arguments)
    terminal.prepare_streams()
    command = None
    with repeat_lost_interrupts(), record_outputs() as list_outputs:
        try:
            command = find_command(words[0]) if words else None
            if isinstance(command, click.Group) and len(words) > 1:
                command = command.commands.get(words[1], command)
            if command is not None and not _has_folder():
                return _report(FileNotFoundError(), command, words, ())
            code = command_line.main(words, "loopcal", standalone_mode=False, obj=words)
            terminal.flush_output()
            return code if isinstance(code, int) else 0
        except BrokenPipeError:  # the reader of our output stopped (`loopcal ... | head`)
            terminal.silence(sys.stdout)
            return 1
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 the one place for all of them
            return _report(error, command, words, tuple(list_outputs()))


def _has_folder() -> bool:
    """Return whether the working folder exists, from which relative paths count."""
    with suppress(OSError):
        return Path.cwd().is_dir()
    return False


def _report(
    error: BaseException,
    command: click.Command | None,
    words: Sequence[str],
    outputs: Sequence[Path],
) -> int:
    """Print what an exception means; return the exit code. `outputs` were complete before it."""
    if outputs:
        names = " and ".join(str(path) for path in outputs)
        terminal.print_message(f"loopcal: written completely before the following: {names}")
    unwritten = "" if outputs else ", and loopcal wrote no result"
    hint = None
    match error:
        case click.exceptions.NoArgsIsHelpError():
            terminal.print_message(error.format_message())
            return 1
        case click.BadParameter() | click.NoSuchOption():
            path = "loopcal" if error.ctx is None else error.ctx.command_path
            sentence, hint = error.format_message(), f"see {path} --help"
            if terminal.PAGE in os.environ:
                sentence, hint = error.message, None
        case click.ClickException():
            sentence = error.format_message()
        case OSError() | FileError() if not _has_folder():
            sentence = "the working folder has disappeared. Change to a folder that exists."
        case LoopcalError():
            finding = error.args[0] if error.args else None
            sentence, hint = str(error), find_hint(error.code, command)
            hint = word_hint(finding, hint) if isinstance(finding, Finding) else hint
            if not isinstance(error, FileError | MissingPackageError):  # which name the reason
                sentence = _name_inputs(sentence, hint, command, words)
        case KeyboardInterrupt() | click.exceptions.Abort():
            sentence = f"stopped before the end{unwritten}."
        case OSError():
            place = f"{error.filename}: " if error.filename else ""
            reason = (error.strerror or str(error)).lower()
            sentence = (
                f"{place}the operating system refused ({reason}). Check the path and its "
                "permissions."
            )
        case MemoryError():
            sentence = "there is not enough memory for this. Use fewer poses at a time."
        case _:
            _refuse(describe_defect(error, words), words, error)
            return 3
    return _refuse(sentence, words, error, hint)


def _name_inputs(
    sentence: str, hint: str | None, command: click.Command | None, words: Sequence[str]
) -> str:
    """Return a sentence with the inputs of the command in front, or without these with the options
    of its first word in quotes, where it names neither one of them nor an option; a word such as
    `run` is a name in quotes or before a colon.
    """
    is_named = re.search(r"(?<!\S)'?--?[a-z]", f"{sentence} {hint or ''}") is not None
    if command is None or is_named:
        return sentence
    rest = words[1 + (command.name != words[0]) :]
    given = command.make_context(None, list(rest), resilient_parsing=True).params
    values = (given[p.name or ""] for p in command.params if isinstance(p, click.Argument))
    names = [str(v) for of in values for v in (of if isinstance(of, tuple) else (of,)) if v]
    for name in names:
        is_word = name.isalpha()
        if any(form in sentence for form in ((f"{name}:", repr(name)) if is_word else (name,))):
            return sentence
    quoted = re.search("'([^']*)'", sentence)
    wrong = quoted[1] if quoted else ""
    options = [w for w, v in pairwise(rest) if w[:1] == "-" and wrong in v.split(",")]
    return f"{' and '.join((names or options)[:3])}: {sentence}" if names or options else sentence


def _refuse(
    sentence: str, words: Sequence[str], error: BaseException, hint: str | None = None
) -> int:
    """Print a sentence, and a hint where there is one, on standard error; return exit code 1.

    With --json among the words of the command, a document on standard output says the same.
    """
    sentence = " ".join(sentence.split())
    terminal.print_message(f"loopcal: {sentence}")
    if hint:
        terminal.print_message(f"Hint: {hint}")
    if "--json" in words:
        from loopcal.io.core.text_file import to_json

        with suppress(LoopcalError, BrokenPipeError):  # the sentence above is said all the same
            stated = {"type": type(error).__name__, "code": getattr(error, "code", None)}
            stated |= {"text": sentence, "hint": hint}
            terminal.print_text(to_json({"format": terminal.FORMAT, "error": stated}))
    return 1


@contextmanager
def repeat_lost_interrupts() -> Iterator[None]:
    """Raise an interrupt that a callback lost again, a moment after the callback."""
    report = sys.unraisablehook

    def interrupt_main_thread() -> None:
        time.sleep(0.01)  # [s], by then the callback has ended
        main = threading.main_thread().ident
        if main is not None and hasattr(signal, "pthread_kill"):  # reaches it while it waits
            signal.pthread_kill(main, signal.SIGINT)
        else:
            _thread.interrupt_main()

    def repeat_or_report(lost: sys.UnraisableHookArgs) -> None:
        if issubclass(lost.exc_type, KeyboardInterrupt):
            _thread.start_new_thread(interrupt_main_thread, ())  # raised here, it is lost again
        else:
            report(lost)

    sys.unraisablehook = repeat_or_report
    try:
        yield
    finally:
        sys.unraisablehook = report


def describe_defect(error: BaseException, words: Sequence[str]) -> str:
    """Save a report of an exception that is no mistake of the user; return what the user reads."""
    import platform
    import traceback
    from importlib.metadata import PackageNotFoundError, version

    package = Path(__file__).resolve().parents[1]
    frames = traceback.extract_tb(error.__traceback__, limit=-100)
    own = [frame for frame in frames if Path(frame.filename).is_relative_to(package)]
    place = type(error).__name__
    if own:
        file = Path(own[-1].filename).relative_to(package.parent).as_posix()
        place = f"{place} at {file}:{own[-1].lineno}"
    sentence = f"this is a defect of loopcal, not of your input ({place})"
    versions = {"loopcal": "unknown"}
    for name in ("loopcal", "numpy", "scipy", "ruamel.yaml", "msgspec", "click"):
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    listed = ", ".join(f"{name} {number}" for name, number in versions.items())
    machine = platform.uname()
    lines = (
        "loopcal stopped because of a defect. This report and the input files make it repeatable.",
        f"command: {shlex.join(['loopcal', *words])}",
        f"versions: {listed}, Python {platform.python_version()}",
        f"system: {machine.system} {machine.release} {machine.machine}",
        "",
        "".join(traceback.format_exception(error, limit=-100)),
    )
    path = save_report("\n".join(lines))
    if path is None:
        return (
            f"{sentence}. Saving the report failed: send the developers this message, the "
            f"command and the version {versions['loopcal']}"
        )
    return (
        f"{sentence}. Read {path}, which contains the command, versions and the Python "
        "traceback, and send it to the developers together with the input files"
    )


def save_report(text: str) -> Path | None:
    """Write a report to a new file in the temporary folder, or where that fails in the current one;
    return None where no file can be written.

    The name is unpredictable, and the file is made exclusively: nothing is replaced and no symbolic
    link is followed.
    """
    import tempfile

    for folder in (None, "."):
        try:
            number, name = tempfile.mkstemp(".txt", "loopcal-defect-", folder)
        except OSError:
            continue
        try:
            with os.fdopen(number, "w", encoding="utf-8", errors="backslashreplace") as stream:
                stream.write(text)
        except OSError:
            Path(name).unlink(missing_ok=True)
            continue
        return Path(name)
    return None
