# SPDX-License-Identifier: Apache-2.0
"""The whole study: compute everything, put it beside the printed tables, judge the claims."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from loopcal import geometry
from loopcal.mechanism.solutions import inverse
from loopcal.papers import published
from loopcal.papers.hexapod_42 import steps
from loopcal.papers.hexapod_42.steps import (
    MM,
    ODD_POSE,
    PRESUMED,
    PRINTED,
    SIZES,
    STATED,
    TO_PRINTED,
    Setup,
    compute_rms,
    find_places,
)
from loopcal.papers.paper import StudyCase
from loopcal.typing import BoolArray, FloatArray

TEXT = published.PaperText(__file__)


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged."""

    setup: Setup  # the machine of Tables 2 and 3
    # "exact": without noise; "frozen": the same with one matrix; "presumed", "stated": with noise
    runs: Mapping[str, steps.Iterations]
    levels: Mapping[str, steps.Level]  # by instrument of study.yaml
    methods: list[published.Row]
    poses: list[published.Row]
    orders: list[published.Row]  # the best first
    outliers: steps.Outliers
    rounding: list[published.Row]
    comparisons: Mapping[str, published.Comparison]  # of Tables 2 to 6, by name
    sizes: FloatArray  # (4,) of Tables 5 and 6, see `Level`
    explained: FloatArray  # (6,) share of the residuals of Table 6 that parameters explain
    noise: FloatArray  # (n, 6) [m, rad] that Tables 5 and 6 imply


def compute(
    seed: int, trials: int, progress: Callable[[str], None], case: StudyCase | None = None
) -> Results:
    """Compute everything."""
    threshold, used = find_rule()
    setup, measured = steps.make_setup(), PRINTED.table("table_4", "PP")
    count, noises = SIZES.find("iterations"), steps.list_noises()
    progress("the ten steps")
    runs = {
        "exact": steps.iterate(setup, setup.actual, count),
        "frozen": steps.iterate(setup, setup.actual, count, is_renewed=False),
    }
    for name, instrument in (("presumed", PRESUMED), ("stated", STATED)):
        drawn = steps.draw_measured_poses(setup, noises[instrument], seed)
        runs[name] = steps.iterate(setup, drawn, count)
    progress("Euler orders and outliers of Table 4")
    good = np.array([label != ODD_POSE for label in measured.labels])
    orders = steps.rank_euler_orders(setup, setup.poses[good], (measured.values / TO_PRINTED)[good])
    outliers = steps.search_outliers(setup, measured)
    rounding = steps.calibrate_from_print(setup, measured)
    progress("levels of noise")
    levels = steps.sweep_noise(setup, used, threshold, seed, trials)
    progress("methods and numbers of poses")
    printed = PRINTED.table("table_6", "after").values
    residual = printed * steps.TO_SI
    parameters = PRINTED.table("table_5", "after").values * 1e-3
    rms = [compute_rms(part) for part in (residual[:, :3] / MM, residual[:, 3:], parameters)]
    twists = steps.to_twists(printed / TO_PRINTED, setup.actual)
    return Results(
        setup=setup,
        runs=runs,
        levels=levels,
        methods=steps.compare_methods(setup, seed, trials),
        poses=steps.compare_poses(setup, threshold, seed, trials),
        orders=orders,
        outliers=outliers,
        rounding=rounding,
        comparisons={c.name: c for c in _compare(setup, runs["exact"], runs["presumed"])},
        sizes=np.array([*rms, steps.integrate_errors(residual[None])[0]]),
        explained=steps.linearize_truth(setup).explain(twists),
        noise=steps.recover_noise(setup),
    )


def find_rule() -> tuple[float, int]:
    """Return max dQint [mm + rad] at which the paper's iteration ends, and its iterations."""
    return PRINTED.number("threshold", "value"), int(PRINTED.find("iterations", "value"))


def compare_tables(results: Results) -> tuple[published.Comparison, ...]:
    """Return Tables 2 to 6, printed beside computed."""
    return tuple(results.comparisons.values())


def _compare(
    setup: Setup, exact: steps.Iterations, noisy: steps.Iterations
) -> tuple[published.Comparison, ...]:
    used = find_rule()[1]
    robot, measured = setup.robot, PRINTED.table("table_4", "PP")
    errors = setup.truth.values - noisy.values
    places = find_places(robot)
    before, after = errors[0][places] / MM, errors[used][places] / (1e-3 * MM)
    first = (setup.actual - setup.poses) * TO_PRINTED
    identified = (exact.values[used + 1] - robot.values)[places] / MM
    odd = measured.labels.index(ODD_POSE)
    odd_row = steps.make_setup(leg_lengths=False).actual[odd : odd + 1] * TO_PRINTED
    printed_row = published.Printed({ODD_POSE: measured.rows[ODD_POSE]})
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
    length = robot.values[find_places(robot)[:, place]] + inverse(robot, robot.home[None]).q[0]
    table[:, place] = length / MM
    return table


def _compare_table_4(setup: Setup) -> published.Comparison:
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
    unit = np.array([units[name][i] for i, _, name in order])
    return TEXT.compare("table_4", published.Printed(texts), numbers, unit, row=ODD_POSE)


def make_tables(results: Results) -> tuple[published.Table, ...]:
    """Return the tables beyond those of the paper."""
    threshold, used = find_rule()
    runs, stated = results.runs.values(), results.levels[STATED]
    trials, (low, high) = len(stated.needed), SIZES.find("ranges", "wide")
    states = zip(*(run.integrated for run in runs), strict=True)
    figure_4 = [(str(k), *sizes) for k, sizes in enumerate(states)]
    figure_4.append(("iterations needed", *(run.count_needed(threshold) for run in runs)))
    formula = steps.write_rotation(PRINTED.find("rotation", "order"))
    orders = [(o["formula"], i, o["position"], o["rotation"], o["formula"] == formula)
              for i, o in enumerate(results.orders, 1)]  # fmt: skip
    conditions = [(f"leg {i}", x) for i, x in enumerate(results.runs["exact"].conditions, 1)]
    labels, first, last = results.outliers
    noise: list[tuple[object, ...]] = [
        ("published, Tables 5 and 6", None, None, *results.sizes, None, None)
    ]
    for level in results.levels.values():
        met = f"{np.isfinite(level.needed).sum()} of {len(level.needed)}"
        inside = bool(level.contains(results.sizes).all())
        noise.append(("computed, median", *level.limits, *level.median, met, inside))
    return (
        TEXT.table("figure_4", figure_4, threshold=threshold, iterations=used,
                   presumed=_describe_noise(PRESUMED), stated=_describe_noise(STATED)),
        TEXT.table("conditions", conditions),
        TEXT.table("euler_orders", orders),
        TEXT.table("outliers", [(*fit.values(), fit["label"] in labels) for fit in first],
                   largest=max(fit["drop"] for fit in last)),
        TEXT.table("rounding", results.rounding, rotation=steps.write_rotation(steps.ORDER)),
        TEXT.table("noise", noise, iterations=used),
        TEXT.table("methods", results.methods, limits=stated.limits, trials=trials,
                   unmeasured=SIZES.find("unmeasured")),
        TEXT.table("poses", results.poses, trials=trials, low=low, high=high,
                   before=results.methods[0]["parameters"]),
    )  # fmt: skip


def _describe_noise(instrument: str) -> str:
    length, angle = steps.list_noises()[instrument]
    return f"noise within +-{length:g} mm, +-{angle:g} rad"


def make_figures(results: Results) -> tuple[published.Figure, ...]:
    """Return all figures."""
    return _draw_figure_4(results), _draw_noise(results)


def _draw_figure_4(results: Results) -> published.Figure:
    """Return max dQint by iteration."""
    threshold, used = find_rule()
    labels = ("without noise", "without noise, one matrix throughout", _describe_noise(PRESUMED),
              _describe_noise(STATED))  # fmt: skip
    lines = [
        published.Series.of(label, range(len(run.integrated)), run.integrated)
        for label, run in zip(labels, results.runs.values(), strict=True)
    ]
    levels = {f"published rule {threshold:g}": threshold}
    return TEXT.figure("figure_4", lines, levels, threshold=threshold, iterations=used)


def _draw_noise(results: Results) -> published.Figure:
    """Return the sizes after calibration by noise, with 1e-3 rad of angle noise per mm."""
    levels = [
        level
        for level in sorted(results.levels.values(), key=lambda level: level.limits)
        if np.isclose(level.limits[1], 1e-3 * level.limits[0], atol=0.0)
    ]
    x, sizes = [level.limits[0] for level in levels], results.sizes
    places = {"parameter error rms [mm]": (2, 5), "pose residual rms [mm]": (0, 6)}
    lines = [
        published.Series.of(label, x, [level.median[i] for level in levels])
        for label, (i, _) in places.items()
    ]
    marks = {f"published, Table {number}": float(sizes[i]) for i, number in places.values()}
    marks["before calibration"] = results.methods[0]["parameters"]
    noise, trials = PRINTED.number("noise", "value"), len(levels[0].needed)
    return TEXT.figure("noise", lines, marks, trials=trials, iterations=find_rule()[1], noise=noise)


def judge_claims(results: Results) -> tuple[published.Verdict, ...]:
    """Return a verdict for each claim."""
    used = find_rule()[1]
    second, third = (results.comparisons[name] for name in ("table_2", "table_3"))
    return (
        TEXT.judge(
            "symmetric", second.within.all(), table=second, differing=_count(~second.within)
        ),
        TEXT.judge("converges", third.within.all(), table=third, iterations=used + 1),
        *_judge_table_4(results),
        *_judge_noise(results),
        *_judge_methods(results),
    )


def _count(values: BoolArray) -> int:
    return int(values.sum())


def _judge_table_4(results: Results) -> tuple[published.Verdict, ...]:
    judge, (best, second, *_) = TEXT.judge, results.orders
    printed = steps.write_rotation(PRINTED.find("rotation", "order"))
    stated = next(order for order in results.orders if order["formula"] == printed)
    fourth = results.comparisons["table_4"]
    labels = fourth.published.labels
    is_actual = np.array([not label.endswith("PT") for label in labels])
    is_odd = np.array([label.startswith(f"{ODD_POSE} ") for label in labels])
    good, bad = fourth.within[is_actual & ~is_odd], fourth.within[is_actual & is_odd]
    without = next(fit for fit in results.outliers.first if fit["label"] == ODD_POSE)
    odd, noise = results.comparisons["table_4_a2"].within, PRINTED.number("noise", "value")
    rms = noise / np.sqrt(3.0)
    short = ("before", "as printed", "row corrected", "without row", "in full", "weighted", "prior")
    errors = {name: row["error"] for name, row in zip(short, results.rounding, strict=True)}
    return (
        judge("rotation", best["formula"] == printed, printed=printed, count=len(results.orders),
              best=best, second=second, stated=stated),
        judge("table_4", good.all(), row=ODD_POSE, agreeing=_count(good), count=good.size),
        judge("odd_row", bad.all(), row=ODD_POSE, differing=_count(~bad), count=bad.size,
              without=without, agreeing_odd=_count(odd), size=odd.size,
              named=results.outliers.labels or ("no pose",)),
        judge("table_4_noise", best["position"] > rms / 3.0, best=best, stated=rms),
        judge("rounding", max(errors[n] for n in short[1:4]) < errors["before"], row=ODD_POSE,
              errors=errors),
    )  # fmt: skip


def _judge_noise(results: Results) -> tuple[published.Verdict, ...]:
    """Judge the stopping rule, and the origin of Tables 5 and 6."""
    threshold, used = find_rule()
    exact, frozen = results.runs["exact"], results.runs["frozen"]
    levels, sizes, limit = results.levels, results.sizes, PRINTED.number("noise", "value")
    stated, judge = levels[STATED], TEXT.judge
    met = np.isfinite(stated.needed)
    holding = [
        "+-{:g} mm with +-{:g} rad".format(*level.limits)
        for level in levels.values() if level.contains(sizes).all()
    ]  # fmt: skip
    explained, before = 100.0 * results.explained, results.comparisons["table_6_before"]
    is_good = np.array([label != ODD_POSE for label in before.published.labels])
    as_rad, as_mrad = (
        _count(before.agrees_with(factor * before.computed)[is_good, 3:]) for factor in (1.0, 1e3)
    )
    noise, presumed = results.noise * TO_PRINTED, levels[PRESUMED].limits[0]
    mean, scatter = noise.mean(axis=0), noise.std(axis=0, ddof=1)
    offset = (np.abs(mean) * np.sqrt(len(noise)) / scatter).max()
    lengths, angles = (", ".join(f"{x:.1e}" for x in part) for part in (mean[:3], mean[3:]))
    return (
        judge("threshold", all(r.count_needed(threshold) == used for r in (exact, frozen)),
              threshold=threshold, iterations=used, exact=exact.integrated,
              frozen=frozen.integrated),
        judge("threshold_noise", met.all(), noise=limit, met=_count(met), count=len(met),
              median=stated.median[3], angle=stated.limits[1]),
        judge("noise_size", stated.contains(sizes).all(), printed=sizes, noise=limit,
              holding=holding, stated=stated.median),
        judge("residuals", explained.max() < 25.0, least=explained.min(), most=explained.max(),
              random=100.0 * np.sqrt(0.7)),
        judge("milliradians", published.decide(as_mrad > as_rad, as_rad > as_mrad), as_rad=as_rad,
              as_mrad=as_mrad, count=3 * _count(is_good), row=ODD_POSE),
        judge("mean_noise", offset < 4.0, offset=offset, lengths=lengths, angles=angles,
              scatter_mm=scatter[:3].max(), scatter_rad=scatter[3:].max(), limit=presumed,
              limit_sd=presumed / np.sqrt(3.0)),
    )  # fmt: skip


def _judge_methods(results: Results) -> tuple[published.Verdict, ...]:
    names = ("before", "alone", "together", "prior")
    methods = dict(zip(names, results.methods, strict=True))
    before, alone, together, _ = results.methods
    seven = results.poses[0]
    ten = next(row for row in results.poses if row["poses"] == steps.PAPERS_TEN)
    smaller, ratio = {}, alone["parameters"] / together["parameters"]
    for name in ("stated", "presumed"):
        errors = np.abs(results.setup.truth.values - results.runs[name].values)
        smaller[f"smaller_{name}"] = _count(errors[find_rule()[1]] < errors[0])
    improved = {place: alone[place] < before[place] for place in before if place != "method"}
    parameters = improved.pop("parameters")
    return (
        TEXT.judge("parameters_improve", parameters, presumed=results.levels[PRESUMED].limits,
                   ratio=alone["parameters"] / before["parameters"], **smaller, **methods),
        TEXT.judge("positions_improve", all(improved.values()), **methods),
        TEXT.judge("leg_by_leg", ratio < 1.1, ratio=ratio, **methods),
        TEXT.judge("seven_poses", seven["left"] < 1e-6, seven=seven, ten=ten),
    )  # fmt: skip


def list_replaced(results: Results) -> tuple[str, ...]:
    """Return sentences on further sizes that another robot replaces."""
    return ()
