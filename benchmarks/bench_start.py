# SPDX-License-Identifier: Apache-2.0
"""How long loopcal takes to start, and whole commands take, against a Python that imports numpy and
ends.
"""

import functools
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.harness import Metric, measure_ratio


def run_python(*arguments: str, engine: str = "numpy") -> None:
    """Run this Python with the arguments, silently, from compiled modules as users have them."""
    variables = {**os.environ, "LOOPCAL_ENGINE": engine}
    variables.pop("PYTHONDONTWRITEBYTECODE", None)
    words = [sys.executable, *arguments]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL, env=variables)


def read_processor_time() -> float:
    """Return the processor time of all processes that this one has waited for [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


import_numpy = functools.partial(run_python, "-c", "import numpy")


def bench_import() -> Metric:
    """Time `import loopcal`, whose public names are loaded on first use."""
    work = functools.partial(run_python, "-c", "import loopcal")
    return measure_ratio("start.import", work, import_numpy, limit=1.0)


def bench_help() -> Metric:
    """Time `loopcal --help`, which loads the commands but nothing heavy."""
    command = (
        "import sys; from loopcal.cli.entry_point import main; "
        "sys.argv = ['loopcal', '--help']; main()"
    )
    return measure_ratio(
        "start.help", functools.partial(run_python, "-c", command), import_numpy, limit=1.5
    )


def bench_calibration() -> list[Metric]:
    """Time `loopcal calibrate` and `loopcal report` of the example hexapod as whole processes: 40
    poses, 42 parameters, held-out poses, all checks, and the files that are written and read back.
    """
    data = Path(__file__).resolve().parents[1] / "examples" / "hexapod-42" / "measurements.csv"
    with tempfile.TemporaryDirectory() as folder:
        run = str(Path(folder) / "run")
        calibrate = ("calibrate", "hexapod-42", str(data), "-o", run, "--hold-out", "0.25")
        report = ("report", run, "-o", str(Path(folder) / "report.html"))
        return [
            measure_ratio(
                f"start.{name}",
                functools.partial(run_python, "-m", "loopcal", *words, "--force"),
                import_numpy,
                clock=read_processor_time,
            )
            for name, words in (("calibrate", calibrate), ("report", report))
        ]
