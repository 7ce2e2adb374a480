# SPDX-License-Identifier: Apache-2.0
"""Measured values for measurements whose poses are stated: what a true machine would show there."""

from dataclasses import replace

import numpy as np

from loopcal.errors import DataError
from loopcal.measure.instrument import Instrument
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import simulate
from loopcal.mechanism import Mechanism, forward


def replace_measured_values(
    robot: Mechanism, data: Measurements, instrument: Instrument, seed: int
) -> Measurements:
    """Return measurements with simulated values in place of theirs, at their readings.

    Parameters
    ----------
    robot : Mechanism
        The true machine, at its present values.
    data : Measurements
        Poses and rows; what they measured does not matter.
    instrument : Instrument
        A sensor with its noise for each of `data.observations`, in their order.
    seed : int
        Of the noise.

    Raises
    ------
    DataError
        The robot, nominal or true, does not reach a pose.
    """
    nominal = forward(robot.nominal, data.readings)
    lost = np.flatnonzero(~nominal.converged)
    if len(lost):
        raise DataError(
            f"{robot.name} does not reach pose {data.labels[int(lost[0])]!r} with the readings "
            "given there "
            f"({nominal.explain(int(lost[0]))}); correct the readings"
        )
    pairs = zip(instrument.sensors, data.observations, strict=True)
    looking = tuple(
        replace(sensor, rows=seen.rows, session=seen.session, group=seen.group)
        for sensor, seen in pairs
    )
    found = simulate(robot, nominal.T, Instrument(looking), seed, controller=robot.nominal)
    return replace(data, observations=found.observations)
