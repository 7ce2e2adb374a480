# SPDX-License-Identifier: Apache-2.0
"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loopcal.errors import DataError, UnitError
from loopcal.units import Dimension, parse_quantity

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from loopcal.diagnose import ConventionCheck
    from loopcal.findings import Finding
    from loopcal.measure import Measurements
    from loopcal.mechanism import Mechanism

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]
"""Adds an option to the function of a command."""

FILE = click.Path(path_type=Path)


def complete_robot(
    _context: click.Context, _argument: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Return the shipped robots that begin as a word; files where there is none."""
    from click.shell_completion import CompletionItem

    from loopcal.io.robot.robot_file import list_shipped_robots

    names = [name for name in list_shipped_robots() if name.startswith(incomplete)]
    return [CompletionItem(name) for name in names] or [CompletionItem(incomplete, type="file")]


robot_argument = click.argument("robot", metavar="ROBOT", shell_complete=complete_robot)
json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document instead of text."
)
verbose_option = click.option(
    "-v", "--verbose", is_flag=True, help="Print all findings and tables, not only the summary."
)


def _check_data(_context: click.Context, _argument: click.Parameter, paths: Any) -> Any:
    """Refuse a YAML file, such as a robot file, in place of measurements."""
    for path in paths if isinstance(paths, tuple) else () if paths is None else (paths,):
        if path.suffix in (".yaml", ".yml"):
            raise DataError(f"{path} is a YAML file; give a measurement file (CSV)")
    return paths


def data_argument(metavar: str, required: bool = True) -> Decorator:
    """Return the argument of measurement files."""
    kind = {"type": FILE, "nargs": -1, "required": required}
    return click.argument("data", metavar=metavar, callback=_check_data, **kind)


def data_option(name: str, help_text: str, **kind: Any) -> Decorator:
    """Return an option that takes a measurement file."""
    return click.option(
        name, type=FILE, metavar="DATA", callback=_check_data, help=help_text, **kind
    )


class Quantity(click.ParamType):  # pyright: ignore[reportMissingTypeArgument]  # generic since 8.4
    """A number with its unit on the command line, such as 0.02mm; its value is in SI.

    Parameters
    ----------
    dimension : of the unit. is_positive : whether only numbers above 0 are allowed.
    """

    name = "quantity"

    def __init__(self, dimension: Dimension, is_positive: bool = False) -> None:
        self.dimension, self.is_positive = dimension, is_positive

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the SI value, or fail with what is allowed."""
        if isinstance(value, float):
            return value
        try:
            number = parse_quantity(value, self.dimension)
        except UnitError as error:
            self.fail(str(error), param, ctx)
        if self.is_positive and not number > 0.0:
            self.fail(f"{value!r} is not above 0; give a positive number", param, ctx)
        return number


class Count(click.IntRange):
    """A whole number on the command line, up to a limit of `loopcal.io.core.limits`.

    Parameters
    ----------
    limit : name of the `CountLimit`, which is not imported before the option is used.
    least : smallest number that is allowed; None where the command itself refuses small ones.
    """

    def __init__(self, limit: str, least: int | None = None) -> None:
        super().__init__(min=least)
        self.limit = limit

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the number, or fail with what is allowed."""
        from loopcal.io.core import limits

        number, limit = super().convert(value, param, ctx), getattr(limits, self.limit)
        if number > limit.most:
            self.fail(f"the limit is {limit}; give a smaller number.", param, ctx)
        return int(number)


class PoseShare(click.types.FloatParamType):
    """A share of the poses on the command line, from 0 to below 1."""

    name = "share"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the share, or fail with what is allowed and what was probably meant."""
        from loopcal.workflow.calibration_options import describe_wrong_share

        try:
            share = float(value)
        except ValueError:
            allowed = "a share of the poses is a number from 0 to below 1, such as 0.25 for 25 %"
            self.fail(f"{value!r} is no number; {allowed}.", param, ctx)
        if fault := describe_wrong_share(share):
            self.fail(f"it is {fault}.", param, ctx)
        return share


LENGTH = Quantity(Dimension.LENGTH)
ANGLE = Quantity(Dimension.ANGLE)
POSITIVE_LENGTH = Quantity(Dimension.LENGTH, is_positive=True)
POSITIVE_ANGLE = Quantity(Dimension.ANGLE, is_positive=True)


def add_options(*options: Decorator) -> Decorator:
    """Return a decorator that adds options to a command, in the order of its help."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


def file_option(*names: str, **kind: Any) -> Decorator:
    """Return an option that takes the path of a file or folder."""
    return click.option(*names, type=FILE, **kind)


def flag_option(*names: str, help: str) -> Decorator:  # noqa: A002
    """Return an option without a value."""
    return click.option(*names, is_flag=True, help=help)


SHIPPED_PROFILES = ("faro", "leica", "spatial-analyzer")
"""Profiles that come with loopcal."""


def profile_option(help_text: str, *, required: bool = False) -> Decorator:
    """Return the option for the profile of an export: a file, or the name of a shipped one."""
    names = ", ".join(SHIPPED_PROFILES)
    return click.option(
        "--profile",
        metavar="FILE|NAME",
        required=required,
        help=f"{help_text} A file (docs/exports.md), or one of {names}.",
    )


decimal_option = click.option(
    "--decimal",
    type=click.Choice(("point", "comma")),
    help="Decimal mark of the export; with comma, semicolons separate columns in place of commas.  "
    "[default: as the profile states]",
)


def force_option(what: str, more: str = "") -> Decorator:
    """Return the option that lets a command replace what exists, and `more`."""
    return flag_option(
        "--force",
        help=f"Replace {what} if {'they exist' if what.endswith('files') else 'it exists'}{more}.",
    )


def seed_option(what: str) -> Decorator:
    """Return the option for the seed of something random."""
    kind = click.IntRange(min=0)
    return click.option("--seed", type=kind, default=1, metavar="N", help=f"Seed of {what}.")


def format_option(names: Sequence[str], help_text: str) -> Decorator:
    """Return the option for the format of a file of another program."""
    return click.option("--format", "format_name", type=click.Choice(names), help=help_text)


def frame_option(names: str = "fitted, base, relative, or the frame of an instrument") -> Decorator:
    """Return the option for the frame in which errors are stated."""
    return click.option(
        "--frame",
        default="fitted",
        metavar="NAME",
        show_default=True,
        help=f"Frame in which errors are stated: {names}. 'fitted' is after the best rigid fit of "
        "the base and platform frames, as far as the measurements do not determine them.",
    )


def _limit_option(name: str, kind: Quantity, quantity: str, example: str) -> Decorator:
    text = f"Largest allowed {quantity} error on poses that were not fitted, such as {example}"
    return click.option(name, type=kind, help=f"{text}; above it the exit code is 2.")


limit_options = add_options(
    _limit_option("--limit-position", POSITIVE_LENGTH, "position", "0.02mm"),
    _limit_option("--limit-angle", POSITIVE_ANGLE, "orientation", "0.01deg"),
)
"""Decorator for limits on the errors."""

DATA_FLAGS = {
    "allow_still": "Accept a target that does not move from pose to pose.",
    "allow_outside_stroke": "Accept readings outside the stroke of their actuator.",
    "allow_implausible": "Accept values that fit far better in another unit, order, sign or "
    "column.",
    "allow_duplicates": "Accept rows that repeat another row to the last digit.",
}

data_options = add_options(
    *(
        click.option("--" + name.replace("_", "-"), is_flag=True, help=text)
        for name, text in DATA_FLAGS.items()
    )
)
"""Decorator for the flags that accept suspicious measurements; `take_flags` takes their values."""


def take_flags(options: Mapping[str, Any]) -> dict[str, bool]:
    """Return the values of `data_options`, for `read_checked_measurements`."""
    return {name: options[name] for name in DATA_FLAGS}


def name_option(name: str) -> str:
    """Return the option of the running command that has this name in its function."""
    parameters = click.get_current_context().command.params
    return next(option.opts[-1] for option in parameters if option.name == name)


def is_given(name: str) -> bool:
    """Return whether the user stated an option on the command line."""
    source = click.get_current_context().get_parameter_source(name)
    return source is click.core.ParameterSource.COMMANDLINE


def refuse_given(names: Iterable[str], reason: str) -> None:
    """Raise DataError for the first of these options that the user stated.

    Parameters
    ----------
    reason : a clause such as "because ..." or "with --profile".
    """
    for name in names:
        if is_given(name):
            raise DataError(f"{name_option(name)} has no effect {reason}; leave it out")


def read_checked_measurements(
    paths: Sequence[Path],
    robot: Mechanism,
    *,
    allow_still: bool = False,
    allow_implausible: bool = False,
    **allowed: bool,
) -> Measurements:
    """Read measurement files as `read_measurements`, and check their conventions.

    Raises
    ------
    LoopcalError
        See `loopcal.io.load_measurements` and `loopcal.check_conventions`.
    """
    from loopcal.diagnose import check_conventions

    data = read_measurements(paths, robot, **allowed)
    check = check_conventions(
        robot, data, allow_still=allow_still, allow_implausible=allow_implausible
    )
    print_convention_note(check, paths)
    return data


def _refuse_explained_strokes(
    stated: Finding, paths: Sequence[Path], robot: Mechanism, allowed: Mapping[str, bool]
) -> None:
    """Refuse readings outside their strokes, described by `data.outside-stroke`, if another unit,
    order, sign or zero explains them.
    """
    from loopcal.diagnose import explain_outside_strokes
    from loopcal.io import load_measurements

    data = load_measurements(paths, robot, **{**allowed, "allow_outside_stroke": True})
    explained = explain_outside_strokes(robot, data, stated.data)
    if explained is not None:
        text = f"{' and '.join(map(str, paths))}: {explained}"
        raise DataError(text) from DataError(explained)


def print_convention_note(check: ConventionCheck, paths: Sequence[Path]) -> None:
    """Print a note where a check of these files leaves a doubt."""
    from loopcal.cli import terminal

    if check.finding is not None:
        terminal.print_note(f"{' and '.join(map(str, paths))}: {check.finding}")


def leave_out_held_out(data: Measurements) -> Measurements:
    """Return the poses that a fit would use; print a note where others are held out."""
    from loopcal.cli import terminal
    from loopcal.findings import report_finding

    if count := int(data.is_held_out.sum()):
        terminal.print_note(str(report_finding("data.held-out-not-counted", count=count)))
    return data.fitted


def read_measurements(paths: Sequence[Path], robot: Mechanism, **allowed: bool) -> Measurements:
    """Read measurement files as one set.

    Print a note where a file names another robot, or another file by its absolute path, or contains
    no measured value.

    Raises
    ------
    LoopcalError
        See `loopcal.io.load_measurements`.
    """
    from loopcal.cli import terminal
    from loopcal.findings import report_finding
    from loopcal.io import load_measurements
    from loopcal.io.core.csv_table import read_settings
    from loopcal.io.core.references import list_absolute_references
    from loopcal.io.data.measurement_file import list_unfilled_files

    for path in paths:
        settings = read_settings(path)
        for finding in list_absolute_references(settings):
            terminal.print_note(str(finding))
        stated = str(settings.content.get("robot") or "").strip()
        if stated not in ("", robot.name):
            code = "workflow.robot-of-other-name"
            note = report_finding(code, file=str(path), stated=stated, used=robot.name)
            terminal.print_note(str(note))
    try:
        with terminal.ProgressBar() as progress:
            progress(0, 1, "reading the measurements")
            data = load_measurements(paths, robot, **allowed)
            unfilled = list_unfilled_files(paths, data)
    except DataError as error:
        if error.finding is not None and error.finding.code == "data.outside-stroke":
            _refuse_explained_strokes(error.finding, paths, robot, allowed)
        raise
    for file in unfilled:
        terminal.print_note(str(report_finding("files.no-measured-value", file=str(file))))
    return data
