# SPDX-License-Identifier: Apache-2.0
"""Options for an accuracy goal, and for constraints on planned poses."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import click

from loopcal.cli.options import ANGLE, LENGTH, is_given
from loopcal.errors import DataError, UnitError
from loopcal.units import Dimension, parse_quantity

if TYPE_CHECKING:
    from loopcal.planning import Constraints


class Goal(click.ParamType):
    """An accuracy with its unit: a length for positions, an angle for orientations."""

    name = "quantity"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, str]:
        """Return the SI value and the quantity it limits, or fail with what is allowed."""
        if isinstance(value, tuple):
            return value
        with suppress(UnitError):
            return parse_quantity(value, Dimension.ANGLE), "orientation"
        try:
            return parse_quantity(value, Dimension.LENGTH), "position"
        except UnitError as error:
            self.fail(f"{error}; or give an angle, such as 10urad", param, ctx)


@dataclass(frozen=True)
class ConstraintArguments:
    """The options of `constraint_options` as the user gave them."""

    min_margin: float
    max_tilt: float | None
    seen_from: str | None
    facing: str
    cone: float
    nearest: float
    farthest: float | None

    def to_constraints(self) -> Constraints:
        """Return the constraints of the library."""
        from loopcal.planning import Constraints, LineOfSight

        if self.seen_from is None:
            for name in ("facing", "cone", "nearest", "farthest"):
                if is_given(name):
                    raise DataError(
                        f"--{name} belongs to a line of sight; state the position of the "
                        "instrument with --seen-from"
                    )
            return Constraints(self.min_margin, self.max_tilt)
        sight = LineOfSight(
            _parse_three(self.seen_from, "--seen-from", Dimension.LENGTH),
            _parse_three(self.facing, "--facing", None),
            self.cone,
            self.nearest,
            math.inf if self.farthest is None else self.farthest,
        )
        return Constraints(self.min_margin, self.max_tilt, sight)


def constraint_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add constraints on planned poses; the command gets them as `constraint_arguments`."""
    names = [f.name for f in fields(ConstraintArguments)]

    @functools.wraps(command)
    def packed(**given: Any) -> Any:
        arguments = ConstraintArguments(**{name: given.pop(name) for name in names})
        return command(**given, constraint_arguments=arguments)

    options = (
        click.option(
            "--farthest", type=LENGTH, metavar="QUANTITY", help="Largest distance of the target."
        ),
        click.option(
            "--nearest",
            type=LENGTH,
            default="0mm",
            metavar="QUANTITY",
            help="Smallest distance of the target.",
        ),
        click.option(
            "--cone",
            type=ANGLE,
            default="90deg",
            show_default=True,
            metavar="QUANTITY",
            help="With --seen-from: half angle of the cone in which the target is visible.",
        ),
        click.option(
            "--facing",
            default="0,0,1",
            show_default=True,
            metavar="X,Y,Z",
            help="With --seen-from: direction of the target in the axes of the platform.",
        ),
        click.option(
            "--seen-from",
            metavar="X,Y,Z",
            help="Position of the instrument in the base frame, such as 1.5m,-0.8m,1.1m.",
        ),
        click.option(
            "--max-tilt",
            type=ANGLE,
            metavar="QUANTITY",
            help="Largest tilt of the platform, such as 20deg.",
        ),
        click.option(
            "--min-margin",
            type=float,
            default=0.1,
            show_default=True,
            help="Smallest distance from a singularity, as a share of the median of the workspace.",
        ),
    )
    for option in options:
        packed = option(packed)
    return packed


def _parse_three(text: str, option: str, dimension: Dimension | None) -> Any:
    """Return three numbers (3,), with units where they have a dimension."""
    import numpy as np

    parts = text.split(",")
    reason = ""
    try:
        numbers = [
            float(part) if dimension is None else parse_quantity(part, dimension) for part in parts
        ]
    except (UnitError, ValueError) as error:
        numbers, reason = [], f" ({error})"
    if len(numbers) != 3:
        example = "0,0,1" if dimension is None else "1.5m,-0.8m,1.1m"
        raise DataError(f"{option} is {text!r}{reason}; give three numbers, such as {example}")
    return np.array(numbers)
