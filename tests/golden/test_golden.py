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

END_OF_SETUP = (
    "errors before the calibration are residuals after a search for unknown frames and targets, "
    "which ends where a step changes the whitened residuals by less than 1e-7 of their norm; the "
    "norm of 120 residuals is at most 11 times the largest"
)
EXCEPTIONS: dict[str, tuple[dict[str, float], str]] = {
    "validation/hexapod-42/targets": ({"*_before/*": 1.1e-6, "kinds/*": 1.1e-6}, END_OF_SETUP)
}
"""Case: (pattern of paths -> tolerance as a share of the largest, reason)."""

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
ROBUST_REFERENCE = (
    "a fit that contradicts its noise is no longer the point at which outliers are judged: it is "
    "a robust fit of the same data; the outliers are the same"
)
PER_LEG = (
    "leg by leg solves with the pose's sensitivities instead of the engine's closure rows: the "
    "same numbers, rounded elsewhere"
)
OTHER_START = "poses begin elsewhere, and descents end within 1e-6 of the norm of their residuals"
CORRECTED: dict[str, str] = {
    "accuracy/hexapod-42/monte-carlo": OTHER_START,
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
    "outliers/least-squares": f"{FOUND_NOISE}; {ROBUST_REFERENCE}",
    "outliers/map": f"{FOUND_NOISE}; {ROBUST_REFERENCE}",
    "papers/hexapod-42/methods": f"{OTHER_START}; {PER_LEG}",
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

AT_ROUNDING = ("robots/*/map", "robots/*/least-squares", "losses/*")
"""Patterns of cases of which numbers that changed by a tenth of their tolerance and more, up to
1.4e-7 standard deviations, were collected again, because their fits are followed to rounding: a
descent ends where rounding of the sum of squares hides the gain of a step, or a step changes the
residuals by less than 1e-6 of their norm.
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
    patterns = (*AT_ROUNDING, *(one for several in NOISE_TESTED for one in several))
    assert all(fnmatch.filter(CASES, one) for one in patterns)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if case.slow else [])
        for name, case in CASES.items()
    ],
)
def test_results_equal_the_golden_results(name):
    exceptions, _ = EXCEPTIONS.get(name, ({}, ""))
    found = compare.flatten(CASES[name].run())
    result = list(compare.differences(GOLDEN[name], found, exceptions))
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
SOLVED = compare.flatten(
    {
        "fit": {"estimate": np.array([1.0]), "sd": np.array([1e-3]), "scale": np.array([1.0])},
        "condition": 1e6,
        "cost": 100.0,
        "conditions": np.array([10.0, 5e3]),
        "kinematic": {"left": np.array([1.0, 1e-3])},
        "p_value": 0.5,
        "degrees": 100,
    }
)


@pytest.mark.parametrize(
    ("path", "changed", "same"),
    [
        ("fit/estimate", [1.0 + 3.1e-12], True),  # 1e-9 + 2.2e-16 * 1e6 * 10 standard deviations
        ("fit/estimate", [1.0 + 3.3e-12], False),
        ("condition", 1e6 * (1.0 + 1.2e-9), True),
        ("condition", 1e6 * (1.0 + 1.3e-9), False),
        ("kinematic/left", [1.0, 1e-3 + 1.1e-8], True),  # 2.2e-16 * 5e3 * 1e4
        ("kinematic/left", [1.0, 1e-3 + 1.2e-8], False),
        ("p_value", 0.5 + 9e-9, True),
        ("p_value", 0.5 + 1.1e-8, False),
    ],
)
def test_tolerances_grow_with_the_condition_number_and_the_degrees(path, changed, same):
    assert (not list(compare.differences(SOLVED, SOLVED | {path: changed}))) == same


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
