# SPDX-License-Identifier: Apache-2.0
"""Checks of readings alone, the kind `closure`: they need redundant actuators of stated noise."""

from collections.abc import Iterable, Sequence

from loopcal.errors import DataError
from loopcal.findings import report_finding
from loopcal.measure.kinds import CLOSURE, Kind
from loopcal.measure.reading_sigma import resolve_reading_sigma
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray


def check_closure(
    robot: Mechanism, kinds: Sequence[Kind], reading_sigma: FloatArray | None, n_poses: int
) -> None:
    """Refuse the kind `closure` for a robot without redundant actuators, or for exact readings.

    Parameters
    ----------
    reading_sigma : (n, a) [SI] of the readings; None as the robot states.

    Raises
    ------
    DataError
        `data.closure-without-redundancy`, `data.closure-without-sigma`, or that of
        `resolve_reading_sigma`.
    """
    check_redundancy(robot, kinds)
    is_closure = any(kind.name == CLOSURE for kind in kinds)
    if is_closure and resolve_reading_sigma(robot, reading_sigma, n_poses) is None:
        raise DataError(report_finding("data.closure-without-sigma", robot=robot.name))


def check_redundancy(robot: Mechanism, kinds: Iterable[Kind]) -> None:
    """Refuse the kind `closure` for a robot that does not have more actuators than freedoms.

    Raises
    ------
    DataError
        `data.closure-without-redundancy`.
    """
    if robot.program.sigma is None and any(kind.name == CLOSURE for kind in kinds):
        raise DataError(
            report_finding(
                "data.closure-without-redundancy",
                robot=robot.name,
                actuators=len(robot.actuators),
                freedoms=len(robot.freedoms),
            )
        )
