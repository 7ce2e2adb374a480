# SPDX-License-Identifier: Apache-2.0
"""A benchmark gives metrics with unit, direction and tolerance, mostly ratios to a reference timed
in the same run.

A ratio of two things timed in turns, A B A B ..., keeps its value on a slow or busy machine, where
seconds do not.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal


@dataclass(frozen=True)
class Metric:
    """One measured number of a benchmark and how it is judged.

    Parameters
    ----------
    name : what was measured, `what.of_what`; the key in the baseline
    value : the measured number
    unit : "1" for a ratio
    direction : which way is better
    tolerance : worsening allowed against the baseline, relative (0.25 = a quarter); None where the
        limit alone decides, as for absolute times
    limit : bound that `value` must keep whatever the baseline says, or None
    note : absolute times and the like, for people
    """

    name: str
    value: float
    unit: str = "1"
    direction: Literal["lower", "higher"] = "lower"
    tolerance: float | None = 0.25
    limit: float | None = None
    note: str = ""

    def is_worse_than(self, bound: float) -> bool:
        """Tell whether the value is on the wrong side of `bound`."""
        return self.value > bound if self.direction == "lower" else self.value < bound


def time_once(function: Callable[[], object], clock: Callable[[], float] | None = None) -> float:
    """Return the time of one call [s], wall time without another clock."""
    read = clock or time.perf_counter
    start = read()
    function()
    return read() - start


def time_in_turns(
    *functions: Callable[[], object], repeats: int = 7, clock: Callable[[], float] | None = None
) -> tuple[tuple[float, ...], ...]:
    """Time functions in turns, A B C A B C ..., after one unmeasured call of each.

    Returns
    -------
    times : for each function, its `repeats` times [s], wall times without another clock
    """
    for function in functions:
        function()
    rounds = [[time_once(function, clock) for function in functions] for _ in range(repeats)]
    return tuple(zip(*rounds, strict=True))


def measure_ratio(
    name: str,
    subject: Callable[[], object],
    reference: Callable[[], object],
    *,
    repeats: int = 7,
    tolerance: float = 0.25,
    limit: float | None = None,
    direction: Literal["lower", "higher"] = "lower",
    clock: Callable[[], float] | None = None,
) -> Metric:
    """Time `subject` and `reference` in turns; the value is the ratio of their shortest times.

    Other programs only lengthen a time. `time.process_time` as the clock counts the time of this
    process alone, which suits work of a single thread.
    """
    ours, theirs = map(min, time_in_turns(subject, reference, repeats=repeats, clock=clock))
    note = f"{ours:.3g} s against {theirs:.3g} s"
    return Metric(name, ours / theirs, "1", direction, tolerance, limit, note)


def measure_time(
    name: str,
    subject: Callable[[], object],
    reference: Callable[[], object],
    *,
    limit: float,
    unit: Literal["s", "ms"] = "s",
    reference_name: str,
    repeats: int,
    tolerance: float,
    clock: Callable[[], float] | None = None,
) -> list[Metric]:
    """Time `subject` and `reference` in turns. The best absolute time has a limit, and the ratio of
    the best times, `name` + `_of_` + `reference_name`, has a baseline. `clock` as in
    `measure_ratio`.
    """
    ours, theirs = map(min, time_in_turns(subject, reference, repeats=repeats, clock=clock))
    factor = 1.0 if unit == "s" else 1e3
    note = f"best of {repeats}; {ours:.3g} s against {theirs:.3g} s"
    ratio = Metric(f"{name}_of_{reference_name}", ours / theirs, tolerance=tolerance, note=note)
    absolute = Metric(name, factor * ours, unit, tolerance=None, limit=limit, note="limit alone")
    return [absolute, ratio]


def find_faults(metric: Metric, baseline: dict[str, dict[str, Any]]) -> list[str]:
    """List, a sentence each, why a metric fails the gate: beyond its limit, without a baseline or
    worse than it.
    """
    shown = f"{metric.name} is {metric.value:.3g}"
    faults = []
    if metric.limit is not None and metric.is_worse_than(metric.limit):
        faults.append(f"{shown}, its limit is {metric.limit:g}")
    if metric.tolerance is None:
        return faults
    if metric.name not in baseline:
        faults.append(
            f"{shown} and has no baseline. Run `make bench-update` and commit "
            "benchmarks/baseline.json"
        )
        return faults
    before = float(baseline[metric.name]["value"])
    margin = metric.tolerance * abs(before)
    bound = before + margin if metric.direction == "lower" else before - margin
    if metric.is_worse_than(bound):
        faults.append(
            f"{shown}, its baseline is {before:.3g} and a worsening of {metric.tolerance:.0%} is "
            "allowed"
        )
    return faults


def keep_better(first: Metric, second: Metric) -> Metric:
    """Return the better of two measurements of the same thing."""
    return second if first.is_worse_than(second.value) else first


def read_baseline(path: Path) -> dict[str, dict[str, Any]]:
    """Read the committed metrics by name; none where the file does not exist."""
    return json.loads(path.read_text(encoding="utf-8"))["metrics"] if path.is_file() else {}


def write_baseline(
    path: Path,
    metrics: Sequence[Metric],
    machine: dict[str, str],
    reason: str = "",
    is_complete: bool = False,
) -> None:
    """Merge metrics into the baseline file, which names the machine that wrote it last and why.

    Where all metrics were measured (`is_complete`), others are removed.
    """
    merged = {} if is_complete else read_baseline(path)
    merged |= {
        metric.name: {k: v for k, v in asdict(metric).items() if k != "name"} for metric in metrics
    }
    document = {"machine": machine, "reason": reason, "metrics": dict(sorted(merged.items()))}
    path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
