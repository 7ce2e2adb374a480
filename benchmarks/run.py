# SPDX-License-Identifier: Apache-2.0
"""Run the benchmarks: each function `bench_*` of each file benchmarks/bench_*.py returns one Metric
or several.

Run as `python -m benchmarks.run`, from the root. Names given as arguments choose files:
`kinematics` stands for bench_kinematics.py. `--gate` exits 1 when a metric is beyond its limit or
worse than the committed baseline by more than its tolerance; what fails is measured a second time
first, since other programs may have been in the way. `--update` rewrites the baseline, with the
machine and `--reason`.
"""

import argparse
import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path

# Before numpy: the references are single-threaded too, so that a ratio means the same on every
# machine.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from benchmarks.harness import Metric, find_faults, keep_better, read_baseline, write_baseline  # noqa: E402
from tools.machine import describe_machine  # noqa: E402

HERE = Path(__file__).resolve().parent
BASELINE = HERE / "baseline.json"

Benchmark = Callable[[], Metric | list[Metric]]


def find_benchmarks(chosen: list[str]) -> list[Benchmark]:
    """Return the functions `bench_*` of all files `bench_*.py`, or of the chosen ones, in order of
    name.
    """
    names = [f"bench_{name}" for name in chosen] or sorted(
        path.stem for path in HERE.glob("bench_*.py")
    )
    modules = [importlib.import_module(f"benchmarks.{name}") for name in names]
    return [
        function
        for module in modules
        for name, function in vars(module).items()
        if name.startswith("bench_") and getattr(function, "__module__", None) == module.__name__
    ]


def measure(benchmark: Benchmark) -> list[Metric]:
    """Run one benchmark."""
    result = benchmark()
    return [result] if isinstance(result, Metric) else result


def measure_for_gate(benchmark: Benchmark, baseline: dict[str, dict]) -> list[Metric]:
    """Run one benchmark, and once more when something fails, keeping the better of each metric."""
    metrics = measure(benchmark)
    if any(find_faults(metric, baseline) for metric in metrics):
        metrics = [keep_better(a, b) for a, b in zip(metrics, measure(benchmark), strict=True)]
    return metrics


def show(metric: Metric, baseline: dict[str, dict]) -> None:
    """Print a metric beside its baseline and limit."""
    before = f"{baseline[metric.name]['value']:.3g}" if metric.name in baseline else "-"
    limit = f"{metric.limit:g}" if metric.limit is not None else "-"
    print(
        f"{metric.name:44} {metric.value:9.3g} {metric.unit:6} {before:>9} {limit:>7}   "
        f"{metric.note}",
        flush=True,
    )


def main() -> int:
    """Run, print, and gate or update as asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="bench_NAME.py files to run; all without")
    action = parser.add_mutually_exclusive_group()
    action.add_argument("--gate", action="store_true", help="exit 1 when a metric got worse")
    action.add_argument("--update", action="store_true", help="write benchmarks/baseline.json")
    parser.add_argument(
        "--reason", default="", help="why the baseline changes, such as another machine; kept in it"
    )
    options = parser.parse_args()

    baseline = read_baseline(BASELINE)
    machine = describe_machine()
    print(", ".join(machine.values()))
    print(f"{'metric':44} {'value':>9} {'unit':6} {'baseline':>9} {'limit':>7}")
    metrics: list[Metric] = []
    for benchmark in find_benchmarks(options.names):
        new = measure_for_gate(benchmark, baseline) if options.gate else measure(benchmark)
        for metric in new:
            show(metric, baseline)
        metrics += new
    if options.update:
        write_baseline(BASELINE, metrics, machine, options.reason, not options.names)
        print(f"wrote {BASELINE.name}")
    if options.gate:
        faults = [fault for metric in metrics for fault in find_faults(metric, baseline)]
        print("\n".join(faults) or f"gate: all {len(metrics)} metrics within limit and tolerance")
        return 1 if faults else 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
