# SPDX-License-Identifier: Apache-2.0
"""Coverage of 95 % intervals in a few hundred fits; `make evidence` runs thousands
(evidence/coverage.py).
"""

import json

import numpy as np
import pytest

from evidence.coverage import CASES, FITS, evaluate_case

FEW_FITS = 240
CORRECT_NOISE_CASES = [case for case in CASES if case.noise == 1.0]
"""Cases whose stated noise is the true one."""


def binomial_band(p, n, sigmas=4.0):
    """Half-width of the binomial band around p for n independent draws."""
    return sigmas * np.sqrt(p * (1 - p) / n)


@pytest.mark.slow
@pytest.mark.parametrize("case", CORRECT_NOISE_CASES, ids=lambda case: case.name)
def test_95_percent_intervals_contain_the_truth_in_95_percent_of_few_fits(case):
    result = evaluate_case(case, FEW_FITS)
    # intervals of one fit are correlated: the band is that of as many draws as there are fits, at
    # four standard deviations
    assert result["coverage"] == pytest.approx(0.95, abs=binomial_band(0.95, FEW_FITS))
    assert result["rejected"] == pytest.approx(0.05, abs=binomial_band(0.05, FEW_FITS))
    # relative error of an rms of FEW fits with 60 correlated values each, as if only the fits were
    # independent
    assert result["pose_spread"] == pytest.approx(1.0, abs=4.0 / np.sqrt(2 * FEW_FITS))


@pytest.mark.slow
def test_intervals_fail_if_the_stated_noise_is_half_the_true_noise():
    (case,) = (case for case in CASES if case.noise == 2.0)
    result = evaluate_case(case, FEW_FITS)
    # half the width: a normal value lies within 0.98 sd in 67 % of the draws
    assert result["coverage"] == pytest.approx(0.673, abs=binomial_band(0.673, FEW_FITS))
    assert result["rejected"] > 0.99


@pytest.fixture(scope="module")
def coverage_table(root):
    path = root / "docs" / "evidence" / "coverage.json"
    if not path.exists():
        pytest.skip("docs/evidence/coverage.json is made by `make evidence`")
    return {row[0]: row[1:] for row in json.loads(path.read_text())["tables"]["coverage"]["rows"]}


@pytest.mark.evidence
@pytest.mark.parametrize("case", CORRECT_NOISE_CASES, ids=lambda case: case.name)
def test_published_coverage_agrees_with_the_stated_level(coverage_table, case):
    fits, coverage, _, rejected, spread = coverage_table[case.name]
    assert fits >= 0.999 * FITS
    assert coverage == pytest.approx(95.0, abs=1.5)
    assert rejected == pytest.approx(5.0, abs=1.0)
    assert spread == pytest.approx(1.0, abs=0.1)


@pytest.mark.evidence
def test_published_coverage_of_doubled_noise_fails(coverage_table):
    (case,) = (case for case in CASES if case.noise == 2.0)
    _, coverage, _, rejected, _ = coverage_table[case.name]
    assert rejected > 99.0
    assert coverage < 75.0
