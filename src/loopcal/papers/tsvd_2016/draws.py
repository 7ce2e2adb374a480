# SPDX-License-Identifier: Apache-2.0
"""Many machines: the methods compared over draws of the paper's errors and noise.

Raw methods are judged at their best: for each machine and each measure with the best lambda or k,
which requires knowing the true machine. The library's methods choose theirs from the data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.estimate import GCV, MAP, FitOptions, LeastSquares, Ridge, identify_trials
from loopcal.estimate.methods.penalties import Method
from loopcal.measure import make_random_stream
from loopcal.papers.printed import Cell, Table
from loopcal.papers.tsvd_2016.machines import (
    MEASURES,
    Study,
    draw_true_values,
    load_machine,
    measure_machines,
)
from loopcal.papers.tsvd_2016.steps import iterate, penalize_ridge, penalize_truncated
from loopcal.papers.wording import read_wording
from loopcal.typing import FloatArray, IntArray

RAW_LS, RAW_RE, RAW_TSVD = "raw LS", "best raw RE", "best raw TSVD"
WHITENED, CROSS, PRIOR, HINDSIGHT = (
    "whitened LS",
    "whitened ridge, GCV",
    "MAP",
    "whitened ridge, best lambda in hindsight",
)
RAW_FIVE, WHITENED_FIVE, PRIOR_FIVE = (
    "raw LS with rank detection, 5-DOF",
    "whitened LS, 5-DOF",
    "MAP, 5-DOF",
)
BEFORE = "before calibration"
METHODS = (
    BEFORE,
    RAW_LS,
    RAW_RE,
    RAW_TSVD,
    WHITENED,
    CROSS,
    PRIOR,
    HINDSIGHT,
    RAW_FIVE,
    WHITENED_FIVE,
    PRIOR_FIVE,
)

LAMBDAS = np.logspace(-6.0, 1.0, 15)
"""Of RE, from below the smallest singular value of either manipulator to above 1; two a decade."""
HINDSIGHT_LAMBDAS = np.logspace(-2.5, 2.5, 11)
"""Of ridge on whitened, scaled rows, where 1 is MAP."""
TOGETHER = 8
"""Machines at a time, for memory."""
RESAMPLES = 2000
RESAMPLING = 4  # purpose of a random stream


@dataclass(frozen=True, eq=False)
class Draws:
    """Results of t drawn machines.

    Attributes
    ----------
    name : of the structure. errors : method -> (t, 4), see MEASURES.
    lambdas, ks : (l,), (k,) settings of RE and TSVD. ridge, truncated : (t, l, 4), (t, k, 4) errors
        at them.
    """

    name: str
    errors: dict[str, FloatArray]
    lambdas: FloatArray
    ks: IntArray
    ridge: FloatArray
    truncated: FloatArray

    def __len__(self) -> int:
        return len(self.ridge)

    def compute_median(self, method: str) -> FloatArray:
        """Return medians (4,) over the machines."""
        return np.median(self.errors[method], axis=0)

    def compute_interval(self, method: str) -> FloatArray:
        """Return the bootstrap interval (2, 4) of the medians, 95 %."""
        return _interval(np.median(_resampled(self.errors[method]), axis=1))

    def compute_ratio(self, method: str, other: str) -> FloatArray:
        """Return the ratio (4,) of medians, method over other."""
        return self.compute_median(method) / self.compute_median(other)

    def compute_ratio_interval(self, method: str, other: str) -> FloatArray:
        """Return the bootstrap interval (2, 4) of the ratio of medians, the machines drawn in
        pairs, 95 %.
        """
        return _interval(
            np.median(_resampled(self.errors[method]), axis=1)
            / np.median(_resampled(self.errors[other]), axis=1)
        )

    def compute_curve(self, algorithm: str) -> FloatArray:
        """Return medians (s, 4) over the machines at every setting of "RE" (LS, then rising lambda)
        or "TSVD" (falling k).
        """
        if algorithm == "TSVD":
            return np.median(self.truncated, axis=0)
        return np.concatenate([self.compute_median(RAW_LS)[None], np.median(self.ridge, axis=0)])

    def count_diverged(self, method: str) -> int:
        """Return the number of machines for which the method diverged; their errors count as
        infinite.
        """
        return int(np.isinf(self.errors[method][:, 0]).sum())


def draw_machines(
    name: str, seed: int, trials: int, progress: Callable[[str], None] = lambda _: None
) -> Draws:
    """Draw machines, measure and identify them by all methods."""
    truth = draw_true_values(load_machine(name), trials, seed)
    whole = measure_machines(name, truth, seed=seed)
    p = len(whole.robot.parameters)
    ks = np.arange(p, p // 3, -1)
    penalty = np.concatenate([penalize_truncated(ks, p), penalize_ridge(LAMBDAS, p)])
    parts = []
    for first in range(0, trials, TOGETHER):
        progress(f"{name}, drawing {first + 1} of {trials}")
        machines = np.arange(first, min(first + TOGETHER, trials))
        run = iterate(
            whole, np.tile(penalty, (len(machines), 1)), np.repeat(machines, len(penalty))
        )
        errors = whole.compute_output_errors(run.values, run.machine)
        parts.append(errors.reshape(len(machines), len(penalty), -1))
    curves = _mark_diverged(np.concatenate(parts))
    by_k, by_lambda = curves[:, : len(ks)], curves[:, len(ks) :]
    errors = {
        BEFORE: whole.compute_output_errors(
            np.repeat(whole.robot.parameters.nominal[None], trials, axis=0)
        ),
        RAW_LS: by_k[:, 0],
        RAW_RE: by_lambda.min(axis=1),
        RAW_TSVD: by_k.min(axis=1),
        **run_whitened(whole, {WHITENED: LeastSquares(), CROSS: Ridge(GCV()), PRIOR: MAP()}),
        HINDSIGHT: _run_in_hindsight(whole),
        RAW_FIVE: _run_with_rank(whole.five),
        **run_whitened(whole.five, {WHITENED_FIVE: LeastSquares(), PRIOR_FIVE: MAP()}),
    }
    return Draws(name, {method: errors[method] for method in METHODS}, LAMBDAS, ks, by_lambda, by_k)


def run_whitened(measured: Study, methods: Mapping[str, Method]) -> dict[str, FloatArray]:
    """Return errors (t, 4) of the library's methods: rows whitened, columns scaled by tolerance."""
    return {
        name: measured.compute_output_errors(
            identify_trials(measured.robot, measured.trials, method).values
        )
        for name, method in methods.items()
    }


def _run_with_rank(measured: Study) -> FloatArray:
    """Return errors of raw LS without the null direction: one singular value fewer."""
    p = len(measured.robot.parameters)
    machines = np.arange(len(measured.trials))
    run = iterate(measured, penalize_truncated(np.array([p - 1]), p), machines)
    return _mark_diverged(measured.compute_output_errors(run.values))


def _run_in_hindsight(measured: Study) -> FloatArray:
    """Return the least error of each machine and measure over HINDSIGHT_LAMBDAS."""
    start, tried = None, []
    for lam in HINDSIGHT_LAMBDAS:
        fit = identify_trials(
            measured.robot, measured.trials, Ridge(float(lam)), options=FitOptions(start=start)
        )
        start = fit.values
        tried.append(measured.compute_output_errors(fit.values))
    return np.min(tried, axis=0)


def make_medians(draws: Draws) -> Table:
    """Return medians with their intervals."""
    rows: list[tuple[Cell, ...]] = []
    for method in METHODS:
        middle, (low, high) = draws.compute_median(method), draws.compute_interval(method)
        cells = [c for i in (0, 1, 2) for c in (float(middle[i]), f"{low[i]:.2g} to {high[i]:.2g}")]
        rows.append((method, *cells, float(middle[3]), draws.count_diverged(method)))
    words, name = read_wording(__file__), f"draws_{write_file_name(draws.name)}"
    return words.table("draws", rows, name, name=draws.name, trials=len(draws))


def make_ratios(draws: Draws) -> Table:
    """Return ratios of medians: MAP, the default kind of fit, over each of the others."""
    rows: list[tuple[Cell, ...]] = []
    for other in (method for method in METHODS[1:8] if method != PRIOR):
        ratio = draws.compute_ratio(PRIOR, other)
        low, high = draws.compute_ratio_interval(PRIOR, other)
        cells = (c for i in (0, 1) for c in (float(ratio[i]), float(low[i]), float(high[i])))
        rows.append((f"MAP over {other}", *cells))
    words, name = read_wording(__file__), f"ratios_{write_file_name(draws.name)}"
    return words.table("ratios", rows, name, name=draws.name, trials=len(draws))


def make_median_curves(draws: Draws) -> Table:
    """Return median errors at every lambda and k."""
    settings = [("RE", float(x)) for x in (0.0, *draws.lambdas)]
    settings += [("TSVD", float(k)) for k in draws.ks]
    curves = np.concatenate([draws.compute_curve("RE"), draws.compute_curve("TSVD")])
    rows = [
        (*setting, *(float(e) if np.isfinite(e) else None for e in errors[:3]))
        for setting, errors in zip(settings, curves, strict=True)
    ]
    words, name = read_wording(__file__), f"curves_{write_file_name(draws.name)}"
    return words.table("median_curves", rows, name, name=draws.name, trials=len(draws))


def to_document(draws: Draws, seed: int) -> dict[str, Any]:
    """Return the draws for evidence: tables by name, and which curves have an interior minimum."""
    tables = {
        "medians": make_medians(draws),
        "ratios": make_ratios(draws),
        "curves": make_median_curves(draws),
    }
    inside = {
        algorithm: {
            m: has_interior_minimum(draws.compute_curve(algorithm)[:, i])
            for i, m in enumerate(MEASURES[:3])
        }
        for algorithm in ("RE", "TSVD")
    }
    return {
        "robot": draws.name,
        "seed": seed,
        "draws": len(draws),
        "minimum_inside": inside,
        "tables": {
            name: {
                "columns": list(t.columns),
                "formats": list(t.formats),
                "rows": [list(row) for row in t.rows],
            }
            for name, t in tables.items()
        },
    }


def has_interior_minimum(curve: FloatArray, gain: float = 1.05) -> bool:
    """Return whether both ends of a curve (s,) are at least `gain` times its inner minimum."""
    best = int(np.argmin(curve))
    return bool(0 < best < len(curve) - 1 and min(curve[0], curve[-1]) > gain * curve[best])


def write_file_name(name: str) -> str:
    """Return the name of a manipulator in file names."""
    return name.lower().replace("-", "_")


def _mark_diverged(errors: FloatArray) -> FloatArray:
    """Count diverged machines as infinitely wrong, so that medians stay honest."""
    return np.where(np.isnan(errors), np.inf, errors)


def _resampled(values: FloatArray) -> FloatArray:
    """(RESAMPLES, t, ..) machines drawn with replacement, always the same ones."""
    t = len(values)
    return values[make_random_stream(0, 0, RESAMPLING).integers(0, t, (RESAMPLES, t))]


def _interval(medians: FloatArray) -> FloatArray:
    return np.quantile(medians, [0.025, 0.975], axis=0)
