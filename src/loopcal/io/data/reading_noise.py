# SPDX-License-Identifier: Apache-2.0
"""How far the readings of a measurement file are believed.

    reading_noise: 5 um                     standard deviation of every reading, 0 um where they are exact
    reading_noise: {q1: 5 um, q2: 8 um}     or of some of them

A column `sigma.q1 [um]` holds it where it differs from pose to pose, `inf` for a reading that is
not to be believed; an empty cell means what the setting, or else the robot file, says, and is
refused where neither says anything. With a setting or column an empty reading is one that was not
taken; without, it is refused.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from loopcal.errors import UnitError
from loopcal.io.core.yaml_file import Location, refuse_unknown_keys
from loopcal.units import Dimension, parse_quantity

if TYPE_CHECKING:
    import numpy as np

    from loopcal.io.core.csv_table import Table
    from loopcal.mechanism import Mechanism

KEY, SIGMA = "reading_noise", "sigma."
SAY = (
    "and nothing else says how far this reading is believed; write its standard deviation, 0 for "
    "exact, or inf, or state"
    " 'reading_noise' for all empty cells"
)


def says_noise(table: Table, robot: Mechanism) -> bool:
    """Tell whether a file says how far its readings are believed."""
    return KEY in table.settings.content or any(
        SIGMA + actuator.name in table.units for actuator in robot.actuators
    )


def read_reading_sigma(table: Table, robot: Mechanism, readings: np.ndarray) -> np.ndarray | None:
    """Return the standard deviations (rows, a) [SI] of readings (rows, a), NaN where nothing is
    said of one.

    Returns
    -------
    ndarray or None
        None where the file says nothing of any.

    Raises
    ------
    FileError
        An unknown actuator, no unit or a wrong one, a number below zero, an empty cell for which
        nothing else is said.
    """
    import numpy as np

    if not says_noise(table, robot):
        return None
    stated = _stated(table, robot)
    sigma = np.tile(
        [stated.get(actuator.name, np.nan) for actuator in robot.actuators], (len(readings), 1)
    )
    for i, actuator in enumerate(robot.actuators):
        name = SIGMA + actuator.name
        if name in table.units:
            cells = np.array(table.text(name))
            believed = np.where(cells == "inf", "", cells)
            own = table.scaled(name, actuator.dimension, tuple(believed.tolist()))
            for row in np.flatnonzero(own < 0.0):
                raise table.row_error(
                    int(row),
                    f"column {name!r} is below zero; write a standard deviation, or 0 for exact",
                )
            sigma[:, i] = np.where(
                cells == "inf", np.inf, np.where(np.isnan(own), sigma[:, i], own)
            )
            if actuator.sigma is None:
                for row in np.flatnonzero(np.isnan(sigma[:, i]) & ~np.isnan(readings[:, i])):
                    raise table.row_error(int(row), f"column {name!r} is empty, {SAY}")
    return np.where(np.isnan(readings), np.inf, sigma)


def _stated(table: Table, robot: Mechanism) -> dict[str, float]:
    """Return actuator -> standard deviation [SI] of the settings."""
    file, node = table.settings, table.settings.content.get(KEY, {})
    dimensions = {actuator.name: actuator.dimension for actuator in robot.actuators}
    if not isinstance(node, dict):
        node = dict.fromkeys(dimensions, node)
        return {name: _number(table, text, dimensions[name], (KEY,)) for name, text in node.items()}
    refuse_unknown_keys(file, list(node), list(dimensions), (KEY,))
    return {
        name: _number(table, text, dimensions[name], (KEY, name)) for name, text in node.items()
    }


def _number(table: Table, text: object, dimension: Dimension, place: Location) -> float:
    """Return a standard deviation [SI]."""
    try:
        value = parse_quantity(str(text), dimension)
    except UnitError as error:
        raise table.settings.error(f"{'.'.join(map(str, place))!r}: {error}", place) from None
    if not 0.0 <= value < math.inf:
        raise table.settings.error(
            f"the noise of readings is {text}; give a number above zero, or zero for exact", place
        )
    return value
