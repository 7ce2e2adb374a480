# SPDX-License-Identifier: Apache-2.0
"""Golden results: loopcal still computes the numbers of before its redesign, to the tolerances of
`compare`.

If a case fails after a change of the adapter `api` for a new name, the change altered a result.
`python -m tests.golden.collect` writes the fixture. Never regenerate it to accept an unexplained
change.
"""

import fnmatch

import numpy as np
import pytest

from tests.golden import compare
from tests.golden.cases import CASES

PER_LEG = (
    "leg by leg now solves with the pose's sensitivities instead of the engine's closure rows: the "
    "same numbers, rounded elsewhere, and magnified by condition numbers of 5000 per leg"
)
ROBUST_REFERENCE = (
    "a fit that contradicts its noise is no longer the point at which outliers are judged: it is "
    "a robust fit of the same data; the outliers are the same"
)
CONDITION = (
    "all 25 combinations are solved with a condition number of 5.6e8: rounding of 2.2e-16 may "
    "change the first step by 1.2e-7, and the two engines do change it by 1e-9"
)
END_OF_DESCENT = (
    "a descent ends where a step changes the residuals by less than 1e-6 of their norm; poses that "
    "begin elsewhere, or differ by rounding, let it end at points within 1e-4 standard deviations"
)
EXCEPTIONS: dict[str, tuple[float, str, str]] = {
    "accuracy/hexapod-42/monte-carlo": (1e3, "observed", END_OF_DESCENT),
    "losses/tukey/ls": (1e2, "*", END_OF_DESCENT),
    "papers/hexapod-42/methods": (1e1, "errors", END_OF_DESCENT),
    "recalibration/freed-limb": (1e4, "again/fit/*", END_OF_DESCENT),
    # of two engines; chains have tolerances of several kinds, whose factors are estimated
    "robots/excavator/map": (1e5, "*", END_OF_DESCENT),
    "robots/palletizer/map": (1e5, "*", END_OF_DESCENT),
    "robots/tricept/map": (1e5, "*", END_OF_DESCENT),
    "validation/hexapod-42/targets": (1e1, "errors/*", END_OF_DESCENT),
    # shares of 5e-4 of the distances
    "outliers/least-squares": (1e6, "blunders/*", ROBUST_REFERENCE),
    "outliers/map": (1e6, "blunders/*", ROBUST_REFERENCE),
    "papers/hexapod-42/exact": (1e3, "*", PER_LEG),  # shares of 5e-10 of errors of 0.05 mm
    "papers/hexapod-42/presumed-noise": (1e3, "*", PER_LEG),
    "papers/hexapod-42/stated-noise": (1e3, "*", PER_LEG),
    "papers/tsvd-2016/RU-PUS-PRS/6-dof": (120.0, "errors", CONDITION),
}
"""Case: (factor on tolerances, pattern of the paths that have them, reason)."""

BY_TARGET = (
    "errors are those of each target and quantity: three targets have three position errors, and "
    "wires have length errors; rows that measure no such quantity have no entry in place of NaN"
)
BEST_FIT = (
    "errors are those after the best rigid fit of frames that the instrument does not determine; "
    "a plan for such an instrument makes these small, and chooses other poses"
)
CONTROLLER_SET = (
    "the set that the firmware of a delta stores is compared, too; the other scores are the same"
)
REDEFINED: dict[str, str] = {
    "accuracy/hexapod-42/open-frame": BEST_FIT,
    "cross-validation/choose-model": CONTROLLER_SET,
    "plans/linear-delta/position/I": BEST_FIT,
    "validation/hexapod-42/targets": BY_TARGET,
    "validation/hexapod-42/three-kinds": BY_TARGET,
}
"""Case with another meaning than in the first version: reason. Only its errors of poses were
collected again, what a plan chooses by them, and the added set of parameters.
"""

INFLATED = (
    "stated tolerances are inflated by the most probable factor wherever it is above 1, no longer "
    "only beyond doubt, and the intervals contain the uncertainty of the factor, also by the "
    "degrees of freedom of the variances that it determines"
)
FOUND_NOISE = (
    "distances of outliers are in units of the noise that the other poses show, no longer of the "
    "stated one; the outliers are the same"
)
FOUND_NOISE_OF_CHANGE = (
    "a change of the machine is tested by the noise that the residuals of both calibrations show"
)
LOSS_CONTRADICTED = (
    "residuals that exceed the stated noise in spite of the loss make the intervals wider"
)
FIRST_OF_EQUALS = (
    "the leading parameter of an unidentifiable combination is the first of those that are equally "
    "large, no longer the one that rounding makes largest"
)
CORRECTED: dict[str, str] = {
    "identifiability/3-prs/tilt": FIRST_OF_EQUALS,
    "identifiability/hexapod-42/tilt": FIRST_OF_EQUALS,
    "kinds/component": INFLATED,
    "losses/huber/constant": f"{FOUND_NOISE}; {LOSS_CONTRADICTED}",
    "losses/huber/ls": FOUND_NOISE,
    "losses/huber/map": FOUND_NOISE,
    "losses/huber/map-widened": f"{INFLATED}; {FOUND_NOISE}",
    "losses/tukey/ls": FOUND_NOISE,
    "losses/tukey/map": FOUND_NOISE,
    "losses/tukey/map-widened": f"{INFLATED}; {FOUND_NOISE}",
    "losses/tukey/noise-estimated": FOUND_NOISE,
    "methods/map-widened/heights-and-tilts": INFLATED,
    "methods/map-widened/poses": INFLATED,
    "methods/noise-estimated/map-widened": INFLATED,
    "methods/some-parameters-free": INFLATED,
    "outliers/least-squares": FOUND_NOISE,
    "outliers/map": FOUND_NOISE,
    "recalibration/freed-limb": FOUND_NOISE_OF_CHANGE,
    "recalibration/longer-leg": FOUND_NOISE_OF_CHANGE,
    "recalibration/unchanged": FOUND_NOISE_OF_CHANGE,
    "papers/cmm-constraint-2011/surfaces": (
        "rank 33, no longer 34: residuals of lines are no information on rotations of the base"
    ),
}
"""Cases whose fixture was written anew because a result was wrong or its definition changed, with
the reason.
"""

NOISE_TESTED: dict[tuple[str, ...], str] = {
    (
        "robots/*/map",
        "kinds/*",
        "combined/*",
        "methods/*",
        "losses/*/map*",
        "trials/*",
        "latent/*",
        "unknowns/*",
        "papers/cmm-constraint-2011/surfaces",
    ): (
        "chi-square, its degrees and its probability are those of the rows that no parameter "
        "explains: no prior, ridge or truncation enters the test of the noise"
    ),
    ("methods/noise-estimated/map*",): (
        "an estimated noise is that of the rows that no parameter explains, and so are sd and "
        "half-widths"
    ),
    ("methods/ridge-*", "trials/hexapod-42/ridge-gcv"): (
        "the bias of a ridge is expected from the stated tolerances, whatever its weight is; with "
        "a weight of its own for each parameter there are no intervals"
    ),
    ("methods/tsvd-20/poses",): "what a truncation leaves out is no noise, and widens no interval",
}
"""Patterns of cases with MAP, ridge or truncation whose chi-square, degrees, p_value (and where
said sd, half-widths and factor on sigma) were collected again, with the reason.
"""

GOLDEN = compare.read()


def test_fixture_has_exactly_the_registered_cases():
    assert list(GOLDEN) == list(CASES)
    assert set(CASES) >= set(EXCEPTIONS) | set(REDEFINED) | set(CORRECTED)
    assert all(fnmatch.filter(CASES, one) for patterns in NOISE_TESTED for one in patterns)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if case.slow else [])
        for name, case in CASES.items()
    ],
)
def test_results_equal_the_golden_results(name):
    factor, pattern, _ = EXCEPTIONS.get(name, (1.0, "*", ""))
    found = compare.flatten(CASES[name].run())
    result = list(compare.differences(GOLDEN[name], found, factor, pattern))
    assert not result, "\n".join(result)


EXAMPLE = compare.flatten(
    {
        "fit": {
            "estimate": np.array([1.0, 2.0]),
            "sd": np.array([1e-5, np.inf]),
            "scale": np.array([1e-3, 1e-3]),
        },
        "kinematic": {"pose": np.array([0.5, 0.25])},
        "singular_values": np.array([1e4, 1e-12]),
        "names": ["a", "b"],
        "rank": 1,
    }
)


@pytest.mark.parametrize(
    ("path", "changed", "same"),
    [
        ("fit/estimate", [1.0 + 5e-15, 2.0], True),
        ("fit/estimate", [1.0 + 2e-14, 2.0], False),
        ("fit/estimate", [1.0, 2.0 + 2e-12], False),
        ("fit/sd", [1e-5 * (1 + 2e-9), np.inf], False),
        ("fit/sd", [1e-5, 1.0], False),
        ("kinematic/pose", [0.5, 0.25 + 5e-13], True),
        ("kinematic/pose", [0.5, 0.25 + 2e-12], False),
        ("singular_values", [1e4, 5e-6], True),
        ("singular_values", [1e4, 2e-5], False),
        ("names", ["a", "c"], False),
        ("rank", 2, False),
    ],
)
def test_changes_larger_than_the_tolerance_are_detected(path, changed, same):
    assert (not list(compare.differences(EXAMPLE, EXAMPLE | {path: changed}))) == same
