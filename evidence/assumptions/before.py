# SPDX-License-Identifier: Apache-2.0
"""Make before.json: the same cases with the code of an earlier commit.

Run as `PYTHONPATH=OLD/src:. python -m evidence.assumptions.before COMMIT [FITS]`, with a checkout
of the commit in OLD.
"""

import json
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import loopcal.diagnose
from loopcal.estimate.result import Identification
from loopcal.measure.measurements import Measurements


def keep_uncertainty(fit: Identification, _: Measurements) -> Identification:
    """Return the fit as it is: the earlier code does not adjust its uncertainty."""
    return fit


if not hasattr(loopcal.diagnose, "adjust_uncertainty"):
    loopcal.diagnose.__dict__["adjust_uncertainty"] = keep_uncertainty

from evidence.assumptions.cases import SETUPS, Case, list_cases  # noqa: E402
from evidence.assumptions.evaluation import FITS, evaluate_case  # noqa: E402
from evidence.assumptions.tables import BEFORE, KEPT  # noqa: E402


def evaluate(task: tuple[str, Case, int]) -> tuple[str, str, dict[str, Any]]:
    """Return the statistics of one case of one robot that the tables show."""
    name, case, fits = task
    statistics = evaluate_case(SETUPS[name], case, fits)
    return name, case.name, {key: statistics[key] for key in KEPT}


def main(commit: str, fits: int = FITS) -> None:
    """Evaluate all cases of all robots and write the file."""
    tasks = [(name, case, fits) for name in SETUPS for case in list_cases()]
    robots: dict[str, dict[str, Any]] = {name: {} for name in SETUPS}
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("fork")) as pool:
        for name, case, statistics in pool.map(evaluate, tasks):
            robots[name][case] = statistics
    BEFORE.write_text(json.dumps({"commit": commit, "robots": robots}, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
