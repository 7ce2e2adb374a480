# SPDX-License-Identifier: Apache-2.0
"""Are the error bars true? A few hundred fits here; thousands in `make evidence`
(evidence/coverage.py).
"""

import json

import numpy as np
import pytest

from evidence.coverage import CASES, FITS, judge

FEW = 240
TRUE = [case for case in CASES if case.noise == 1.0]
"""Cases whose stated noise is the true one."""


def band(p, n, sigmas=4.0):
    """Half-width of the binomial band around p for n independent draws."""
    return sigmas * np.sqrt(p * (1 - p) / n)


@pytest.mark.slow
@pytest.mark.parametrize("case", TRUE, ids=lambda case: case.name)
def test_a_95_percent_interval_holds_the_truth_in_95_percent_of_few_fits(case):
    found = judge(case, FEW)
    # intervals of one fit are correlated: the band is that of as many draws as there are fits, at
    # four standard deviations
    assert found["coverage"] == pytest.approx(0.95, abs=band(0.95, FEW))
    assert found["rejected"] == pytest.approx(0.05, abs=band(0.05, FEW))
    # relative error of an rms of FEW fits with 60 correlated values each, as if only the fits were
    # independent
    assert found["pose_spread"] == pytest.approx(1.0, abs=4.0 / np.sqrt(2 * FEW))


@pytest.mark.slow
def test_intervals_of_noise_stated_half_as_large_as_it_is_fail():
    (case,) = (case for case in CASES if case.noise == 2.0)
    found = judge(case, FEW)
    # half the width: a normal value lies within 0.98 sd in 67 % of the draws
    assert found["coverage"] == pytest.approx(0.673, abs=band(0.673, FEW))
    assert found["rejected"] > 0.99


@pytest.fixture(scope="module")
def table(root):
    path = root / "docs" / "evidence" / "coverage.json"
    if not path.exists():
        pytest.skip("docs/evidence/coverage.json is made by `make evidence`")
    return {row[0]: row[1:] for row in json.loads(path.read_text())["tables"]["coverage"]["rows"]}


@pytest.mark.evidence
@pytest.mark.parametrize("case", TRUE, ids=lambda case: case.name)
def test_thousands_of_fits_cover_the_truth_as_often_as_they_say(table, case):
    fits, coverage, _, rejected, spread = table[case.name]
    assert fits >= 0.999 * FITS
    assert coverage == pytest.approx(95.0, abs=1.5)
    assert rejected == pytest.approx(5.0, abs=1.0)
    assert spread == pytest.approx(1.0, abs=0.1)


@pytest.mark.evidence
def test_doubled_noise_is_found_and_its_intervals_fail(table):
    (case,) = (case for case in CASES if case.noise == 2.0)
    _, coverage, _, rejected, _ = table[case.name]
    assert rejected > 99.0
    assert coverage < 75.0
