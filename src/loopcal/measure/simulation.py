# SPDX-License-Identifier: Apache-2.0
"""Simulated measurements of one machine, for studies and for trials before a measurement."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError
from loopcal.measure.array_checks import check_type
from loopcal.measure.instrument import Instrument
from loopcal.measure.measurements import Measurements
from loopcal.measure.trials import simulate_trials
from loopcal.mechanism import Mechanism, forward


def simulate(
    robot: Mechanism,
    poses: ArrayLike,
    instrument: Instrument,
    seed: int,
    controller: Mechanism | None = None,
    nuisance_values: Mapping[str, float] | None = None,
    reading_sigma: ArrayLike | None = None,
) -> Measurements:
    """Measure commanded poses on one machine.

    Parameters
    ----------
    robot : Mechanism
        The true machine, at its true values.
    poses : (n, 4, 4) T_base_platform, or (n, c) controlled coordinates [SI]
        As commanded.
    instrument : Instrument
    seed : int
        The result is that of trial 0 of `simulate_trials`.
    controller : Mechanism, optional
        The geometry that turns poses into readings; default: the robot at its nominal values.
    nuisance_values : name -> value [SI], optional
        True values of setup parameters, such as `tracker.x`; default: nominal.
    reading_sigma : optional
        As for `simulate_trials`.

    Returns
    -------
    measurements : Measurements

    Raises
    ------
    DataError
        If the controller cannot reach a pose, or the true machine cannot reach it with the readings
        of the controller.
    """
    check_type(robot, Mechanism, "robot", "from loopcal.load_robot")
    trials = simulate_trials(
        robot,
        robot.values[None],
        poses,
        instrument,
        seed,
        controller,
        nuisance_values,
        reading_sigma,
    )
    failed = np.flatnonzero(~trials.reached[0])
    if len(failed):
        raise DataError(
            f"the true machine does not reach pose {int(failed[0]) + 1} with the readings of the "
            f"controller ({len(failed)} of {len(trials.readings)} poses fail); choose poses "
            "further inside the workspace, or smaller errors"
        )
    return trials.trial(0)


def replace_measured_values(
    robot: Mechanism, data: Measurements, instrument: Instrument, seed: int
) -> Measurements:
    """Return measurements with simulated values in place of theirs, at their readings.

    Parameters
    ----------
    robot : Mechanism
        The true machine, at its values.
    data : Measurements
        Poses and rows; their measured values are ignored.
    instrument : Instrument
        A sensor with its noise for each of `data.observations`, in their order.
    seed : int
        Of the noise.

    Raises
    ------
    DataError
        If the nominal or the true robot does not reach a pose.
    """
    nominal = forward(robot.nominal, data.readings)
    failed = np.flatnonzero(~nominal.converged)
    if len(failed):
        first = int(failed[0])
        raise DataError(
            f"{robot.name} does not reach pose {data.labels[first]!r} with its readings "
            f"({nominal.explain(first)}); correct the readings"
        )
    pairs = zip(instrument.sensors, data.observations, strict=True)
    sensors = tuple(
        replace(sensor, rows=rows.rows, session=rows.session, group=rows.group)
        for sensor, rows in pairs
    )
    measured = simulate(robot, nominal.T, Instrument(sensors), seed, controller=robot.nominal)
    return replace(data, observations=measured.observations)
