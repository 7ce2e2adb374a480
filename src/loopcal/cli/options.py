# SPDX-License-Identifier: Apache-2.0
"""Arguments and options that several commands share."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loopcal.errors import DataError, UnitError
from loopcal.units import Dimension, parse_quantity

if TYPE_CHECKING:
    from loopcal.diagnose import ConventionCheck
    from loopcal.measure import Measurements
    from loopcal.mechanism import Mechanism

FILE = click.Path(path_type=Path)

robot_argument = click.argument("robot", metavar="ROBOT")
data_argument = click.argument("data", metavar="DATA...", type=FILE, nargs=-1, required=True)
json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document instead of text."
)
verbose_option = click.option(
    "-v", "--verbose", is_flag=True, help="Print all findings and tables, not only the summary."
)


class Quantity(click.ParamType):
    """A number with its unit on the command line, such as 0.02mm; its value is in SI."""

    name = "quantity"

    def __init__(self, dimension: Dimension) -> None:
        self.dimension = dimension

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the SI value, or fail with what is allowed."""
        if isinstance(value, float):
            return value
        try:
            return parse_quantity(value, self.dimension)
        except UnitError as error:
            self.fail(str(error), param, ctx)


LENGTH = Quantity(Dimension.LENGTH)
ANGLE = Quantity(Dimension.ANGLE)


def force_option(what: str) -> Callable[..., Any]:
    """Return the option that lets a command replace what exists."""
    return click.option("--force", is_flag=True, help=f"Replace {what} if it exists.")


def seed_option(what: str) -> Callable[..., Any]:
    """Return the option for the seed of something random."""
    kind = click.IntRange(min=0)
    text = f"Seed of {what}."
    return click.option("--seed", type=kind, default=1, show_default=True, help=text)


def limit_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add limits on the errors: where one is exceeded, the exit code is 2."""
    for name, kind, quantity, example in (
        ("--limit-angle", ANGLE, "orientation", "0.01deg"),
        ("--limit-position", LENGTH, "position", "0.02mm"),
    ):
        text = (
            f"Largest allowed {quantity} error on poses that were not fitted, such as {example}; "
            "above it the exit code is 2."
        )
        command = click.option(name, type=kind, metavar="QUANTITY", help=text)(command)
    return command


def data_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the flags that accept suspicious measurements; the command gets them as `allowed`."""
    flags = {
        "allow_duplicates": "Accept rows that repeat another row to the last digit.",
        "allow_implausible": "Accept values that fit far better in another unit, order, sign or "
        "column.",
        "allow_outside_stroke": "Accept readings outside the stroke of their actuator.",
        "allow_still": "Accept a target that does not move from pose to pose.",
    }

    @functools.wraps(command)
    def packed(**given: Any) -> Any:
        allowed = {name: given.pop(name) for name in flags}
        return command(**given, allowed=allowed)

    for name, what in flags.items():
        packed = click.option("--" + name.replace("_", "-"), is_flag=True, help=what)(packed)
    return packed


def is_given(name: str) -> bool:
    """Return whether the user stated an option on the command line."""
    source = click.get_current_context().get_parameter_source(name)
    return source is click.core.ParameterSource.COMMANDLINE


def refuse_given(names: Iterable[str], reason: str) -> None:
    """Raise DataError for the first of these options that the user stated.

    Parameters
    ----------
    reason : a clause that begins with "because".
    """
    for name in names:
        if is_given(name):
            raise DataError(f"--{name.replace('_', '-')} has no effect {reason}; leave it out")


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


def print_convention_note(check: ConventionCheck, paths: Sequence[Path]) -> None:
    """Print a note where a check of these files leaves a doubt."""
    from loopcal.cli import terminal

    if check.finding is not None:
        terminal.print_note(f"{' and '.join(map(str, paths))}: {check.finding}")


def read_measurements(paths: Sequence[Path], robot: Mechanism, **allowed: bool) -> Measurements:
    """Read measurement files as one set; print a note where a file names another robot.

    Raises
    ------
    LoopcalError
        See `loopcal.io.load_measurements`.
    """
    from loopcal.cli import terminal
    from loopcal.findings import report_finding
    from loopcal.io import load_measurements
    from loopcal.io.core.csv_table import read_robot_name

    data = load_measurements(paths, robot, **allowed)
    for path in paths:
        stated = read_robot_name(path)
        if stated is not None and stated != robot.name:
            code = "workflow.robot-of-other-name"
            note = report_finding(code, file=str(path), stated=stated, used=robot.name)
            terminal.print_note(str(note))
    return data
