# SPDX-License-Identifier: Apache-2.0
"""The whole study: choose points, draw machines, calibrate, and judge the claims."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.papers.cmm_constraint_2011 import steps
from loopcal.papers.cmm_constraint_2011.steps import (
    ABSOLUTE,
    ALIGNED,
    AT_NOMINAL,
    BEFORE,
    LS,
    METHODS,
    MM,
    NOISE,
    PRINTED,
    PRIOR,
    SET,
    Draw,
)
from loopcal.papers.published import Comparison, Figure, PaperText, Printed, Series, Table, Verdict
from loopcal.papers.reproduction import Content
from loopcal.typing import FloatArray

TEXT = PaperText(__file__)
DRAWS, SEED_STEP = 5, 10
"""Times that points, machines and noise are drawn, and from the seed of one draw to that of the
next: each uses a few of the seeds between.
"""
SURE = 0.1
"""A ratio of two medians of some fifty machines, minus one, that is not significant."""
POSITION_ALIGNED = "position, aligned [mm]"
NO_GAUGE = "parameters without gauge [mm]"
WEIGHTS = ("as printed: weight one", "divided by |d_1|", "divided by the sd of each",
           "full covariance")  # fmt: skip
MOTIONS = (
    "the end point moves along it",
    "the end point rotates about it, the base's origin fixed",
    "the end point stays; the platform rotates about it",
)


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged."""

    study: steps.Study  # the ten groups
    draws: tuple[Draw, ...]  # tables and figures show the first
    arrangements: tuple[steps.Arrangement, steps.Arrangement, steps.Arrangement]  # TEN, ONE and ANY
    candidates: tuple[steps.Candidate, ...]  # interpretations
    forms: tuple[steps.FormRow, ...]  # surfaces as unknowns, the hardest first
    covariance: float  # largest relative difference of a variance of both forms
    ranks: tuple[steps.GroupRank, ...]  # of random groups
    pair: tuple[int, int]  # points of a group and rank of the equations of all its pairs
    gauge_effects: FloatArray  # (9,) of the directions of GAUGE_NAMES on the rows
    table_4: Mapping[str, steps.Stated]  # factors as printed
    conclusion: Mapping[str, str]  # of root mean squares, as printed

    @property
    def cells(self) -> Mapping[tuple[str, str], steps.Cell]:
        """Table 3 of the first draw."""
        return self.draws[0].cells

    @property
    def trials(self) -> int:
        """Machines of each cell."""
        return len(self.draws[0].ten.cell.iterations)


def compute(
    seed: int, trials: int, progress: Callable[[str], None], draws: int = DRAWS,
    sweeps: tuple[int, int] = (steps.SWEEPS, 1),
) -> Results:  # fmt: skip
    """Compute everything.

    Parameters
    ----------
    draws : of points, machines and noise. sweeps : of the coordinate exchange, on ten planes as in
        the paper and for the other arrangements.
    """
    progress("coordinate exchange, ten planes")
    study = steps.plan_points(seed=seed, sweeps=sweeps[0])
    drawn = [steps.compute_draw(study, seed, trials, progress)]
    progress("one plane and one line")
    one = steps.plan_points(1, steps.GROUPS * steps.POINTS, seed=seed, sweeps=sweeps[1])
    progress("planes of any axis")
    free = steps.plan_points(axes=("x", "y", "z"), seed=seed, sweeps=sweeps[1])
    one_plane, any_axis = (
        steps.evaluate_arrangement(name, s, seed, trials)
        for name, s in ((steps.ONE, one), (steps.ANY, free))
    )
    progress("interpretations of figure 5")
    candidates = steps.rank_candidates((drawn[0].ten, one_plane), seed, trials)
    progress("both forms")
    forms = steps.compare_forms(study, seed, trials)
    for i in range(1, draws):
        other = seed + SEED_STEP * i
        points = steps.plan_points(seed=other, sweeps=sweeps[0])
        label = f"draw {i + 1} of {draws}"
        drawn.append(
            steps.compute_draw(points, other, trials, lambda s, n=label: progress(f"{n}: {s}"))
        )
    return Results(
        study=study,
        draws=tuple(drawn),
        arrangements=(drawn[0].ten, one_plane, any_axis),
        candidates=candidates,
        forms=forms,
        covariance=steps.compare_covariances(study.layout, min(steps.NOISES)),
        ranks=steps.compute_ranks(study, seed),
        pair=steps.compute_pair_rank(study),
        gauge_effects=steps.compute_gauge_effects(study),
        table_4={name: steps.Stated(**given) for name, given in PRINTED.find("table_4").items()},
        conclusion=PRINTED.find("conclusion"),
    )


def present(results: Results) -> Content:
    """Return the results as tables, verdicts and figures."""
    figures = (_draw_figure_4(results), _draw_figure_5(results), _draw_table_3(results))
    return Content(_compare_tables(results), make_tables(results), judge_claims(results), figures)


def _compare_tables(results: Results) -> tuple[Comparison, Comparison]:
    """Return the stated counts beside the computed ones, and figure 5 beside the nearest
    interpretation.
    """
    counts = Printed.parse({
        "parameters identified": PRINTED.find("parameters"),
        "iterations for 50 points, at most": "5",
    })  # fmt: skip
    rank = max(r.rank for r in results.ranks)
    iterations = max(f.most_iterations for f in results.draws[0].fifties)
    figure, nearest = PRINTED.find("figure_5"), results.candidates[0]
    stated = Printed.parse({name: given["stated"] for name, given in figure.items()})
    order = {"estimation": 0, "position": 1, "orientation": 2}
    reductions = np.array([[nearest.reductions[order[name]]] for name in figure])
    return (
        TEXT.compare("counts", counts, np.array([[float(rank)], [float(iterations)]])),
        TEXT.compare("figure_5", stated, reductions, nearest=nearest),
    )


def make_tables(results: Results) -> tuple[Table, ...]:
    """Return all tables of the reproduction."""
    ranks = [(r.groups, r.points, r.rows, r.rank, r.singular_values[r.rank - 1], r.unused)
             for r in results.ranks]  # fmt: skip
    effects = zip(steps.GAUGE_NAMES, results.gauge_effects, strict=True)
    gauge = [(name, MOTIONS[i // 3], effect) for i, (name, effect) in enumerate(effects)]
    printed = ("as printed", "", "", "", *steps.list_printed(), None)
    candidates = [(c.name, c.reading, c.truth, c.frame, *c.reductions, c.distance)
                  for c in results.candidates]  # fmt: skip
    arrangements = [
        (a.name, a.study.layout.equations, a.drawn, a.optimized, a.gain,
         *(a.cell.compute_median(m, POSITION_ALIGNED) for m in (LS, PRIOR)))
        for a in results.arrangements
    ]  # fmt: skip
    weights = [
        (name, *(c.compute_median(m, e) for m in (LS, PRIOR) for e in (POSITION_ALIGNED, NO_GAUGE)))
        for name, c in zip(WEIGHTS, results.draws[0].weights.values(), strict=True)
    ]
    forms = [
        (row.noise / MM, row.method, f"{row.converged} of {row.machines}", row.iterations,
         ", ".join(map(str, row.ranks)), row.median, row.largest)
        for row in results.forms
    ]  # fmt: skip
    measures = (POSITION_ALIGNED, "orientation, aligned [deg]", NO_GAUGE)
    absolute = ("position [mm]", "orientation [deg]", "parameters [mm]",
                "position, gauge at nominal [mm]")  # fmt: skip
    return (
        _list_given(results.study),
        TEXT.table("ranks", ranks),
        TEXT.table("gauge", gauge),
        _list_table_3(results, "table_3", measures),
        _list_table_3(results, "table_3_absolute", absolute),
        TEXT.table("figure_5_readings", [printed, *candidates]),
        TEXT.table("arrangements", arrangements, trials=results.trials),
        TEXT.table("weights", weights),
        _list_fifty(results),
        TEXT.table("forms", forms, errors=steps.ERRORS / MM, covariance=results.covariance),
        _list_arithmetic(results),
    )


def _list_given(study: steps.Study) -> Table:
    rows = [("robot", f"{steps.ROBOT}, 42 parameters, nominal geometry of Nategh and Agheli 2009")]
    for name, (low, high) in study.robot.assembly.workspace.items():
        scale, unit = (np.pi / 180.0, "deg") if name in {"roll", "pitch", "yaw"} else (MM, "mm")
        rows.append((f"workspace, {name}", f"{low / scale:.4g} to {high / scale:.4g} {unit}"))
    groups, points = study.layout.groups, study.layout.points
    each = f"{groups} planes of equal z, {points // groups} points each with their line"
    history = ", ".join(f"{v:.1f}" for v in study.optimized.history)
    exchange = f"log det {history} [tolerance 1 mm, noise 1 mm]"
    return TEXT.table("given", [*rows, ("points", each), ("coordinate exchange", exchange)])


def _list_table_3(results: Results, name: str, measures: tuple[str, ...]) -> Table:
    methods = (BEFORE, LS, PRIOR)
    rows = [
        (*key, *(c.compute_median(m, measure) for measure in measures for m in methods),
         *(c.count_worse(m, measures[0]) for m in (LS, PRIOR)))
        for key, c in results.cells.items()
    ]  # fmt: skip
    failed = sum(c.failed for c in results.cells.values())
    more = [(f"{measure}, {m}", ".2g") for measure in measures for m in methods]
    more += [(f"{m} worse than before", "d") for m in (LS, PRIOR)]
    return TEXT.table(name, rows, "", more, trials=results.trials, failed=failed)


def _list_fifty(results: Results) -> Table:
    rows, fifties = [], results.draws[0].fifties
    for fifty in fifties:
        plural = "plane, one line" if fifty.groups == 1 else "planes, a line each"
        rows += [
            (f"{fifty.groups} {plural}", frame, method, *fifty.compute_median(method, frame))
            for method, frame in fifty.statistics
        ]
    failed = sum(int((~c).sum()) for fifty in fifties for c in fifty.converged.values())
    noise = PRINTED.number("accuracy", "accuracy") * MM / MM
    return TEXT.table("table_4", rows, trials=results.trials, noise=noise, failed=failed)


def _list_arithmetic(results: Results) -> Table:
    rows: list[tuple[Any, ...]] = []
    for name, given in results.table_4.items():
        low, high = given.possible
        numbers = (given.before, given.after, given.stated, given.factor)
        follows = given.excess == 0.0
        rows.append((f"Table 4, {name}", *numbers, f"{low:.2f} to {high:.2f}", follows))
    for name in ("position", "orientation"):
        given = steps.Stated(**PRINTED.find("figure_5", name))
        follows = abs(given.reduction - float(given.stated)) <= 0.5
        numbers = (given.before, given.after, given.stated, given.reduction)
        rows.append((f"Figure 5, {name} [%]", *numbers, None, follows))
    return TEXT.table("arithmetic", rows)


def _draw_figure_4(results: Results) -> Figure:
    """Return pose error over parameter error, both after / before, so that growth has a place."""
    frames = {"": ("parameters [mm]", "position [mm]"), ", aligned": (NO_GAUGE, POSITION_ALIGNED)}
    lines = []
    for frame, measures in frames.items():
        for method in METHODS:
            both = sorted(
                tuple(c.compute_median(method, m) / c.compute_median(BEFORE, m) for m in measures)
                for c in results.cells.values()
            )
            lines.append(Series.of(f"{method}{frame}", *zip(*both, strict=True)))
    return TEXT.figure("figure_4", lines, joined=False, count=len(results.cells))


def _draw_figure_5(results: Results) -> Figure:
    """Return position errors of single poses of the first machine, before and after."""
    study, made = results.study, results.cells[f"{SET:g}", f"{NOISE:g}"]
    true, sizes = study.held_out.solve(made.truth[:1]), {}
    for name in (BEFORE, *METHODS):
        T = study.held_out.solve(made.values.get(name, study.robot.parameters.nominal[None])[:1])
        for frame in (ABSOLUTE, ALIGNED):
            twists = study.held_out.compute_twists(T, true, frame)[0]
            label = name if frame == ABSOLUTE else f"{name}, {frame}"
            sizes[label] = np.linalg.norm(twists[:, 3:], axis=1) / MM
    order = np.argsort(sizes[BEFORE])
    x = range(1, len(order) + 1)
    lines = [Series.of(label, x, size[order]) for label, size in sizes.items()]
    count = len(order)
    return TEXT.figure("figure_5", lines, joined=False, errors=SET, noise=NOISE, count=count)


def _draw_table_3(results: Results) -> Figure:
    """Return the position error by noise, for each set of errors."""
    lines, levels = [], {}
    for given in PRINTED.find("sets").split():
        cells = [c for (of_set, _), c in results.cells.items() if of_set == given]
        before = cells[0].compute_median(BEFORE, POSITION_ALIGNED)
        levels[f"before, errors of {given} mm"] = before
        for method in (LS, PRIOR):
            y = [c.compute_median(method, POSITION_ALIGNED) for c in cells]
            x = [c.noise / MM for c in cells]
            lines.append(Series.of(f"{method}, errors of {given} mm", x, y))
    return TEXT.figure("table_3", lines, levels, trials=results.trials)


def judge_claims(results: Results) -> tuple[Verdict, ...]:
    """Return a verdict for each claim."""
    return (
        *_judge_equations(results),
        *_judge_table_3(results),
        *_judge_figure_5(results),
        *_judge_points(results),
        *_judge_arithmetic(results),
        *_judge_methods(results),
        *_judge_forms(results),
    )


def _judge_equations(results: Results) -> tuple[Verdict, ...]:
    points, rank = results.pair
    ranks, groups = sorted({r.rank for r in results.ranks}), [r.groups for r in results.ranks]
    unused = max((r.unused or 0.0) / r.singular_values[0] for r in results.ranks)
    return (
        TEXT.claim("independent").judge(effect=results.gauge_effects[:6].max()),
        TEXT.claim("counted").judge(points=points, rank=rank, missing=points - rank),
        TEXT.claim("least_squares").judge(
            least=ranks[0], parameters=int(PRINTED.find("parameters")), ranks=ranks,
            fewest=min(groups), most=max(groups), largest=unused,
        ),
    )  # fmt: skip


def _judge_table_3(results: Results) -> tuple[Verdict, ...]:
    from scipy.stats import beta

    draws, cells = results.draws, results.cells
    shares, place = [], steps.MEASURES.index("parameters [mm]")
    for draw in draws:  # by how much the parameter errors decrease with the least noise
        quiet = draw.cells["1", "0.0001"]
        left = (quiet.errors[LS] / quiet.errors[BEFORE])[quiet.converged[LS], place]
        mean = 100.0 * (1.0 - left.mean()) if len(left) else np.nan
        reached = int((left <= 0.25).sum())
        shares.append({"mean": mean, "reached": reached, "count": len(left)})
    better = [_compare_with_before(draw) for draw in draws]
    ranks = [
        {m: steps.compute_rank_correlation(draw.cells.values(), m) for m in METHODS}
        for draw in draws
    ]
    cell = cells["1", "0.01"]
    return (
        TEXT.claim("three_quarters").judge(
            shares, noise=cells["1", "0.0001"].noise / MM,
            chance=100.0 * float(beta.cdf(0.25**2, 4.5, 16.5)), **shares[0],
        ),
        TEXT.claim("better").judge(better, count=len(cells), **better[0]),
        TEXT.claim("correlation").judge(
            [{"ranks": r} for r in ranks], count=len(cells),
            ratios=len({c.ratio for c in cells.values()}), ranks=ranks[0],
            least={m: min(r[m] for r in ranks) for m in METHODS},
            parameters=cell.compute_reduction(LS, "parameters [mm]"),
            position=cell.compute_reduction(LS, "position [mm]"),
            aligned=cell.compute_reduction(LS, POSITION_ALIGNED),
        ),
    )  # fmt: skip


def _list_medians(draw: Draw) -> dict[tuple[str, str], list[float]]:
    """Return the median position errors of each cell, before and by LS and MAP."""
    return {
        key: [c.compute_median(m, POSITION_ALIGNED) for m in (BEFORE, LS, PRIOR)]
        for key, c in draw.cells.items()
    }


def _compare_with_before(draw: Draw) -> dict[str, Any]:
    """Return in which cells least squares reduces the median position error."""
    medians = _list_medians(draw)
    worse = [f"errors {s} mm with noise {n} mm" for (s, n), (before, ls, _) in medians.items()
             if not ls <= before]  # fmt: skip
    ratio = np.median([medians[key][1] * MM / c.noise for key, c in draw.cells.items()])
    return {"better": len(medians) - len(worse), "worse": worse or ["none"], "ratio": ratio}


def _judge_figure_5(results: Results) -> tuple[Verdict, ...]:
    ranked = sorted(results.candidates, key=lambda candidate: candidate.distance)
    deviation, variance = (
        next(c for c in ranked if c.reading == reading) for reading in (steps.SD, steps.VARIANCE)
    )
    literal = next(c for c in ranked if c.truth == "all 42" and c.frame == "absolute")
    texts = [[f"{a:.0f} %" for a in c.reductions] for c in (deviation, variance, literal)]
    return (
        TEXT.claim("variances").judge(
            deviation=deviation, variance=variance, deviations=texts[0], variances=texts[1],
            given=NOISE, root=np.sqrt(NOISE),
        ),
        TEXT.claim("figure_5").judge(literal=literal, reductions=texts[2], nearest=ranked[0]),
    )  # fmt: skip


def _judge_points(results: Results) -> tuple[Verdict, ...]:
    """Judge the exchange, the number of planes, and fifty points."""
    ten, one, free = results.arrangements
    cost_ten, cost_one = (a.cell.compute_median(LS, POSITION_ALIGNED) for a in (ten, one))
    gains = [draw.ten.gain for draw in results.draws]
    one_plane, five_planes = fifties = results.draws[0].fifties
    places = {"ls": (ABSOLUTE, LS), "nominal": (AT_NOMINAL, LS), "aligned": (ALIGNED, LS),
              "prior": (ALIGNED, PRIOR)}  # fmt: skip
    changes = {name: [] for name in places}
    for name, (frame, method) in places.items():
        for fifty in fifties:
            before, after = (fifty.compute_median(m, frame)[0] for m in (BEFORE, method))
            changes[name].append(f"{before:.2g} to {after:.2g} mm")
    falls = [
        bool((fifty.compute_factors(method, frame) > 1.0).all())
        for fifty in fifties for frame in steps.FRAMES for method in METHODS
    ]  # fmt: skip
    factors = ", ".join(f"{f:.1f}" for f in five_planes.compute_factors(PRIOR, ABSOLUTE))
    within = [draw.fifties[0].within_five for draw in results.draws]
    return (
        TEXT.claim("exchange").judge(
            [{"gain": gain} for gain in gains], gain=gains[0], least=min(gains), ten=ten, one=one
        ),
        TEXT.claim("one_plane").judge(
            one=one, ten=ten, free=free, noise=NOISE, cost_one=cost_one, cost_ten=cost_ten,
            limit=1.5 * cost_ten,
        ),
        TEXT.claim("iterations").judge(
            [{"within": share} for share in within], within=within[0], one=one_plane,
            five=five_planes, least=min(within), most=max(within),
        ),
        TEXT.claim("full_poses").judge(
            falling=sum(falls), ways=len(falls), factors=factors,
            stated=", ".join(given.stated for given in results.table_4.values()), **changes,
        ),
    )  # fmt: skip


def _judge_arithmetic(results: Results) -> tuple[Verdict, ...]:
    """Judge the factors of Table 4, and those of root mean squares: rms^2 = mean^2 + sd^2."""
    table, possible = results.table_4, {}
    for name in results.conclusion:
        mean, sd = (table[f"{name}, {what}"] for what in ("mean", "standard deviation"))
        before = steps.bound_rms(mean.before, sd.before)
        after = steps.bound_rms(mean.after, sd.after)
        possible[name] = before[0] / after[1], before[1] / after[0]
    excess = max(steps.compute_excess(results.conclusion[name], possible[name])
                 for name in possible)  # fmt: skip
    return (
        *(TEXT.claim("factor").judge(name=name, given=given) for name, given in table.items()),
        TEXT.claim("conclusion").judge(stated=results.conclusion, possible=possible, excess=excess),
    )


def _judge_methods(results: Results) -> tuple[Verdict, Verdict]:
    """Judge the prior, and the weights of the rows."""
    priors, weights = [], []
    for draw in results.draws:
        medians = _list_medians(draw)
        priors.append(
            {
                "better": sum(prior <= (1.0 + SURE) * ls for _, ls, prior in medians.values()),
                "harmed": sum(not prior <= before for before, _, prior in medians.values()),
                "medians": medians["0.01", "0.1"],
            }
        )
        position = {n: c.compute_median(LS, POSITION_ALIGNED) for n, c in draw.weights.items()}
        weights.append(
            {
                "position": position,
                "limit": (1.0 + SURE) * position["full"],
                "less": {n: 100.0 * (1.0 - position["full"] / p) for n, p in position.items()},
                "nearer": 100.0 * (1.0 - position["distance"] / position["printed"]),
            }
        )
    parameters = {n: c.compute_median(PRIOR, NO_GAUGE) for n, c in results.draws[0].weights.items()}
    less, hardest = [w["less"]["printed"] for w in weights], results.cells["0.01", "0.1"]
    return (
        TEXT.claim("prior").judge(
            priors, sure=100 * SURE, count=len(results.cells), trials=results.trials,
            worse=hardest.count_worse(PRIOR, POSITION_ALIGNED), **priors[0],
        ),
        TEXT.claim("weights").judge(
            weights, parameters=parameters, set=SET, noise=NOISE, lowest=min(less),
            highest=max(less), **weights[0],
        ),
    )  # fmt: skip


def _judge_forms(results: Results) -> tuple[Verdict, Verdict]:
    """Judge the two forms of the equations."""
    forms, (hardest, *others) = results.forms, results.forms
    noises = [row.noise / MM for row in forms]
    loud, calm = (
        max(row.median for row in forms if row.noise / MM == noise)
        for noise in (max(noises), min(noises))
    )
    return (
        TEXT.claim("forms").judge(
            covariance=results.covariance, compared=sum(row.converged for row in forms),
            largest=max((row.largest for row in forms if row.converged), default=np.nan),
            fits=sum(row.machines for row in forms), noise=max(noises), least=min(noises),
            loud=loud, calm=calm,
        ),
        TEXT.claim("converged").judge(
            hardest=hardest, noise=hardest.noise / MM,
            converged=sum(row.converged for row in others),
            fits=sum(row.machines for row in others), most=max(row.iterations for row in forms),
            ranks=sorted({rank for row in forms for rank in row.ranks}),
            noises=[f"{noise:g}" for noise in sorted(set(noises))],
        ),
    )  # fmt: skip
