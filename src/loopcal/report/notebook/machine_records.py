# SPDX-License-Identifier: Apache-2.0
"""The numbers of robots and of measurements."""

from __future__ import annotations

import numpy as np

from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism
from loopcal.report.notebook.records import Records, Variable, collect_records, number_from_one
from loopcal.units import SI_SYMBOLS

PARAMETER = "parameter"


@collect_records.register
def collect_robot(result: Mechanism) -> Records:
    """Return the parameters in the units of the robot's file."""
    table = result.parameters
    units = [result.get_unit(parameter.dimension) for parameter in table.entries]
    factor = np.array([unit.factor_to_si for unit in units])
    of_parameter = (PARAMETER,)
    return Records(
        PARAMETER,
        (
            Variable("value", of_parameter, result.values / factor),
            Variable("nominal", of_parameter, table.nominal / factor),
            Variable("tolerance", of_parameter, table.tolerance / factor),
            Variable("unit", of_parameter, np.array([unit.symbol for unit in units], str)),
            Variable("free", of_parameter, np.asarray(table.free, bool)),
        ),
        {PARAMETER: table.names},
    )


@collect_records.register
def collect_measurements(result: Measurements) -> Records:
    """Return one row for each measured number [SI], and the readings of the poses.

    The noise is the standard deviation of the residual of this number, where each column has one.
    """
    words: dict[str, list[str]] = {"kind": [], "pose": [], "component": [], "unit": []}
    values: list[float] = []
    for rows in result.observations:
        members = rows.rows.reshape(len(rows), -1)
        labels = ["/".join(result.labels[i] for i in row) for row in members]
        columns = rows.kind.columns
        words["kind"] += [rows.kind.name] * (len(rows) * len(columns))
        words["pose"] += [label for label in labels for _ in columns]
        words["component"] += [column.name for column in columns] * len(rows)
        words["unit"] += [SI_SYMBOLS[column.dimension] for column in columns] * len(rows)
        values += rows.measured.ravel().tolist()
    row = ("number",)
    readings = result.readings
    return Records(
        "number",
        (
            *(Variable(name, row, np.array(cells, str)) for name, cells in words.items()),
            Variable("value", row, np.array(values, float)),
            Variable("reading", ("measured_pose", "actuator"), readings, "m or rad"),
            Variable("held_out", ("measured_pose",), result.is_held_out),
        ),
        {
            "number": number_from_one(len(values)),
            "measured_pose": result.labels,
            "actuator": number_from_one(readings.shape[1]),
        },
    )
