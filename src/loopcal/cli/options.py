# SPDX-License-Identifier: Apache-2.0
"""Arguments and options that several commands share."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from loopcal.errors import DataError, UnitError, suggest_names
from loopcal.units import Dimension, parse_quantity

if TYPE_CHECKING:
    import numpy as np

    from loopcal.measure import Instrument, Measurements
    from loopcal.mechanism import Mechanism

FILE = click.Path(path_type=Path)

robot_argument = click.argument("robot", metavar="ROBOT")
data_argument = click.argument("data", metavar="DATA...", type=FILE, nargs=-1, required=True)
json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document and nothing else."
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


def gate_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the quality gates: with one of them not met the command ends with exit code 2."""
    for name, dimension, example in (
        ("--limit-angle", Dimension.ANGLE, "0.01deg"),
        ("--limit-position", Dimension.LENGTH, "0.02mm"),
    ):
        what = "position" if dimension is Dimension.LENGTH else "orientation"
        text = f"Quality gate, such as {example}: exit with 2 where the largest {what} error on unseen poses is above it."
        command = click.option(name, type=Quantity(dimension), metavar="QUANTITY", help=text)(
            command
        )
    return command


def data_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the flags that let implausible measurements pass; the command gets them as `allowed`, for
    `measurements`.
    """
    flags = {
        "allow_duplicates": "Accept rows that repeat another to the last digit.",
        "allow_implausible": "Accept values that fit far better in another unit, order, sign or "
        "column.",
        "allow_outside_stroke": "Accept readings outside the stroke of their actuator.",
        "allow_still": "Accept a target that no pose moves.",
    }

    @functools.wraps(command)
    def packed(**given: Any) -> Any:
        allowed = {name: given.pop(name) for name in flags}
        return command(**given, allowed=allowed)

    for name, what in flags.items():
        packed = click.option("--" + name.replace("_", "-"), is_flag=True, help=what)(packed)
    return packed


def measurements(paths: Sequence[Path], robot: Mechanism, **allowed: bool) -> Measurements:
    """Read measurement files as one set, with a note on standard error where one says that it is of
    another robot.

    Raises
    ------
    LoopcalError
        See `loopcal.io.load_measurements`.
    """
    from loopcal.io import load_measurements
    from loopcal.io.core.csv_table import read_robot_name

    found = load_measurements(paths, robot, **allowed)
    for path in paths:
        stated = read_robot_name(path)
        if stated is not None and stated != robot.name:
            click.echo(
                f"loopcal: note: {path} is said to be of robot {stated!r}, but {robot.name!r} is "
                "used",
                err=True,
            )
    return found


def draw_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add how many poses are drawn where none are given; `drawn_poses` draws them."""
    text = "Where no poses are given: how many to draw evenly from the workspace that the robot file states."
    return click.option(
        "--draw", type=click.IntRange(min=1), default=40, show_default=True, metavar="N", help=text
    )(command)


def drawn_poses(robot: Mechanism, count: int, seed: int) -> tuple[np.ndarray, str]:
    """Return controlled coordinates (n, c) drawn from a robot's workspace, and what to say of them.

    Raises
    ------
    MechanismError
        The robot states no workspace, or cannot reach it.
    """
    from loopcal.mechanism import sample_workspace

    words = f"{count} poses drawn from the workspace of {robot.name}, seed {seed}"
    return sample_workspace(robot, count, seed).coordinates, words


def instrument_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add what describes an instrument; `instrument` makes one of them."""
    length, angle = Quantity(Dimension.LENGTH), Quantity(Dimension.ANGLE)
    forms = "rotation-vector, quaternion, tilt-torsion, euler-xyz, ..."
    for option in (
        click.option("--sigma-angle", type=angle, default="50urad", show_default=True, metavar="QUANTITY",
                     help="Standard deviation of each measured angle."),
        click.option("--sigma-position", type=length, default="0.01mm", show_default=True, metavar="QUANTITY",
                     help="Standard deviation of each measured length."),
        click.option("--orientation", help=f"How angles are written: {forms}"),
        click.option("--components", help="For the kind component: which coordinates, such as z or "
                                          "x,y,z."),
        click.option("--kind", default="pose", show_default=True,
                     help="Kind of measurement: pose, component, position, bearing, ...; or "
                          "several, as position,inclination."),
    ):  # fmt: skip
        command = option(command)
    return command


sigma_reading_option = click.option(
    "--sigma-reading",
    metavar="QUANTITY",
    help="Standard deviation of the recorded readings, for all or such as q1=5um,q2=20urad. "
    "[default: as the robot file says]",
)


def sigma_of_readings(text: str | None, robot: Mechanism) -> np.ndarray | None:
    """Return the standard deviation (a,) [SI] of each reading that --sigma-reading states; None
    where it is not there.

    Raises
    ------
    DataError
        Not a quantity above zero or zero, of another dimension than the reading, or of an actuator
        that is not there.
    """
    import numpy as np

    if text is None:
        return None
    found = {a.name: a.sigma or 0.0 for a in robot.actuators}
    dimensions = {a.name: a.dimension for a in robot.actuators}
    for part in text.split(","):
        name, equals, number = part.rpartition("=")
        if equals and name not in found:
            known = ", ".join(found)
            raise DataError(
                f"--sigma-reading names {name!r}{suggest_names(name, found)}; actuators of {robot.name} "
                f"are {known}"
            )
        for each in (name,) if equals else tuple(found):
            try:
                found[each] = parse_quantity(number, dimensions[each])
            except UnitError as error:
                raise DataError(f"--sigma-reading {number!r} for {each}: {error}") from None
            if not 0.0 <= found[each] < np.inf:
                raise DataError(
                    f"--sigma-reading for {each} is {number}; give a number above zero, or zero "
                    "for exact"
                )
    return np.array(list(found.values()))


def instrument(
    kind: str,
    components: str | None,
    orientation: str | None,
    sigma_position: float,
    sigma_angle: float,
) -> Instrument:
    """Return the instrument that `instrument_options` describe.

    Raises
    ------
    DataError
        Unknown kind, or an option that does not belong to it.
    """
    import numpy as np

    from loopcal.io.data.kind_settings import list_kind_settings
    from loopcal.measure import KINDS, Gaussian, Instrument, Sensor

    kinds, made = kind.split(","), []
    stated = {"components": components and tuple(components.split(",")), "orientation": orientation}
    settings = {name: value for name, value in stated.items() if value}
    sigma = {Dimension.LENGTH: sigma_position, Dimension.ANGLE: sigma_angle}
    for i, one in enumerate(kinds):
        if one not in KINDS:
            raise DataError(
                f"{one!r} is not a kind of measurement{suggest_names(one, KINDS)}; known are "
                f"{', '.join(KINDS)}"
            )
        if one in kinds[:i]:
            raise DataError(
                f"the kind {one!r} is named twice; name it once, and write the other into the file "
                "by hand"
            )
        known = list_kind_settings(KINDS[one])
        looking = KINDS[one](**{name: value for name, value in settings.items() if name in known})
        made.append(
            Sensor(looking, Gaussian(np.array([sigma[c.dimension] for c in looking.noise_columns])))
        )
    for name in settings:
        if not any(name in list_kind_settings(KINDS[one]) for one in kinds):
            raise DataError(
                f"--{name} does not belong to the kind {kind!r}; leave it out, or choose another "
                "kind"
            )
    return Instrument(tuple(made))
