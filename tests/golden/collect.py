# SPDX-License-Identifier: Apache-2.0
"""Compute all golden results anew and write the fixture: `python -m tests.golden.collect`.

With names of cases (or beginnings of names) behind it, only these are computed and the others kept;
`--time` shows how long each takes.
"""

from __future__ import annotations

import platform
import sys
import time

import numpy as np
import scipy

from tests.golden import compare
from tests.golden.cases import CASES


def collect(chosen: tuple[str, ...] = (), timed: bool = False) -> None:
    """Rewrite the fixture: all of it, or the cases whose names begin with `chosen`."""
    results = compare.read() if chosen else {}
    for name, case in CASES.items():
        if not chosen or name.startswith(chosen):
            begun = time.perf_counter()
            results[name] = compare.flatten(case.run())
            if timed:
                print(f"{time.perf_counter() - begun:8.2f} s  {name}", flush=True)  # noqa: T201
    ordered = {name: results[name] for name in CASES if name in results}
    versions = {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }
    compare.write(versions, ordered)


if __name__ == "__main__":
    collect(tuple(a for a in sys.argv[1:] if a != "--time"), "--time" in sys.argv)
