# SPDX-License-Identifier: Apache-2.0
"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from loopcal.errors import UnitError
from loopcal.units import Dimension, quantity

FILE = click.Path(path_type=Path)

robot_argument = click.argument("robot", metavar="ROBOT")
data_argument = click.argument("data", metavar="DATA", type=FILE)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")


class Quantity(click.ParamType):
    """A number with its unit on the command line, such as 0.02mm; its value is in SI."""

    name = "quantity"

    def __init__(self, dimension: Dimension) -> None:
        self.dimension = dimension

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the SI value, or fail with what is allowed."""
        if isinstance(value, float):
            return value
        try:
            return quantity(value, self.dimension)
        except UnitError as error:
            self.fail(str(error), param, ctx)


def gate_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the quality gates: with one of them not met the command ends with exit code 2."""
    for name, dimension, example in (
        ("--limit-angle", Dimension.ANGLE, "0.01deg"),
        ("--limit-position", Dimension.LENGTH, "0.02mm"),
    ):
        what = "position" if dimension is Dimension.LENGTH else "orientation"
        text = f"Quality gate, such as {example}: exit with 2 where the largest {what} error on unseen poses is above it."
        command = click.option(name, type=Quantity(dimension), metavar="QUANTITY", help=text)(command)
    return command
