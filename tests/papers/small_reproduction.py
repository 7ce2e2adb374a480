# SPDX-License-Identifier: Apache-2.0
"""A reproduction with one comparison, table, figure and verdict."""

import numpy as np

from loopcal.papers.printed import Comparison, Printed, Table
from loopcal.papers.reproduction import OWN_CHECK, Figure, Reproduction, Series, Verdict

MADE_BY = {"command": ["loopcal", "reproduce", "small"], "versions": {"loopcal": "1", "numpy": "2"}}


def build_reproduction() -> Reproduction:
    printed = Printed.parse({"A": "0.12 -3E-05", "B": "7 1.50"})
    comparison = Comparison(
        "one", "Table 1", ("x [mm]", "y [mm]"), printed, np.array([[0.125, -2e-5], [9.0, 1.5]])
    )
    figure = Figure(
        "curve",
        "Curve",
        "step [1]",
        "error [mm]",
        "Of 1 pose.",
        (Series("a", (0.0, 1.0), (1.0, 0.1)),),
        {"rule": 0.5},
    )
    extra = Table(
        "extra",
        "Extra",
        ("case", "value"),
        (("p", 1.0), ("q", None), ("r", 3.0)),
        ("", ".1f"),
        shown=2,
    )
    verdict = Verdict("It holds.", False, "It does not.", OWN_CHECK, draws=(False, False))
    return Reproduction(
        "small",
        "A title",
        "a source",
        ("About.",),
        {"seed": 0},
        (comparison,),
        (extra,),
        (verdict,),
        (figure,),
    )
