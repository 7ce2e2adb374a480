# SPDX-License-Identifier: Apache-2.0
"""Options that describe an instrument, its noise and the poses at which it measures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click

from loopcal.cli.options.shared_options import POSITIVE_ANGLE, POSITIVE_LENGTH, Count, add_options
from loopcal.errors import DataError, UnitError, suggest_names
from loopcal.units import parse_quantity

if TYPE_CHECKING:
    import numpy as np

    from loopcal.measure import Instrument
    from loopcal.mechanism import Mechanism

TILT = {"phi", "theta", "psi"}
"""Components that are angles of tilt and torsion."""

DESCRIPTION = (
    "measure",
    "frames",
    "targets",
    "kind",
    "components",
    "orientation",
    "sigma_position",
    "sigma_angle",
)
"""Names of the options that describe an instrument."""


instrument_options = add_options(
    click.option(
        "--kind",
        default="pose",
        help="Kind of measurement: pose, component, position, bearing, ...; or several, such "
        "as position,inclination.",
    ),
    click.option(
        "--components",
        metavar="NAMES",
        help="Coordinates that the kind 'component' measures, such as z or x,y,z.",
    ),
    click.option(
        "--orientation",
        metavar="FORM",
        help="Form of measured angles: rotation-vector, quaternion, tilt-torsion, euler-xyz, ...",
    ),
    click.option(
        "--sigma-position",
        type=POSITIVE_LENGTH,
        default="0.01mm",
        help="Standard deviation of each measured length.",
    ),
    click.option(
        "--sigma-angle",
        type=POSITIVE_ANGLE,
        default="50urad",
        help="Standard deviation of each measured angle.",
    ),
)
"""Decorator for the kind of measurement and its noise; `make_instrument` takes their values."""

unknown_options = add_options(
    click.option(
        "--measure",
        metavar="NAMES",
        help="Short for --kind component --components NAMES: some of x,y,z,phi,theta,psi.",
    ),
    click.option(
        "--frames",
        metavar="NAMES",
        help="Unknown frames: base (the frame of the instrument in the base), tool, or base,tool.",
    ),
    click.option(
        "--targets",
        metavar="NAMES",
        help="Targets at unknown places on the platform, of a kind such as position: "
        "SMR1,SMR2,SMR3.",
    ),
)
"""Decorator for the short form of components, and for unknown frames and targets."""

draw_option = click.option(
    "--draw",
    type=Count("DRAWN_POSES", 1),
    default=40,
    metavar="N",
    help="Number of poses to draw evenly from the workspace where no poses are given.",
)

distribution_option = click.option(
    "--distribution",
    type=click.Choice(("normal", "uniform")),
    default="normal",
    help="Distribution of the noise of measured values. Uniform noise lies within sqrt(3) = 1.732 "
    "standard deviations; a limit of 1 um is --sigma-position 0.57735um.",
)
"""Decorator of a command that simulates noise."""

sigma_reading_option = click.option(
    "--sigma-reading",
    metavar="QUANTITY",
    help="Standard deviation of the recorded actuator readings, for all or each, such as "
    "q1=5um,q2=20urad.  [default: as in the robot file]",
)


def make_instrument(options: Mapping[str, Any], robot: Mechanism | None = None) -> Instrument:
    """Return the instrument of `instrument_options`, and of `unknown_options` if there are any.

    `robot` : gives targets of unknown place an assumed one; only needed where there are targets.

    Raises
    ------
    DataError
        Options that contradict each other, or an unknown kind, frame or component.
    """
    from loopcal.workflow.instrument_description import (
        InstrumentDescription,
        build_instrument,
        place_targets,
    )

    kind, components = options["kind"], options["components"]
    orientation, measure = options["orientation"], options.get("measure")
    if measure is not None:
        if components is not None or kind != "pose":
            raise DataError(
                "--measure is short for --kind component --components; give one or the other"
            )
        kind, components = "component", measure
        if orientation is None and TILT & set(measure.split(",")):
            orientation = "tilt-torsion"
    frames, targets = options.get("frames"), options.get("targets")
    instrument = build_instrument(
        InstrumentDescription(
            kinds=tuple(kind.split(",")),
            components=tuple(components.split(",")) if components else (),
            orientation=orientation,
            sigma_position=options["sigma_position"],
            sigma_angle=options["sigma_angle"],
            unknown_frames=tuple(frames.split(",")) if frames is not None else (),
            targets=tuple(targets.split(",")) if targets is not None else (),
            distribution=options.get("distribution", "normal"),
        )
    )
    return instrument if robot is None else place_targets(instrument, robot)


def parse_reading_sigma(text: str | None, robot: Mechanism) -> np.ndarray | None:
    """Return the standard deviations (a,) [SI] that --sigma-reading states; None without it.

    Raises
    ------
    DataError
        A negative number, a wrong unit, or an actuator that the robot does not have.
    """
    import numpy as np

    if text is None:
        return None
    sigma = {a.name: a.sigma or 0.0 for a in robot.actuators}
    dimensions = {a.name: a.dimension for a in robot.actuators}
    for part in text.split(","):
        name, equals, number = part.rpartition("=")
        if equals and name not in sigma:
            raise DataError(
                f"--sigma-reading names {name!r}{suggest_names(name, sigma)}; the actuators of "
                f"{robot.name} are {', '.join(sigma)}"
            )
        for actuator in (name,) if equals else tuple(sigma):
            try:
                sigma[actuator] = parse_quantity(number, dimensions[actuator])
            except UnitError as error:
                raise DataError(f"--sigma-reading {number!r} for {actuator}: {error}") from None
            if not 0.0 <= sigma[actuator] < np.inf:
                raise DataError(
                    f"--sigma-reading for {actuator} is {number}; give a number above zero, or "
                    "zero for exact readings"
                )
    return np.array(list(sigma.values()))
