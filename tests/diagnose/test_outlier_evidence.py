# SPDX-License-Identifier: Apache-2.0
"""The committed evidence on outliers meets its acceptance limits."""

import json

from scipy.stats import binom


def test_outlier_evidence_meets_detection_accuracy_and_false_alarm_limits(root) -> None:
    tables = json.loads((root / "docs" / "evidence" / "blunders.json").read_text("utf-8"))["tables"]
    rows = {row[0]: row[1:] for row in tables["robust"]["rows"]}
    for name in ("Huber", "Tukey"):
        ratio, named, _ = rows[name]
        assert ratio < 1.3
        assert named >= 95.0
    assert rows["least squares, no loss"][0] > 2.0
    ((count, alarms, level, leverage),) = tables["alarms"]["rows"]
    # the stated level within the central 99.9 % of its binomial distribution
    low, high = binom.ppf([0.0005, 0.9995], count, level / 100.0) / count * 100.0
    assert low <= alarms <= high
    assert leverage < 0.3
