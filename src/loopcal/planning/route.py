# SPDX-License-Identifier: Apache-2.0
"""Check a given order of stops: from home through all of them and back, straight in between."""

from __future__ import annotations

import numpy as np

from loopcal.errors import MechanismError
from loopcal.findings import report_finding
from loopcal.mechanism import Mechanism
from loopcal.planning.constraints import Constraints, build_checker
from loopcal.planning.path import check_paths, locate_home
from loopcal.typing import FloatArray


def check_route(robot: Mechanism, labels: tuple[str, ...], coordinates: FloatArray) -> FloatArray:
    """Return home (c,) [m, rad], after a check of the route from there through all stops and back.

    Strokes, joint limits, cones and singularities count; other constraints are those of a plan.

    Parameters
    ----------
    labels : names of the stops. coordinates : (n, c) controlled coordinates [m, rad].

    Raises
    ------
    MechanismError : a straight path is not allowed.
    """
    home = locate_home(robot)
    stops = np.vstack([home, coordinates, home])
    checker = build_checker(robot, Constraints(min_margin=0.0))
    check = check_paths(checker, stops[:-1], stops[1:])
    if not check.allowed.all():
        i = int(np.flatnonzero(~check.allowed)[0])
        names = ("home", *labels, "home")
        reasons = ({**check.violations[i].to_dict(), "count": 1},)
        raise MechanismError(
            report_finding("plan.route-blocked", first=names[i], last=names[i + 1], reasons=reasons)
        )
    return home
