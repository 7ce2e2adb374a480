# SPDX-License-Identifier: Apache-2.0
"""Options for an accuracy goal, and for constraints on planned poses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import click

from loopcal.cli.options.shared_options import ANGLE, LENGTH, add_options, is_given
from loopcal.errors import DataError, UnitError
from loopcal.units import Dimension, parse_quantity

if TYPE_CHECKING:
    from loopcal.planning import Constraints
    from loopcal.typing import FloatArray


class Goal(click.ParamType):  # pyright: ignore[reportMissingTypeArgument]  # generic since 8.4
    """A length or an angle with its unit: of positions ("position") or of orientations."""

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


constraint_options = add_options(
    click.option(
        "--min-margin",
        type=float,
        default=0.1,
        help="Smallest distance from a singularity, as a share of the median of the workspace.",
    ),
    click.option(
        "--stroke-margin",
        type=Goal(),
        help="Distance of all readings from both ends of their strokes, such as 5mm; 2deg for "
        "actuators that turn.",
    ),
    click.option("--max-tilt", type=ANGLE, help="Largest tilt of the platform, such as 20deg."),
    click.option(
        "--seen-from",
        metavar="X,Y,Z",
        help="Position of the instrument in the base frame, such as 1.5m,-0.8m,1.1m.",
    ),
    click.option(
        "--facing",
        default="0,0,1",
        metavar="X,Y,Z",
        help="With --seen-from: direction of the target in the axes of the platform.",
    ),
    click.option(
        "--cone",
        type=ANGLE,
        default="90deg",
        help="With --seen-from: half angle of the cone in which the target is visible.",
    ),
    click.option(
        "--nearest",
        type=LENGTH,
        default="0mm",
        help="With --seen-from: smallest distance of the target.",
    ),
    click.option(
        "--farthest", type=LENGTH, help="With --seen-from: largest distance of the target."
    ),
)
"""Decorator of a command that plans; `make_constraints` takes their values."""


def make_constraints(options: Mapping[str, Any]) -> Constraints:
    """Return the constraints of the library from those of `constraint_options`."""
    from loopcal.planning import Constraints, LineOfSight

    margin, measured = options["stroke_margin"] or (0.0, "position")
    margins = {"stroke_margin" if measured == "position" else "stroke_margin_angle": margin}
    if options["seen_from"] is None:
        for name in ("facing", "cone", "nearest", "farthest"):
            if is_given(name):
                raise DataError(
                    f"--{name} belongs to a line of sight; state the position of the instrument "
                    "with --seen-from"
                )
        return Constraints(options["min_margin"], options["max_tilt"], None, **margins)
    sight = LineOfSight(
        _parse_three(options["seen_from"], "--seen-from", Dimension.LENGTH),
        _parse_three(options["facing"], "--facing", None),
        options["cone"],
        options["nearest"],
        math.inf if options["farthest"] is None else options["farthest"],
    )
    return Constraints(options["min_margin"], options["max_tilt"], sight, **margins)


def _parse_three(text: str, option: str, dimension: Dimension | None) -> FloatArray:
    """Return three numbers (3,), with units where they have a dimension."""
    import numpy as np

    words = text.split(",")
    reason = ""
    try:
        numbers = [
            float(word) if dimension is None else parse_quantity(word, dimension) for word in words
        ]
    except (UnitError, ValueError) as error:
        numbers, reason = [], f" ({error})"
    if len(numbers) != 3:
        example = "0,0,1" if dimension is None else "1.5m,-0.8m,1.1m"
        raise DataError(f"{option} is {text!r}{reason}; give three numbers, such as {example}")
    return np.array(numbers)
