# SPDX-License-Identifier: Apache-2.0
"""A reproduction with one comparison, table, figure and verdict."""

import numpy as np

from loopcal.papers.published import (
    OWN_CHECK,
    Comparison,
    Content,
    Figure,
    Printed,
    Reproduction,
    Series,
    Table,
    Verdict,
)

MADE_BY = {"command": ["loopcal", "reproduce", "small"], "versions": {"loopcal": "1", "numpy": "2"}}


def build_reproduction(*more: Verdict) -> Reproduction:
    printed = Printed.parse({"A": "0.12 -3E-05", "B": "7 1.50"})
    computed, columns = np.array([[0.125, -2e-5], [9.0, 1.5]]), ("x [mm]", "y [mm]")
    line = Series("a", (0.0, 1.0), (1.0, 0.1))
    labels = ("step [1]", "error [mm]", "Of 1 pose.")
    rows = (("p", 1.0), ("q", None), ("r", 3.0))
    verdict = Verdict("It holds.", False, "It does not.", OWN_CHECK, draws=(False, False))
    content = Content(
        comparisons=(Comparison("one", "Table 1", columns, printed, computed, printed.unit),),
        tables=(Table("extra", "Extra", ("case", "value"), rows, ("", ".1f"), shown=(0, 1)),),
        verdicts=(verdict, *more),
        figures=(Figure("curve", "Curve", *labels, (line,), {"rule": 0.5}),),
    )
    return Reproduction("small", "A title", "a source", ("About.",), {"seed": 0}, content)
