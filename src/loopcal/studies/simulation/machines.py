# SPDX-License-Identifier: Apache-2.0
"""The machines of a block: the robot of a file text, its tolerances, and the true values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path

import numpy as np

from loopcal.errors import DataError, UnitError, suggest_names
from loopcal.io.core.yaml_file import parse_yaml
from loopcal.io.robot.robot_file import build_robot
from loopcal.measure import Seed, sample_truth
from loopcal.mechanism import Mechanism
from loopcal.parameters import ParameterTable
from loopcal.studies.specification.levels import ErrorsLevel
from loopcal.typing import FloatArray
from loopcal.units import parse_quantity

KEPT_ROBOTS = 8
"""Robots that a process keeps; building one takes as long as fitting a few of its machines."""


@lru_cache(maxsize=KEPT_ROBOTS)
def build_robot_of(text: str) -> Mechanism:
    """Return the robot of the text of a robot file."""
    return build_robot(parse_yaml(text, Path("robot of the study"), "robot file"))


def change_tolerances(robot: Mechanism, errors: ErrorsLevel) -> Mechanism:
    """Return a robot with the tolerances of a level, which the fit knows.

    Raises
    ------
    DataError : a pattern that no parameter has, or a quantity of another dimension.
    """
    table, factor = robot.parameters, errors.tolerance_factor
    stated = resolve_patterns(table, errors.tolerances)
    entries = tuple(
        replace(entry, tolerance=stated[entry.name])
        if entry.name in stated
        else replace(entry, tolerance=None if entry.tolerance is None else factor * entry.tolerance)
        for entry in table.entries
    )
    common = tuple(replace(error, tolerance=factor * error.tolerance) for error in table.common)
    return replace(robot, parameters=ParameterTable(entries, common))


def draw_machines(robot: Mechanism, errors: ErrorsLevel, n_trials: int, seed: Seed) -> FloatArray:
    """Return true parameter values (t, p) [SI]; `robot` has the tolerances of the level."""
    table = robot.parameters
    if errors.deviations:
        values = np.array(table.nominal)
        for name, deviation in resolve_patterns(table, errors.deviations).items():
            values[table.index(name)] += deviation
        return np.tile(values, (n_trials, 1))
    truth = sample_truth(robot, n_trials, seed, errors.distribution)
    drawn = truth - table.nominal
    if errors.smallest:
        drawn = raise_sizes(drawn, robot, errors.smallest)
    return table.nominal + errors.error_factor * drawn


def raise_sizes(drawn: FloatArray, robot: Mechanism, smallest: float) -> FloatArray:
    """Return uniform errors (t, p) whose sizes lie between `smallest` times the largest one and the
    largest one, with the same signs and standard deviations.
    """
    tolerance = np.nan_to_num(robot.parameters.tolerance)
    largest = np.sqrt(3.0 / (1.0 + smallest + smallest**2)) * tolerance
    share = np.abs(drawn) / np.where(tolerance > 0.0, np.sqrt(3.0) * tolerance, 1.0)
    return np.sign(drawn) * np.where(
        drawn == 0.0, 0.0, largest * (smallest + (1 - smallest) * share)
    )


def resolve_patterns(table: ParameterTable, values: Mapping[str, str]) -> dict[str, float]:
    """Return name -> value [SI] of quantities by name or pattern; the last that fits counts.

    Raises
    ------
    DataError : as for `change_tolerances`.
    """
    resolved: dict[str, float] = {}
    for pattern, text in values.items():
        fitting = [entry for entry in table.entries if fnmatchcase(entry.name, pattern)]
        if not fitting:
            raise DataError(
                f"no parameter is named {pattern!r}{suggest_names(pattern, table.names)}; correct "
                "the name; a pattern such as 'leg*.length' names several"
            )
        for entry in fitting:
            try:
                resolved[entry.name] = parse_quantity(text, entry.dimension)
            except UnitError as error:
                raise DataError(f"{pattern!r} of {entry.name}: {error}") from None
    return resolved
