# SPDX-License-Identifier: Apache-2.0
"""Golden results: loopcal still computes the numbers it computed, to the tolerances of `compare`.

`python -m tests.golden.compare` writes the fixture; with names of cases, or beginnings of names,
behind it, only these. Never regenerate it to accept an unexplained change.
"""

import numpy as np
import pytest

from tests.golden import compare
from tests.golden.cases import CASES

GOLDEN = compare.read()


def test_fixture_has_exactly_the_registered_cases():
    assert list(GOLDEN) == list(CASES)


@pytest.mark.parametrize("name", CASES)
def test_results_equal_the_golden_results(name):
    result = list(compare.differences(GOLDEN[name], compare.flatten(CASES[name]())))
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
