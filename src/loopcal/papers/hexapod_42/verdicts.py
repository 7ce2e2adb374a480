# SPDX-License-Identifier: Apache-2.0
"""Judge every claim of the paper, and our own checks, by the numbers of this run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from loopcal.papers.hexapod_42.leg_form import LegForm
from loopcal.papers.hexapod_42.noise_study import PRESUMED, STATED, Level, compute_published_sizes
from loopcal.papers.hexapod_42.published import MM, ODD_POSE, to_values
from loopcal.papers.hexapod_42.steps import compute_actual_poses, name_orientation, to_twists
from loopcal.papers.hexapod_42.table_4_study import write_rotation
from loopcal.papers.reproduction import Verdict
from loopcal.papers.wording import read_wording
from loopcal.typing import BoolArray, FloatArray

if TYPE_CHECKING:
    from loopcal.papers.hexapod_42.study import Results

TO_PRINTED = np.array([1.0 / MM] * 3 + [1.0] * 3)
"""From [m, rad] to the units of Tables 4 and 6."""


def judge_claims(results: Results) -> tuple[Verdict, ...]:
    """Return a verdict for each claim."""
    return (
        *_judge_machine(results),
        *_judge_table_4(results),
        *_judge_iteration(results),
        *_judge_residuals(results),
        *_judge_methods(results),
    )


def _judge_machine(results: Results) -> tuple[Verdict, ...]:
    words = read_wording(__file__)
    second, third = results.comparisons["table_2"], results.comparisons["table_3"]
    return (
        words.judge(
            "symmetric",
            differing=second.count - second.agreeing,
            count=second.count,
            largest=second.largest,
        ),
        words.judge(
            "converges",
            differing=third.count - third.agreeing,
            iterations=results.printed.iterations + 1,
            largest=third.largest,
        ),
    )


def _judge_table_4(results: Results) -> tuple[Verdict, ...]:
    words, printed = read_wording(__file__), write_rotation(results.printed.order)
    best, second = results.orders[:2]
    stated = next(order for order in results.orders if order.formula == printed)
    fourth, odd = results.comparisons["table_4"], results.comparisons["table_4_a2"]
    labels = fourth.published.labels
    is_actual = np.array([not label.endswith("PT") for label in labels])
    is_odd = np.array([label.startswith(f"{ODD_POSE} ") for label in labels])
    good, bad = fourth.within[is_actual & ~is_odd], fourth.within[is_actual & is_odd]
    without = next(fit for fit in results.outliers.first if fit.label == ODD_POSE)
    noise_rms = results.printed.noise / MM / np.sqrt(3.0)
    rounding = {row[0]: float(str(row[2])) for row in results.rounding}
    before = rounding["not calibrated"]
    printed_errors = {
        "as_printed": rounding["Table 4 as printed"],
        "repaired": rounding["row A2 computed, rounded as row A1"],
        "without": rounding["without row A2"],
    }
    weighted = "without row A2, all legs weighted by the rounding, "
    return (
        words.judge(
            "rotation",
            printed=printed,
            count=len(results.orders),
            best=best,
            second=second,
            stated=stated,
        ),
        words.judge(
            "table_4",
            row=ODD_POSE,
            agreeing=int(good.sum()),
            count=good.size,
        ),
        words.judge(
            "odd_row",
            row=ODD_POSE,
            differing=int((~bad).sum()),
            count=bad.size,
            odd_agreeing=odd.agreeing,
            odd_count=odd.count,
            named=results.outliers.labels or ("no pose",),
            drop=without.drop,
            chi_square=without.chi_square,
            degrees=without.degrees,
        ),
        words.judge(
            "table_4_noise", agrees=best.position > noise_rms / 3.0, difference=best.position,
            stated=noise_rms,
        ),
        words.judge(
            "rounding",
            row=ODD_POSE,
            before=before,
            full=rounding["computed poses in full"],
            weighted=rounding[weighted + "least squares"],
            prior=rounding[weighted + "tolerances as prior (MAP)"],
            **printed_errors,
        ),
    )  # fmt: skip


def _judge_iteration(results: Results) -> tuple[Verdict, ...]:
    words, printed = read_wording(__file__), results.printed
    stated = _find_level(results, STATED)
    met = int(np.isfinite(stated.needed).sum())
    runs = (results.exact, results.frozen)
    return (
        words.judge(
            "threshold",
            agrees=all(run.count_needed(printed.threshold) == printed.iterations for run in runs),
            threshold=printed.threshold,
            iterations=printed.iterations,
            exact=results.exact.integrated,
            frozen=results.frozen.integrated,
        ),
        words.judge(
            "threshold_noise",
            noise=printed.noise / MM,
            met=met,
            count=len(stated.needed),
            median=stated.median[3],
            angle=STATED[1],
        ),
    )


def _judge_residuals(results: Results) -> tuple[Verdict, ...]:
    words, sizes = read_wording(__file__), compute_published_sizes(results.printed)
    stated = _find_level(results, STATED)
    holding = [level for level in results.levels if level.contains(sizes)]
    names = [f"+-{lv.limits[0]:g} mm with +-{lv.limits[1]:g} rad" for lv in holding]
    explained = 100.0 * _compute_explained_share(results)
    within = results.comparisons["table_6_before"].within[_select_good_rows(results), 3:]
    noise = recover_noise(results) * TO_PRINTED
    mean, scatter = noise.mean(axis=0), noise.std(axis=0, ddof=1)
    lengths, angles = (", ".join(f"{x:.1e}" for x in part) for part in (mean[:3], mean[3:]))
    limit = _find_level(results, PRESUMED).limits[0]
    return (
        words.judge(
            "noise_size",
            "" if holding else "none",
            agrees=stated in holding,
            noise=results.printed.noise / MM,
            printed=sizes,
            holding=names,
            stated=stated.median,
        ),
        words.judge(
            "residuals", least=explained.min(), most=explained.max(), random=100.0 * np.sqrt(0.7)
        ),
        words.judge("milliradians", agrees=not within.all(), row=ODD_POSE),
        words.judge(
            "mean_noise",
            agrees=bool(np.all(np.abs(mean) < 4.0 * scatter / np.sqrt(len(noise)))),
            lengths=lengths,
            angles=angles,
            scatter_mm=scatter[:3].max(),
            scatter_rad=scatter[3:].max(),
            limit=limit,
            limit_sd=limit / np.sqrt(3.0),
        ),
    )


def _judge_methods(results: Results) -> tuple[Verdict, ...]:
    words = read_wording(__file__)
    before, alone, together, prior = results.methods
    seven, ten = (next(row for row in results.poses if row[1] == n) for n in (7, 10))
    condition = float(str(seven[3]))
    return (
        words.judge(
            "parameters_improve",
            alone=alone,
            before=before,
            prior=prior,
            ratio=alone.parameters / before.parameters,
            smaller_stated=_count_smaller(results, STATED),
            smaller_presumed=_count_smaller(results, PRESUMED),
            presumed=PRESUMED,
        ),
        words.judge("positions_improve", before=before, alone=alone, prior=prior),
        words.judge(
            "leg_by_leg",
            ratio=alone.parameters / together.parameters,
            alone=alone,
            together=together,
        ),
        words.judge(
            "seven_poses",
            agrees=bool(np.isfinite(condition)) and seven[2] is not None,
            iterations=seven[2],
            seven=condition,
            ten=float(str(ten[3])),
        ),
    )


def recover_noise(results: Results) -> FloatArray:
    """Return the noise (n, 6) [m, rad] that Tables 5 and 6 together imply.

    residual = noise + D (true - corrected parameters), with D the change of the coordinates.
    """
    study, printed = results.study, results.printed
    actual = compute_actual_poses(study)
    D = LegForm.at(study.truth, study.solve_truth()).D
    rates = name_orientation(study.order).rates_inverse(actual[:, 3:])
    by_coordinates = np.concatenate([D[:, 3:], rates @ D[:, :3]], axis=1)
    errors = to_values(study.robot, printed.parameter_errors_after.values * 1e-3 * MM)
    return printed.pose_errors_after.values / TO_PRINTED - by_coordinates @ errors


def _compute_explained_share(results: Results) -> FloatArray:
    """Return the share (6,) of each leg's residuals of Table 6 that parameters could explain."""
    study = results.study
    residuals = results.printed.pose_errors_after.values / TO_PRINTED
    legs = LegForm.at(study.truth, study.solve_truth())
    return legs.explain(to_twists(residuals, compute_actual_poses(study), study.order))


def _count_smaller(results: Results, limits: tuple[float, float]) -> int:
    """Return how many parameter errors decrease in the first draw of this noise."""
    run = results.presumed if limits == PRESUMED else results.stated
    errors = np.abs(run.compute_parameter_errors(results.study.truth))
    return int((errors[results.printed.iterations] < errors[0]).sum())


def _find_level(results: Results, limits: tuple[float, float]) -> Level:
    return next(level for level in results.levels if level.limits == limits)


def _select_good_rows(results: Results) -> BoolArray:
    return np.array([label != ODD_POSE for label in results.printed.pose_errors_before.labels])
