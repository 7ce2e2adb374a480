# SPDX-License-Identifier: Apache-2.0
"""Complete error models of the tripods: ranks at nominal and perturbed geometry, with unknown
frames and perfect joints.
"""

from dataclasses import replace

import numpy as np
import pytest

from loopcal.mechanism.families.prs import RuPusPrs, ThreePrs
from tests.mechanism.families.ranks import (
    perturb,
    rank,
    ranks_by_measurement,
    ranks_with_unknown_frames,
    scaled_sensitivity,
    select_measured_rows,
    solve_random_poses,
)
from tests.mechanism.families.test_tripods import (
    MEASUREMENTS,
    RU_PUS_PRS,
    THREE_PRS,
    build_cached_robot,
)


@pytest.mark.parametrize(
    ("record", "size", "expected"),
    [
        (replace(THREE_PRS, error_model="complete"), 0.0, [33, 32, 30]),
        (replace(THREE_PRS, error_model="complete"), 2e-3, [33, 32, 30]),
        (replace(THREE_PRS, error_model="complete", spherical="axes"), 0.0, [42, 41, 39]),
        (replace(THREE_PRS, error_model="complete", spherical="axes"), 2e-3, [60, 59, 57]),
        (replace(RU_PUS_PRS, error_model="complete", spherical="axes"), 6e-3, [58, 57, 55]),
    ],
    ids=["perfect balls", "perfect balls, moved", "nominal", "moved", "tracker"],
)
def test_ranks_of_the_complete_tripods_by_measurement(
    record: ThreePrs | RuPusPrs, size: float, expected: list[int]
) -> None:
    # moved by 2 mm and 10 mrad (tracker: 6 mm, 30 mrad): at smaller errors the last directions sink
    # into rounding
    assert (
        ranks_by_measurement(
            perturb(build_cached_robot(record), size, seed=7), MEASUREMENTS[:3], n=120
        )
        == expected
    )


COMPLETE_3_PRS = replace(THREE_PRS, error_model="complete", spherical="axes")
COMPLETE_RU_PUS_PRS = replace(RU_PUS_PRS, error_model="complete", spherical="axes")


@pytest.mark.parametrize(
    ("record", "size", "expected"),
    # a complete model has all moves and turns of both frames: each unknown frame costs six
    [
        (COMPLETE_3_PRS, 2e-3, [54, 54, 48]),
        (replace(COMPLETE_3_PRS, spherical="point"), 2e-3, [27, 27, 21]),
        (COMPLETE_RU_PUS_PRS, 6e-3, [52, 52, 46]),
    ],
    ids=["3-PRS", "3-PRS, perfect balls", "tracker"],
)
def test_each_unknown_frame_lowers_the_rank_of_the_complete_tripods_by_six(
    record: ThreePrs | RuPusPrs, size: float, expected: list[int]
) -> None:
    machine = perturb(build_cached_robot(record), size, seed=7)
    assert ranks_with_unknown_frames(machine, "full", n=120) == expected
    # without torsion one less with the tool known; with it unknown, its turn about the normal was
    # lost already
    assert ranks_with_unknown_frames(machine, "5-dof", n=120) == [expected[0] - 1, *expected[1:]]


@pytest.mark.parametrize(
    ("record", "size", "expected"),
    # orientation alone loses the moves of base and tool, three each: 60 - 6, 42 - 6, 33 - 6, 58 - 6
    [
        (COMPLETE_3_PRS, 2e-3, 54),
        (COMPLETE_3_PRS, 0.0, 36),
        (replace(COMPLETE_3_PRS, spherical="point"), 2e-3, 27),
        (COMPLETE_RU_PUS_PRS, 6e-3, 52),
    ],
    ids=["3-PRS", "3-PRS, nominal", "3-PRS, perfect balls", "tracker"],
)
def test_orientation_alone_lowers_the_rank_of_the_complete_tripods_by_six(
    record: ThreePrs | RuPusPrs, size: float, expected: int
) -> None:
    assert ranks_by_measurement(
        perturb(build_cached_robot(record), size, seed=7), ["orientation"], n=120
    ) == [expected]


def test_complete_ru_pus_prs_with_perfect_joints_has_rank_35_or_33() -> None:
    """PUS 9, PRS 11 and the post's three revolute joints 3 * 3 + 6 = 15: 35 (C = 3R + 6 for a chain
    of passive R).

    The published 33 takes the universal joint as ideal too: its axes meet and are square, two less.
    """
    machine = perturb(
        build_cached_robot(replace(COMPLETE_RU_PUS_PRS, spherical="point")), 2e-3, seed=7
    )
    assert ranks_by_measurement(machine, MEASUREMENTS, n=120) == [35, 34, 32, 29]
    assert ranks_with_unknown_frames(machine, "full", n=120) == [29, 29, 23]
    # in the second axis' own frame: x from the first axis to the second, rx their angle
    ideal = np.isin(machine.parameters.names, ("chain3.universal2.x", "chain3.universal2.rx"))
    assert ideal.sum() == 2
    crossed = machine.with_values(np.where(ideal, 0.0, machine.values))
    solution = solve_random_poses(crossed, 120)
    D = scaled_sensitivity(crossed, solution)[..., ~ideal]
    assert [rank(select_measured_rows(D, solution.T, kind)) for kind in MEASUREMENTS[:3]] == [
        33,
        32,
        30,
    ]
