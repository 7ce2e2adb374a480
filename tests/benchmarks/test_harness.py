# SPDX-License-Identifier: Apache-2.0
"""The benchmark gate fails for metrics that worsen or exceed their limit, and for no others."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks import harness
from benchmarks.harness import Metric

BASELINE = {"fit": {"value": 4.0}}


@pytest.mark.parametrize(
    ("value", "direction", "faults"),
    [
        (4.9, "lower", 0),
        (5.1, "lower", 1),
        (0.1, "lower", 0),
        (3.1, "higher", 0),
        (2.9, "higher", 1),
        (9.0, "higher", 0),
    ],
)
def test_metric_fails_only_if_it_worsens_beyond_its_tolerance(
    value: float, direction: str, faults: int
) -> None:
    metric = Metric("fit", value, direction=direction, tolerance=0.25)  # pyright: ignore[reportArgumentType]
    assert len(harness.find_faults(metric, BASELINE)) == faults


def test_metric_beyond_its_limit_fails_even_if_it_equals_the_baseline() -> None:
    (fault,) = harness.find_faults(Metric("fit", 4.0, limit=3.5), BASELINE)
    assert fault == "fit is 4, its limit is 3.5"


def test_metric_without_baseline_fails_with_advice() -> None:
    (fault,) = harness.find_faults(Metric("new", 1.0), BASELINE)
    assert "make bench-update" in fault


def test_keep_better_returns_the_better_measurement() -> None:
    low, high = Metric("fit", 1.0), Metric("fit", 2.0)
    assert harness.keep_better(high, low) == harness.keep_better(low, high) == low
    low, high = (
        Metric("speedup", 1.0, direction="higher"),
        Metric("speedup", 2.0, direction="higher"),
    )
    assert harness.keep_better(high, low) == harness.keep_better(low, high) == high


def test_partial_update_keeps_metrics_that_were_not_measured(tmp_path: Path) -> None:
    path = tmp_path / "baseline.json"
    harness.write_baseline(path, [Metric("a", 1.0), Metric("b", 2.0)], {"processor": "one"})
    harness.write_baseline(path, [Metric("b", 3.0)], {"processor": "two"})
    assert {name: entry["value"] for name, entry in harness.read_baseline(path).items()} == {
        "a": 1.0,
        "b": 3.0,
    }
    assert json.loads(path.read_text("utf-8"))["machine"] == {"processor": "two"}


def test_metric_without_tolerance_is_compared_with_its_limit_only() -> None:
    metric = Metric("first", 9.0, "ms", tolerance=None, limit=10.0)
    assert harness.find_faults(metric, {}) == []
    assert harness.find_faults(metric, {"first": {"value": 1.0}}) == []


def test_complete_update_removes_old_metrics_and_stores_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "baseline.json"
    harness.write_baseline(path, [Metric("a", 1.0), Metric("b", 2.0)], {})
    harness.write_baseline(path, [Metric("b", 3.0)], {}, "a new machine", is_complete=True)
    assert list(harness.read_baseline(path)) == ["b"]
    assert json.loads(path.read_text("utf-8"))["reason"] == "a new machine"


def test_measure_ratio_returns_the_ratio_of_the_shortest_times(monkeypatch) -> None:
    """A clock that the calls set shows their times: a busy machine would lengthen real ones."""
    clock = [0.0]
    monkeypatch.setattr(harness, "time", SimpleNamespace(perf_counter=lambda: clock[0]))

    def last(seconds: list[float]) -> Callable[[], None]:
        def run() -> None:
            clock[0] += seconds.pop(0)

        return run

    subject, reference = [9.0, 5.0, 3.0, 4.0], [9.0, 1.0, 2.0, 8.0]  # the first is not counted
    metric = harness.measure_ratio("calls", last(subject), last(reference), repeats=3)
    assert (metric.value, metric.note) == (3.0, "3 s against 1 s")
    assert not subject
    assert not reference
