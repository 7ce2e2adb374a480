# SPDX-License-Identifier: Apache-2.0
"""Values of parameters that a machine can have: one rule for every family.

Nominal values and identified values obey the same rule. A value that must be positive, such as the
length of a rod, is above zero; no value is beyond `LARGEST`; and with all of them together the
loops can be closed at the readings of the nominal home pose.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from loopcal.engine import State
from loopcal.errors import MechanismError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.mechanism.kinematics.batch_kinematics import forward_trials, inverse_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.states import driven_values, is_closed
from loopcal.mechanism.transmission.terms import readings_from_joints
from loopcal.parameters import ParameterTable
from loopcal.typing import FloatArray
from loopcal.units import LARGEST, SI_SYMBOLS


def find_impossible_values(
    robot: Mechanism, values: FloatArray
) -> tuple[tuple[str | None, Finding], ...]:
    """Return (parameter, finding) for values (p,) [SI] that no machine of this structure has.

    The parameter is None where single values are possible, but the loops cannot be closed.
    """
    findings = tuple(_find_single_values(robot, values))
    if findings:
        return findings
    state = _close_at_home(robot, values[None])
    if is_closed(state.status).all():
        return ()
    deviation = np.abs(values - robot.parameters.nominal)
    largest = int(np.argmax(deviation))
    unit = robot.get_unit(robot.parameters.dimensions[largest])
    gap = float(state.residual[0, 0])
    finding = report_finding(
        "mechanism.values-open-loops",
        gap=Quantity(gap * 1e3, "mm") if np.isfinite(gap) else None,
        name=robot.parameters.names[largest],
        value=Quantity(float(values[largest]) / unit.factor_to_si, unit.symbol),
        nominal=robot.to_quantity(
            float(robot.parameters.nominal[largest]), robot.parameters.dimensions[largest]
        ),
    )
    return ((None, finding),)


def _close_at_home(robot: Mechanism, values: FloatArray) -> State:
    """Return the state at the readings of the nominal home; of redundant actuators, at its pose.

    Errors of the geometry make redundant readings contradict each other.
    """
    if robot.program.sigma is not None:
        target = read_coordinates(robot.home_state.T, robot.controlled)
        return inverse_trials(robot, values, target)
    # nominal values displace nothing
    joints, slots = driven_values(robot.program, robot.home_state), robot.slots
    q = readings_from_joints(joints, slots.terms[None], slots.frequency)
    return forward_trials(robot, values, q)


def check_nominal_values(table: ParameterTable) -> None:
    """Refuse nominal values that no machine has; raises MechanismError."""
    for p in table.entries:
        if not abs(p.nominal) <= LARGEST:
            symbol = SI_SYMBOLS[p.dimension]
            raise MechanismError(
                f"the nominal value of {p.name} is {p.nominal:g} {symbol}; it must not be beyond "
                f"{LARGEST:g} {symbol}"
            )


def _find_single_values(robot: Mechanism, values: FloatArray) -> Iterator[tuple[str, Finding]]:
    """Yield parameters whose own value is impossible."""
    table = robot.parameters
    is_large = ~(np.abs(values) <= LARGEST)
    for i in np.flatnonzero(is_large | (table.positive & ~(values > 0.0))):
        p, value = table.entries[i], float(values[i])
        number = robot.to_quantity(value, p.dimension)
        if is_large[i]:
            limit = robot.to_quantity(LARGEST, p.dimension)
            yield (
                p.name,
                report_finding("mechanism.value-too-large", name=p.name, value=number, limit=limit),
            )
        else:
            nominal = robot.to_quantity(p.nominal, p.dimension)
            yield (
                p.name,
                report_finding(
                    "mechanism.value-not-positive", name=p.name, value=number, nominal=nominal
                ),
            )
