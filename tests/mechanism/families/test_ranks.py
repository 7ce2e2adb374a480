# SPDX-License-Identifier: Apache-2.0
"""Ranks of the error models of hexapods and tripods, by what is measured and with unknown frames.

Nominal, or with errors of all parameters: at smaller errors the last directions sink into rounding.
Without torsion (5-dof) one direction less is determined, by positions three, by orientations six.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.gough import Gough
from loopcal.mechanism.families.prs import RuPusPrs, ThreePrs
from tests.mechanism.families.ranks import (
    frame_columns,
    perturb,
    rank,
    scaled_sensitivity,
    select_measured_rows,
    solve_random_poses,
)
from tests.mechanism.families.test_gough import CHAIN, COMPLETE_AXES, ROD
from tests.mechanism.families.test_tripods import RU_PUS_PRS, THREE_PRS

KINDS = ("full", "5-dof", "positions", "orientation")


class Ranks(NamedTuple):
    """Ranks of a robot with errors of this size [m], angles by 200 mm per radian."""

    record: Gough | ThreePrs | RuPusPrs
    size: float
    measured: tuple[int, ...]  # by KINDS, with known frames
    # by kind, with an unknown frame of the instrument, of the target, and of both; None: not stated
    unknown: Mapping[str, tuple[int | None, int | None, int | None]] = {}


COMPLETE = {"error_model": "complete", "spherical": "axes"}
PERFECT = {"error_model": "complete", "spherical": "point"}
# a complete model has all moves and turns of both frames: each unknown frame costs six
CASES = {
    "hexapod, rods": Ranks(
        ROD,
        0.0,
        (42, 41, 39, 36),
        {"full": (36, 36, 30), "5-dof": (35, None, None), "positions": (33, None, None)},
    ),
    "hexapod, chains": Ranks(
        CHAIN,
        0.0,
        (42, 41, 39, 36),
        {"full": (36, 36, 30), "5-dof": (35, None, None), "positions": (33, None, None)},
    ),
    "hexapod, perfect balls": Ranks(replace(CHAIN, error_model="complete"), 0.0, (48, 47, 45)),
    "hexapod, perfect balls, moved": Ranks(
        replace(CHAIN, error_model="complete"), 2e-3, (84, 83, 81)
    ),
    "hexapod, complete": Ranks(COMPLETE_AXES, 0.0, (66, 65, 63, 60)),
    "hexapod, complete, moved": Ranks(
        COMPLETE_AXES, 4e-3, (138, 137, 135, 132), {"full": (132, 132, 126)}
    ),
    # the frame's own turn about the normal hides nothing new: 32 - 6
    "3-PRS": Ranks(
        THREE_PRS, 0.0, (33, 32, 30, 27), {"full": (27, 27, 21), "5-dof": (26, None, None)}
    ),
    "3-PRS, perfect balls": Ranks(replace(THREE_PRS, error_model="complete"), 0.0, (33, 32, 30)),
    "3-PRS, perfect balls, moved": Ranks(
        replace(THREE_PRS, **PERFECT),
        2e-3,
        (33, 32, 30, 27),
        {"full": (27, 27, 21), "5-dof": (26, 27, 21)},
    ),
    "3-PRS, complete": Ranks(replace(THREE_PRS, **COMPLETE), 0.0, (42, 41, 39, 36)),
    "3-PRS, complete, moved": Ranks(
        replace(THREE_PRS, **COMPLETE),
        2e-3,
        (60, 59, 57, 54),
        {"full": (54, 54, 48), "5-dof": (53, 54, 48)},
    ),
    # An unknown frame costs its motions that parameters can reproduce. Base, 5: all but the turn
    # about z, for the 25 leave out the post's thOz and thU1z; the 27 lose all 6. Tool, 3: the
    # turns; a move would shift the universal joint on the platform, which has no parameter.
    "tracker, 25": Ranks(RU_PUS_PRS, 0.0, (25, 24), {"full": (20, 22, 17), "5-dof": (19, 22, 17)}),
    "tracker, 27": Ranks(
        replace(RU_PUS_PRS, parameter_set="twenty-seven"), 0.0, (26,), {"full": (20, 23, 17)}
    ),
    # PUS 9, PRS 11, and the post's three revolute joints 3 * 3 + 6 = 15
    "tracker, perfect balls, moved": Ranks(
        replace(RU_PUS_PRS, **PERFECT), 2e-3, (35, 34, 32, 29), {"full": (29, 29, 23)}
    ),
    "tracker, complete, moved": Ranks(
        replace(RU_PUS_PRS, **COMPLETE),
        6e-3,
        (58, 57, 55, 52),
        {"full": (52, 52, 46), "5-dof": (51, 52, 46)},
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_ranks_are_those_of_the_error_model(case: str) -> None:
    record, size, measured, unknown = CASES[case]
    seed = 5 if isinstance(record, Gough) else 7
    machine = perturb(build(record.expand()), size, seed) if size else build(record.expand())
    n = 80
    if record.error_model == "complete":
        n = 150 if isinstance(record, Gough) else 120
    solution = solve_random_poses(machine, n)
    D, T = scaled_sensitivity(machine, solution), solution.T
    kinds = KINDS[: len(measured)]
    assert tuple(rank(select_measured_rows(D, T, kind)) for kind in kinds) == measured
    for kind, expected in unknown.items():
        rows = select_measured_rows(D, T, kind)
        for (base, tool), count in zip(
            ((True, False), (False, True), (True, True)), expected, strict=True
        ):
            F = select_measured_rows(frame_columns(T, base, tool), T, kind)
            found = rank(np.concatenate([rows, F], axis=2)) - rank(F)
            assert count is None or found == count, (kind, base, tool)


def test_ideal_universal_joint_of_the_tracker_costs_two_directions() -> None:
    """The published 33 takes the universal joint as ideal: its axes meet and are square."""
    machine = perturb(build(replace(RU_PUS_PRS, **PERFECT).expand()), 2e-3, seed=7)
    # in the second axis' own frame: x from the first axis to the second, rx their angle
    ideal = np.isin(machine.parameters.names, ("chain3.universal2.x", "chain3.universal2.rx"))
    assert ideal.sum() == 2
    crossed = machine.with_values(np.where(ideal, 0.0, machine.values))
    solution = solve_random_poses(crossed, 120)
    D = scaled_sensitivity(crossed, solution)[..., ~ideal]
    ranks = [rank(select_measured_rows(D, solution.T, kind)) for kind in KINDS[:3]]
    assert ranks == [33, 32, 30]
