# SPDX-License-Identifier: Apache-2.0
"""The whole study: compute everything, put it beside the printed tables, judge the claims."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from loopcal import geometry
from loopcal.mechanism.solutions import inverse
from loopcal.papers.hexapod_42 import steps
from loopcal.papers.hexapod_42.steps import (
    MM,
    ODD_POSE,
    PRESUMED,
    PRINTED,
    STATED,
    TO_PRINTED,
    Setup,
    to_table,
)
from loopcal.papers.published import (
    Cell,
    Comparison,
    Figure,
    PaperText,
    Printed,
    Series,
    Table,
    Verdict,
)
from loopcal.papers.reproduction import Content
from loopcal.typing import FloatArray

ITERATIONS = 5
"""Shown in figure 4."""

TEXT = PaperText(__file__)


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged."""

    setup: Setup  # the machine of Tables 2 and 3
    # "exact": without noise; "frozen": the same with one matrix; "presumed", "stated": with noise
    runs: Mapping[str, steps.Iterations]
    levels: Mapping[tuple[float, float], steps.Level]  # by limits of the noise
    methods: Mapping[str, steps.MethodResult]
    poses: list[tuple[Cell, ...]]
    orders: tuple[steps.Order, ...]  # the best first
    outliers: steps.Outliers
    rounding: Mapping[str, tuple[int | None, float]]
    comparisons: Mapping[str, Comparison]  # by name of the table
    sizes: FloatArray  # (4,) of Tables 5 and 6, see `Level`
    explained: FloatArray  # (6,) share of the residuals of Table 6 that parameters explain
    noise: FloatArray  # (n, 6) [m, rad] that Tables 5 and 6 imply


def compute(seed: int, trials: int, progress: Callable[[str], None]) -> Results:
    """Compute everything."""
    threshold, used = find_rule()
    setup, measured = steps.make_setup(), PRINTED.table("table_4", "PP")
    progress("the ten steps")
    noisy = {
        name: steps.draw_measured_poses(setup, steps.to_si(limits), seed)
        for name, limits in (("presumed", PRESUMED), ("stated", STATED))
    }
    runs = {
        "exact": steps.iterate(setup, setup.actual, ITERATIONS),
        "frozen": steps.iterate(setup, setup.actual, ITERATIONS, is_renewed=False),
        **{name: steps.iterate(setup, poses, ITERATIONS) for name, poses in noisy.items()},
    }
    progress("Euler orders and outliers of Table 4")
    good = np.array([label != ODD_POSE for label in measured.labels])
    poses = measured.values / TO_PRINTED
    orders = steps.rank_euler_orders(setup, setup.poses[good], poses[good])
    outliers = steps.search_outliers(setup, measured)
    rounding = steps.calibrate_from_print(setup, measured)
    progress("levels of noise")
    levels = steps.sweep_noise(setup, used, threshold, seed, trials)
    progress("methods and numbers of poses")
    residuals = PRINTED.table("table_6", "after").values / TO_PRINTED
    residual = PRINTED.table("table_6", "after").values * steps.TO_SI
    parameters = PRINTED.table("table_5", "after").values * 1e-3
    parts = (residual[:, :3] / MM, residual[:, 3:], parameters)
    rms = [steps.compute_rms(part) for part in parts]
    return Results(
        setup=setup,
        runs=runs,
        levels=levels,
        methods=steps.compare_methods(setup, seed, trials),
        poses=steps.compare_poses(setup, threshold, seed, trials),
        orders=orders,
        outliers=outliers,
        rounding=rounding,
        comparisons={c.name: c for c in compare_tables(setup, runs["exact"], runs["presumed"])},
        sizes=np.array([*rms, steps.integrate_errors(residual[None])[0]]),
        explained=steps.compute_explained_share(setup, residuals),
        noise=steps.recover_noise(setup),
    )


def find_rule() -> tuple[float, int]:
    """Return max dQint [mm + rad] at which the paper's iteration ends, and its iterations."""
    return PRINTED.number("threshold", "value"), int(PRINTED.find("iterations", "value"))


def present(results: Results) -> Content:
    """Return the results as tables, verdicts and figures."""
    figures = (_draw_figure_4(results), _draw_noise(results))
    verdicts = judge_claims(results)
    return Content(tuple(results.comparisons.values()), make_tables(results), verdicts, figures)


def compare_tables(
    setup: Setup, exact: steps.Iterations, noisy: steps.Iterations
) -> tuple[Comparison, ...]:
    """Return Tables 2 to 6, printed beside computed."""
    used = find_rule()[1]
    robot, measured = setup.robot, PRINTED.table("table_4", "PP")
    errors = noisy.compute_parameter_errors(setup.truth)
    before, after = to_table(robot, errors[0]) / MM, to_table(robot, errors[used]) / (1e-3 * MM)
    first = (setup.actual - setup.poses) * TO_PRINTED
    identified = to_table(robot, exact.machines[used + 1].values - robot.values) / MM
    odd = measured.labels.index(ODD_POSE)
    odd_row = steps.make_setup(leg_lengths=False).actual[odd : odd + 1] * TO_PRINTED
    printed_row = Printed({ODD_POSE: measured.rows[ODD_POSE]})
    noise, six = _describe_noise(PRESUMED), PRINTED.table("table_6", "before")
    compare, printed = TEXT.compare, PRINTED.table
    return (
        compare("table_2", printed("table_2"), make_symmetric(setup)),
        compare("table_3", printed("table_3"), identified, iterations=used + 1),
        _compare_table_4(setup),
        compare("table_4_a2", printed_row, odd_row),
        compare("table_5_before", printed("table_5", "before"), before),
        compare("table_5_after", printed("table_5", "after"), after, noise=noise),
        compare("table_6_before", six, first, np.maximum(six.unit, measured.unit)),
        compare("table_6_after", printed("table_6", "after"), noisy.pose_errors[used] * TO_PRINTED,
                noise=noise),
    )  # fmt: skip


def make_symmetric(setup: Setup) -> FloatArray:
    """Return Table 2 (6, 7) [mm] of a hexapod with threefold symmetry, from its first two legs."""
    robot, printed = setup.robot, PRINTED.table("table_2").values
    table = printed.copy()
    for leg, (source, angle) in enumerate(((0, 0), (1, 0), (0, 120), (1, 120), (0, 240), (1, 240))):
        turn = geometry.rotation_about_axis(np.deg2rad(angle), 2)
        for part in (slice(0, 3), slice(4, 7)):
            table[leg, part] = turn @ printed[source, part]
    place = steps.PARAMETERS.index("length")
    length = to_table(robot, robot.values)[:, place] + inverse(robot, robot.home[None]).q[0]
    table[:, place] = length / MM
    return table


def _compare_table_4(setup: Setup) -> Comparison:
    """Return nominal poses, actual poses and their differences beside the computed ones. A
    difference is no finer than the poses it was taken from.
    """
    printed = {name: PRINTED.table("table_4", name) for name in ("PT", "PP", "E1")}
    computed = {"PT": setup.poses, "PP": setup.actual, "E1": setup.actual - setup.poses}
    units = {name: block.unit for name, block in printed.items()}
    units["E1"] = np.maximum(units["E1"], units["PP"])
    order = [(i, row, name) for i, row in enumerate(printed["PT"].labels) for name in printed]
    texts = {f"{row} {name}": printed[name].rows[row] for _, row, name in order}
    numbers = np.array([computed[name][i] for i, _, name in order]) * TO_PRINTED
    yardstick = np.array([units[name][i] for i, _, name in order])
    return TEXT.compare("table_4", Printed(texts), numbers, yardstick, row=ODD_POSE)


def make_tables(results: Results) -> tuple[Table, ...]:
    """Return the tables beyond those of the paper."""
    threshold, used = find_rule()
    runs, trials = results.runs.values(), len(results.levels[STATED].needed)
    figure_4 = [(str(k), *(run.integrated[k] for run in runs)) for k in range(ITERATIONS + 1)]
    needed = ("iterations needed", *(run.count_needed(threshold) for run in runs))
    stated = steps.write_rotation(PRINTED.find("rotation", "order"))
    low, high = steps.RANGES[steps.WIDE]
    outliers = [
        (o.label, o.chi_square, o.degrees, o.p_value, o.drop, o.label in results.outliers.labels)
        for o in results.outliers.first
    ]
    methods = [(name, m.parameters, m.narrow, m.wide) for name, m in results.methods.items()]
    return (
        TEXT.table("figure_4", [*figure_4, needed], threshold=threshold, iterations=used,
                   presumed=_describe_noise(PRESUMED), stated=_describe_noise(STATED)),
        TEXT.table("conditions", [(f"leg {i}", value)
                                  for i, value in enumerate(results.runs["exact"].conditions, 1)]),
        TEXT.table("euler_orders", [(o.formula, i, o.position, o.rotation, o.formula == stated)
                                    for i, o in enumerate(results.orders, 1)]),
        TEXT.table("outliers", outliers, largest=max(fit.drop for fit in results.outliers.last)),
        TEXT.table("rounding", [(name, *row) for name, row in results.rounding.items()],
                   rotation=steps.write_rotation(steps.ORDER)),
        TEXT.table("noise", _list_levels(results), iterations=used),
        TEXT.table("methods", methods, limits=STATED, trials=trials, unmeasured=steps.UNMEASURED),
        TEXT.table("poses", results.poses, trials=trials, low=low, high=high,
                   before=_compute_initial_error(results)),
    )  # fmt: skip


def _list_levels(results: Results) -> list[tuple[Cell, ...]]:
    """Return table rows of the levels of noise, with the published sizes in the first one."""
    rows: list[tuple[Cell, ...]] = [
        ("published, Tables 5 and 6", None, None, *results.sizes, None, None)
    ]
    for limits, level in results.levels.items():
        met = f"{np.isfinite(level.needed).sum()} of {len(level.needed)}"
        inside = bool(level.contains(results.sizes).all())
        rows.append(("computed, median", *limits, *level.median, met, inside))
    return rows


def _compute_initial_error(results: Results) -> float:
    """Return the rms parameter error [mm] of the machine as designed."""
    return steps.compute_rms((results.setup.robot.values - results.setup.truth.values) / MM)


def _describe_noise(limits: tuple[float, float]) -> str:
    return f"noise within +-{limits[0]:g} mm, +-{limits[1]:g} rad"


def _draw_figure_4(results: Results) -> Figure:
    """Return max dQint by iteration."""
    threshold, used = find_rule()
    labels = ("without noise", "without noise, one matrix throughout", _describe_noise(PRESUMED),
              _describe_noise(STATED))  # fmt: skip
    lines = [
        Series.of(label, range(ITERATIONS + 1), run.integrated)
        for label, run in zip(labels, results.runs.values(), strict=True)
    ]
    levels = {f"published rule {threshold:g}": threshold}
    return TEXT.figure("figure_4", lines, levels, threshold=threshold, iterations=used)


def _draw_noise(results: Results) -> Figure:
    """Return the sizes after calibration by noise, with 1e-3 rad of angle noise per mm."""
    chosen = sorted(x for x in results.levels if np.isclose(x[1], 1e-3 * x[0], atol=0.0))
    levels, sizes = [results.levels[limits] for limits in chosen], results.sizes
    places = {"parameter error rms [mm]": (2, 5), "pose residual rms [mm]": (0, 6)}
    lines = [
        Series.of(label, [limits[0] for limits in chosen], [level.median[i] for level in levels])
        for label, (i, _) in places.items()
    ]
    marks = {f"published, Table {number}": float(sizes[i]) for i, number in places.values()}
    marks["before calibration"] = _compute_initial_error(results)
    data = {
        "trials": len(levels[0].needed),
        "iterations": find_rule()[1],
        "noise": PRINTED.number("noise", "value"),
    }
    return TEXT.figure("noise", lines, marks, **data)


def judge_claims(results: Results) -> tuple[Verdict, ...]:
    """Return a verdict for each claim."""
    used = find_rule()[1]
    second, third = (results.comparisons[name] for name in ("table_2", "table_3"))
    return (
        TEXT.claim("symmetric").judge(table=second),
        TEXT.claim("converges").judge(table=third, iterations=used + 1),
        *_judge_table_4(results),
        *_judge_noise(results),
        *_judge_methods(results),
    )


def _judge_table_4(results: Results) -> tuple[Verdict, ...]:
    best, second = results.orders[:2]
    printed = steps.write_rotation(PRINTED.find("rotation", "order"))
    stated = next(order for order in results.orders if order.formula == printed)
    fourth = results.comparisons["table_4"]
    labels = fourth.published.labels
    is_actual = np.array([not label.endswith("PT") for label in labels])
    is_odd = np.array([label.startswith(f"{ODD_POSE} ") for label in labels])
    good, bad = fourth.within[is_actual & ~is_odd], fourth.within[is_actual & is_odd]
    without = next(fit for fit in results.outliers.first if fit.label == ODD_POSE)
    noise_rms = PRINTED.number("noise", "value") / np.sqrt(3.0)
    short = ("before", "as printed", "row corrected", "without row", "in full", "weighted", "prior")
    errors = dict(zip(short, (error for _, error in results.rounding.values()), strict=True))
    return (
        TEXT.claim("rotation").judge(
            printed=printed, count=len(results.orders), best=best, second=second, stated=stated
        ),
        TEXT.claim("table_4").judge(row=ODD_POSE, agreeing=int(good.sum()), count=good.size),
        TEXT.claim("odd_row").judge(
            row=ODD_POSE, differing=int((~bad).sum()), count=bad.size, without=without,
            odd=results.comparisons["table_4_a2"], named=results.outliers.labels or ("no pose",),
        ),
        TEXT.claim("table_4_noise").judge(best=best, stated=noise_rms, limit=noise_rms / 3.0),
        TEXT.claim("rounding").judge(row=ODD_POSE, errors=errors),
    )  # fmt: skip


def _judge_noise(results: Results) -> tuple[Verdict, ...]:
    """Judge the stopping rule, and the origin of Tables 5 and 6."""
    threshold, used = find_rule()
    exact, frozen = results.runs["exact"], results.runs["frozen"]
    stated, sizes = results.levels[STATED], results.sizes
    holding = [
        f"+-{limits[0]:g} mm with +-{limits[1]:g} rad"
        for limits, level in results.levels.items()
        if level.contains(sizes).all()
    ]
    explained, before = 100.0 * results.explained, results.comparisons["table_6_before"]
    is_good = np.array([label != ODD_POSE for label in before.published.labels])
    as_rad, as_mrad = (
        int(before.agrees_with(factor * before.computed)[is_good, 3:].sum())
        for factor in (1.0, 1e3)
    )
    noise = results.noise * TO_PRINTED
    mean, scatter = noise.mean(axis=0), noise.std(axis=0, ddof=1)
    lengths, angles = (", ".join(f"{x:.1e}" for x in part) for part in (mean[:3], mean[3:]))
    return (
        TEXT.claim("threshold").judge(
            threshold=threshold, iterations=used, exact=exact.integrated, frozen=frozen.integrated,
            needed=[run.count_needed(threshold) for run in (exact, frozen)],
        ),
        TEXT.claim("threshold_noise").judge(
            noise=PRINTED.number("noise", "value"), met=int(np.isfinite(stated.needed).sum()),
            count=len(stated.needed), median=stated.median[3], angle=STATED[1],
        ),
        TEXT.claim("noise_size").judge(
            inside=int(stated.contains(sizes).sum()), sizes=len(sizes), printed=sizes,
            noise=PRINTED.number("noise", "value"), holding=holding, stated=stated.median,
        ),
        TEXT.claim("residuals").judge(
            least=explained.min(), most=explained.max(), random=100.0 * np.sqrt(0.7)
        ),
        TEXT.claim("milliradians").judge(
            as_rad=as_rad, as_mrad=as_mrad, count=3 * int(is_good.sum()), row=ODD_POSE
        ),
        TEXT.claim("mean_noise").judge(
            offset=(np.abs(mean) * np.sqrt(len(noise)) / scatter).max(), lengths=lengths,
            angles=angles, scatter_mm=scatter[:3].max(), scatter_rad=scatter[3:].max(),
            limit=PRESUMED[0], limit_sd=PRESUMED[0] / np.sqrt(3.0),
        ),
    )  # fmt: skip


def _judge_methods(results: Results) -> tuple[Verdict, ...]:
    methods = dict(
        zip(("before", "alone", "together", "prior"), results.methods.values(), strict=True)
    )
    alone = methods["alone"].parameters
    seven, ten = results.poses[0], next(row for row in results.poses if row[0] == steps.PAPERS_TEN)
    smaller, used = {}, find_rule()[1]
    for name in ("stated", "presumed"):
        errors = np.abs(results.runs[name].compute_parameter_errors(results.setup.truth))
        smaller[f"smaller_{name}"] = int((errors[used] < errors[0]).sum())
    return (
        TEXT.claim("parameters_improve").judge(
            ratio=alone / methods["before"].parameters, presumed=PRESUMED, **smaller, **methods
        ),
        TEXT.claim("positions_improve").judge(**methods),
        TEXT.claim("leg_by_leg").judge(ratio=alone / methods["together"].parameters, **methods),
        TEXT.claim("seven_poses").judge(
            iterations=seven[2], error=seven[3], seven=seven[4], ten=ten[4]
        ),
    )
