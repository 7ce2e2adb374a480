# SPDX-License-Identifier: Apache-2.0
"""Judge every claim of the paper, and our own checks, by the numbers of this run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.papers.hexapod_42.noise_study import (
    PAPERS_TEN,
    PRESUMED,
    STATED,
    compute_published_sizes,
    find_level,
)
from loopcal.papers.hexapod_42.published import MM, ODD_POSE, TO_PRINTED
from loopcal.papers.hexapod_42.table_4_study import write_rotation
from loopcal.papers.reproduction import Verdict
from loopcal.papers.wording import Wording, read_wording

if TYPE_CHECKING:
    from loopcal.papers.hexapod_42.study import Results

ROUNDED = ("before", "as printed", "row corrected", "without row", "in full", "weighted", "prior")
"""Short names of the rows of the table `rounding`."""


def judge_claims(results: Results) -> tuple[Verdict, ...]:
    """Return a verdict for each claim."""
    words = read_wording(__file__)
    return (
        words.judge("symmetric", table=results.comparisons["table_2"]),
        words.judge(
            "converges",
            table=results.comparisons["table_3"],
            iterations=results.printed.iterations + 1,
        ),
        *_judge_table_4(words, results),
        *_judge_iteration(words, results),
        *_judge_residuals(words, results),
        *_judge_methods(words, results),
    )


def _judge_table_4(words: Wording, results: Results) -> tuple[Verdict, ...]:
    best, second = results.orders[:2]
    printed = write_rotation(results.printed.order)
    stated = next(order for order in results.orders if order.formula == printed)
    fourth = results.comparisons["table_4"]
    labels = fourth.published.labels
    is_actual = np.array([not label.endswith("PT") for label in labels])
    is_odd = np.array([label.startswith(f"{ODD_POSE} ") for label in labels])
    good, bad = fourth.within[is_actual & ~is_odd], fourth.within[is_actual & is_odd]
    without = next(fit for fit in results.outliers.first if fit.label == ODD_POSE)
    noise_rms = results.printed.noise / MM / np.sqrt(3.0)
    errors = dict(zip(ROUNDED, (row[2] for row in results.rounding), strict=True))
    return (
        words.judge(
            "rotation", printed=printed, count=len(results.orders), best=best, second=second,
            stated=stated,
        ),
        words.judge("table_4", row=ODD_POSE, agreeing=int(good.sum()), count=good.size),
        words.judge(
            "odd_row", row=ODD_POSE, differing=int((~bad).sum()), count=bad.size, without=without,
            odd=results.comparisons["table_4_a2"], named=results.outliers.labels or ("no pose",),
        ),
        words.judge("table_4_noise", best=best, stated=noise_rms, limit=noise_rms / 3.0),
        words.judge("rounding", row=ODD_POSE, errors=errors),
    )  # fmt: skip


def _judge_iteration(words: Wording, results: Results) -> tuple[Verdict, ...]:
    printed, stated = results.printed, find_level(results.levels, STATED)
    needed = [run.count_needed(printed.threshold) for run in (results.exact, results.frozen)]
    return (
        words.judge(
            "threshold", threshold=printed.threshold, iterations=printed.iterations, needed=needed,
            exact=results.exact.integrated, frozen=results.frozen.integrated,
        ),
        words.judge(
            "threshold_noise", noise=printed.noise / MM, met=int(np.isfinite(stated.needed).sum()),
            count=len(stated.needed), median=stated.median[3], angle=STATED[1],
        ),
    )  # fmt: skip


def _judge_residuals(words: Wording, results: Results) -> tuple[Verdict, ...]:
    stated, sizes = find_level(results.levels, STATED), compute_published_sizes(results.printed)
    holding = [level for level in results.levels if level.contains(sizes).all()]
    names = [f"+-{lv.limits[0]:g} mm with +-{lv.limits[1]:g} rad" for lv in holding]
    explained = 100.0 * results.explained
    before = results.comparisons["table_6_before"]
    is_good = np.array([label != ODD_POSE for label in before.published.labels])
    as_rad, as_mrad = (
        int(before.agrees_with(factor * before.computed)[is_good, 3:].sum())
        for factor in (1.0, 1e3)
    )
    noise = results.noise * TO_PRINTED
    mean, scatter = noise.mean(axis=0), noise.std(axis=0, ddof=1)
    lengths, angles = (", ".join(f"{x:.1e}" for x in part) for part in (mean[:3], mean[3:]))
    limit = PRESUMED[0]
    return (
        words.judge(
            "noise_size", "" if holding else "none", inside=int(stated.contains(sizes).sum()),
            sizes=len(sizes), printed=sizes, noise=results.printed.noise / MM, holding=names,
            stated=stated.median,
        ),
        words.judge(
            "residuals", least=explained.min(), most=explained.max(), random=100.0 * np.sqrt(0.7)
        ),
        words.judge(
            "milliradians", as_rad=as_rad, as_mrad=as_mrad, count=3 * int(is_good.sum()),
            row=ODD_POSE,
        ),
        words.judge(
            "mean_noise", offset=(np.abs(mean) * np.sqrt(len(noise)) / scatter).max(),
            lengths=lengths, angles=angles, scatter_mm=scatter[:3].max(),
            scatter_rad=scatter[3:].max(), limit=limit, limit_sd=limit / np.sqrt(3.0),
        ),
    )  # fmt: skip


def _judge_methods(words: Wording, results: Results) -> tuple[Verdict, ...]:
    before, alone, together, prior = results.methods
    seven, ten = results.poses[0], next(row for row in results.poses if row[0] == PAPERS_TEN)
    methods: dict[str, Any] = {
        "before": before,
        "alone": alone,
        "together": together,
        "prior": prior,
    }
    ratio, ratio_of_methods = (alone.parameters / m.parameters for m in (before, together))
    smaller = {limits: _count_smaller(results, limits) for limits in (STATED, PRESUMED)}
    return (
        words.judge(
            "parameters_improve", ratio=ratio, smaller_stated=smaller[STATED],
            smaller_presumed=smaller[PRESUMED], presumed=PRESUMED, **methods,
        ),
        words.judge("positions_improve", **methods),
        words.judge("leg_by_leg", ratio=ratio_of_methods, **methods),
        words.judge(
            "seven_poses", iterations=seven[2], error=seven[3], seven=seven[4], ten=ten[4]
        ),
    )  # fmt: skip


def _count_smaller(results: Results, limits: tuple[float, float]) -> int:
    """Return how many parameter errors decrease in the first draw of this noise."""
    run = results.presumed if limits == PRESUMED else results.stated
    errors = np.abs(run.compute_parameter_errors(results.study.truth))
    return int((errors[results.printed.iterations] < errors[0]).sum())
