# SPDX-License-Identifier: Apache-2.0
"""How long loopcal takes to start, against a Python that imports numpy and ends."""

import functools
import subprocess
import sys

from benchmarks.harness import Metric, measure_ratio


def _python(*arguments: str) -> None:
    """Run this Python with the arguments, silently."""
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)


_import_numpy = functools.partial(_python, "-c", "import numpy")


def bench_import() -> Metric:
    """Time `import loopcal`, whose public names are loaded on first use."""
    return measure_ratio(
        "start.import", functools.partial(_python, "-c", "import loopcal"), _import_numpy, limit=1.0
    )


def bench_help() -> Metric:
    """Time `loopcal --help`, which loads the commands but nothing heavy."""
    command = "import sys; from loopcal.cli import main; sys.argv = ['loopcal', '--help']; main()"
    return measure_ratio(
        "start.help", functools.partial(_python, "-c", command), _import_numpy, limit=1.5
    )
