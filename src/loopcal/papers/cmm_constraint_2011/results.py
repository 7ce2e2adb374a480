# SPDX-License-Identifier: Apache-2.0
"""The whole study: choose points, draw machines, calibrate, and judge the claims."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.papers import published
from loopcal.papers.cmm_constraint_2011 import steps
from loopcal.papers.cmm_constraint_2011.steps import (
    ABSOLUTE,
    ALIGNED,
    AT_NOMINAL,
    BEFORE,
    LS,
    METHODS,
    MM,
    NO_GAUGE,
    POSITION_ALIGNED,
    PRINTED,
    PRIOR,
    SIZES,
    Cell,
    Draw,
    Stated,
)
from loopcal.papers.paper import StudyCase
from loopcal.typing import FloatArray

TEXT = published.PaperText(__file__)
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
    arrangements: list[published.Row]  # TEN, ONE and ANY
    candidates: list[published.Row]  # interpretations, the nearest first
    forms: list[published.Row]  # surfaces as unknowns, the hardest first
    covariance: float  # largest relative difference of a variance of both forms
    ranks: list[published.Row]  # of random groups
    pair: tuple[int, int]  # points of a group and rank of the equations of all its pairs
    gauge_effects: FloatArray  # (9,) of the directions of GAUGE_NAMES on the rows
    table_4: Mapping[str, Stated]  # factors as printed
    conclusion: Mapping[str, str]  # of root mean squares, as printed

    @property
    def cells(self) -> Mapping[tuple[str, str], Cell]:
        """Table 3 of the first draw."""
        return self.draws[0].cells

    @property
    def trials(self) -> int:
        """Machines of each cell."""
        return len(self.draws[0].weights["full"].iterations)


def compute(
    seed: int, trials: int, progress: Callable[[str], None], case: StudyCase | None = None,
    draws: int = 0, sweeps: tuple[int | None, int] = (None, 1),
) -> Results:  # fmt: skip
    """Compute everything.

    draws : of points, machines and noise, by default those of sizes.yaml. sweeps : of the
    coordinate exchange, on the planes of study.yaml and for the other arrangements.
    """
    progress("coordinate exchange, ten planes")
    study = steps.plan_points(seed=seed, sweeps=sweeps[0])
    drawn = [steps.compute_draw(study, seed, trials, progress)]
    progress("one plane and one line")
    one = steps.plan_points(**SIZES.find("one_plane"), seed=seed, sweeps=sweeps[1])
    progress("planes of any axis")
    free = steps.plan_points(axes=("x", "y", "z"), seed=seed, sweeps=sweeps[1])
    arrangements = [drawn[0].points]
    for name, points in ((steps.ONE, one), (steps.ANY, free)):
        cell = steps.calibrate_figure_5(points, seed, trials)
        arrangements.append(steps.describe_points(name, points, cell))
    progress("interpretations of figure 5")
    candidates = steps.rank_candidates({steps.TEN: study, steps.ONE: one}, seed, trials)
    progress("both forms")
    forms = steps.compare_forms(study, seed, trials)
    draws = draws or SIZES.find("draws")
    for i in range(1, draws):
        other = seed + SIZES.find("seed_step") * i
        points = steps.plan_points(seed=other, sweeps=sweeps[0])
        label = f"draw {i + 1} of {draws}"
        drawn.append(
            steps.compute_draw(points, other, trials, lambda s, n=label: progress(f"{n}: {s}"))
        )
    return Results(
        study=study,
        draws=tuple(drawn),
        arrangements=arrangements,
        candidates=candidates,
        forms=forms,
        covariance=steps.compare_covariances(study.layout, SIZES.find("forms", "noises")[0] * MM),
        ranks=steps.compute_ranks(study, seed),
        pair=steps.compute_pair_rank(study),
        gauge_effects=steps.compute_gauge_effects(study),
        table_4={name: Stated(**given) for name, given in PRINTED.find("table_4").items()},
        conclusion=PRINTED.find("conclusion"),
    )


def compare_tables(results: Results) -> tuple[published.Comparison, published.Comparison]:
    """Return the stated counts beside the computed ones, and figure 5 beside the nearest
    interpretation.
    """
    counts = published.Printed.parse({
        "parameters identified": PRINTED.find("parameters"),
        "iterations for 50 points, at most": "5",
    })  # fmt: skip
    rank = max(row["rank"] for row in results.ranks)
    iterations = max(int(cell.iterations.max()) for cell in results.draws[0].fifties.values())
    figure, nearest = PRINTED.find("figure_5"), results.candidates[0]
    stated = published.Printed.parse({name: given["stated"] for name, given in figure.items()})
    names = ["parameters" if name == "estimation" else name for name in figure]
    reductions = np.array([[nearest[name]] for name in names])
    return (
        TEXT.compare("counts", counts, np.array([[float(rank)], [float(iterations)]])),
        TEXT.compare("figure_5", stated, reductions, nearest=nearest),
    )


def make_tables(results: Results) -> tuple[published.Table, ...]:
    """Return all tables of the reproduction."""
    first, trials = results.draws[0], results.trials
    effects = zip(steps.GAUGE_NAMES, results.gauge_effects, strict=True)
    gauge = [(name, MOTIONS[i // 3], effect) for i, (name, effect) in enumerate(effects)]
    printed = ("as printed", "", "", "", *steps.list_printed(), None)
    weights = [
        (name, *(c.compute_median(m, e) for m in (LS, PRIOR) for e in (POSITION_ALIGNED, NO_GAUGE)))
        for name, c in zip(WEIGHTS, first.weights.values(), strict=True)
    ]
    forms = [
        (row["noise"], row["method"], f"{row['converged']} of {row['machines']}",
         row["iterations"], ", ".join(map(str, row["ranks"])), row["median"], row["largest"])
        for row in results.forms
    ]  # fmt: skip
    fifty = [
        (f"{groups} {'plane, one line' if groups == 1 else 'planes, a line each'}", frame, method,
         *compute_statistics(cell, method, frame))
        for groups, cell in first.fifties.items() for method in (BEFORE, *METHODS)
        for frame in steps.FRAMES
    ]  # fmt: skip
    measures = (POSITION_ALIGNED, "orientation, aligned [deg]", NO_GAUGE)
    absolute = ("position [mm]", "orientation [deg]", "parameters [mm]",
                "position, gauge at nominal [mm]")  # fmt: skip
    return (
        _list_given(results.study),
        TEXT.table("ranks", [tuple(row.values())[:-1] for row in results.ranks]),
        TEXT.table("gauge", gauge),
        _list_table_3(results, "table_3", measures),
        _list_table_3(results, "table_3_absolute", absolute),
        TEXT.table("figure_5_readings", [printed, *results.candidates]),
        TEXT.table("arrangements", results.arrangements, trials=trials),
        TEXT.table("weights", weights),
        TEXT.table("table_4", fifty, trials=trials, noise=PRINTED.number("accuracy", "accuracy"),
                   failed=sum(cell.failed for cell in first.fifties.values())),
        TEXT.table("forms", forms, errors=SIZES.find("forms", "errors"),
                   covariance=results.covariance),
        _list_arithmetic(results),
    )  # fmt: skip


def compute_statistics(cell: Cell, method: str, frame: str) -> FloatArray:
    """Return the medians (4,) of STATISTICS in a frame."""
    return np.array([cell.compute_median(method, f"{s}, {frame}") for s in steps.STATISTICS])


def _list_given(study: steps.Study) -> published.Table:
    rows = [("robot", f"{steps.ROBOT}, 42 parameters, nominal geometry of Nategh and Agheli 2009")]
    for name, (low, high) in study.robot.assembly.workspace.items():
        scale, unit = (np.pi / 180.0, "deg") if name in {"roll", "pitch", "yaw"} else (MM, "mm")
        rows.append((f"workspace, {name}", f"{low / scale:.4g} to {high / scale:.4g} {unit}"))
    groups, points = study.layout.groups, study.layout.points
    each = f"{groups} planes of equal z, {points // groups} points each with their line"
    history = ", ".join(f"{v:.1f}" for v in study.optimized.history)
    exchange = f"log det {history} [tolerance 1 mm, noise 1 mm]"
    return TEXT.table("given", [*rows, ("points", each), ("coordinate exchange", exchange)])


def _list_table_3(results: Results, name: str, measures: tuple[str, ...]) -> published.Table:
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


def _list_arithmetic(results: Results) -> published.Table:
    rows: list[tuple[Any, ...]] = []
    for name, given in results.table_4.items():
        numbers = (given.before, given.after, given.stated, given.factor)
        possible = "{:.2f} to {:.2f}".format(*given.possible)
        rows.append((f"Table 4, {name}", *numbers, possible, given.excess == 0.0))
    for name in ("position", "orientation"):
        given = Stated(**PRINTED.find("figure_5", name))
        follows = abs(given.reduction - float(given.stated)) <= 0.5
        numbers = (given.before, given.after, given.stated, given.reduction)
        rows.append((f"Figure 5, {name} [%]", *numbers, None, follows))
    return TEXT.table("arithmetic", rows)


def make_figures(results: Results) -> tuple[published.Figure, ...]:
    """Return all figures."""
    return _draw_figure_4(results), _draw_figure_5(results), _draw_table_3(results)


def _draw_figure_4(results: Results) -> published.Figure:
    """Return pose error over parameter error, both after / before, so that growth has a place."""
    frames = {"": ("parameters [mm]", "position [mm]"), ", aligned": (NO_GAUGE, POSITION_ALIGNED)}
    lines = []
    for frame, measures in frames.items():
        for method in METHODS:
            both = sorted(
                tuple(c.compute_median(method, m) / c.compute_median(BEFORE, m) for m in measures)
                for c in results.cells.values()
            )
            lines.append(published.Series.of(f"{method}{frame}", *zip(*both, strict=True)))
    return TEXT.figure("figure_4", lines, joined=False, count=len(results.cells))


def _draw_figure_5(results: Results) -> published.Figure:
    """Return position errors of single poses of the first machine, before and after."""
    given, study = SIZES.find("figure_5"), results.study
    made = results.cells[f"{given['errors']:g}", f"{given['noise']:g}"]
    true, sizes = study.solve(made.truth[:1]), {}
    for name in (BEFORE, *METHODS):
        T = study.solve(made.values.get(name, study.robot.parameters.nominal[None])[:1])
        for frame in (ABSOLUTE, ALIGNED):
            twists = study.compute_twists(T, true, frame)[0]
            label = name if frame == ABSOLUTE else f"{name}, {frame}"
            sizes[label] = np.linalg.norm(twists[:, 3:], axis=1) / MM
    order = np.argsort(sizes[BEFORE])
    x = range(1, len(order) + 1)
    lines = [published.Series.of(label, x, size[order]) for label, size in sizes.items()]
    return TEXT.figure("figure_5", lines, joined=False, **given, count=len(order))


def _draw_table_3(results: Results) -> published.Figure:
    """Return the position error by noise, for each set of errors."""
    lines, levels = [], {}
    for given in PRINTED.find("sets").split():
        cells = [c for (of_set, _), c in results.cells.items() if of_set == given]
        before = cells[0].compute_median(BEFORE, POSITION_ALIGNED)
        levels[f"before, errors of {given} mm"] = before
        for method in (LS, PRIOR):
            y = [c.compute_median(method, POSITION_ALIGNED) for c in cells]
            x = [c.noise / MM for c in cells]
            lines.append(published.Series.of(f"{method}, errors of {given} mm", x, y))
    return TEXT.figure("table_3", lines, levels, trials=results.trials)


def judge_claims(results: Results) -> tuple[published.Verdict, ...]:
    """Return a verdict for each claim."""
    groups = (_judge_equations, _judge_table_3, _judge_figure_5, _judge_points, _judge_arithmetic,
              _judge_methods, _judge_forms)  # fmt: skip
    return tuple(verdict for judge in groups for verdict in judge(results))


def _judge_equations(results: Results) -> tuple[published.Verdict, ...]:
    points, rank = results.pair
    effect, parameters = results.gauge_effects[:6].max(), int(PRINTED.find("parameters"))
    ranks = sorted({row["rank"] for row in results.ranks})
    groups = [row["groups"] for row in results.ranks]
    unused = max((row["unused"] or 0.0) / row["largest"] for row in results.ranks)
    missing, judge = points - rank, TEXT.judge
    return (
        judge("independent", effect < 1e-9, effect=effect),
        judge("counted", published.decide(missing == 1, missing != 2), points=points, rank=rank,
              missing=missing),
        judge("least_squares", ranks[0] == parameters, parameters=parameters, ranks=ranks,
              fewest=min(groups), most=max(groups), largest=unused),
    )  # fmt: skip


def _judge_table_3(results: Results) -> tuple[published.Verdict, ...]:
    from scipy.stats import beta

    draws, cells, judge = results.draws, results.cells, TEXT.judge
    shares, better, place = [], [], steps.MEASURES.index("parameters [mm]")
    for draw in draws:  # by how much the parameter errors decrease with the least noise
        quiet = draw.cells["1", "0.0001"]
        left = (quiet.errors[LS] / quiet.errors[BEFORE])[quiet.converged[LS], place]
        mean = 100.0 * (1.0 - left.mean()) if len(left) else np.nan
        shares.append({"mean": mean, "reached": int((left <= 0.25).sum()), "count": len(left)})
        medians = _list_medians(draw)
        worse = [f"errors {s} mm with noise {n} mm" for (s, n), (before, ls, _) in medians.items()
                 if not ls <= before]  # fmt: skip
        ratio = np.median([medians[key][1] * MM / c.noise for key, c in draw.cells.items()])
        number = len(medians) - len(worse)
        better.append({"better": number, "worse": worse or ["none"], "ratio": ratio})
    ranks = [
        {m: steps.compute_rank_correlation(draw.cells.values(), m) for m in METHODS}
        for draw in draws
    ]
    cell, count = cells["1", "0.01"], len(cells)
    return (
        judge("three_quarters", [share["mean"] >= 75.0 for share in shares],
              noise=cells["1", "0.0001"].noise / MM,
              chance=100.0 * float(beta.cdf(0.25**2, 4.5, 16.5)), **shares[0]),
        judge("better", [of["better"] == count for of in better], count=count, **better[0]),
        judge("correlation", [min(of.values()) > 0.7 for of in ranks], count=count,
              ratios=len({c.ratio for c in cells.values()}), ranks=ranks[0],
              least={m: min(of[m] for of in ranks) for m in METHODS},
              parameters=cell.compute_reduction(LS, "parameters [mm]"),
              position=cell.compute_reduction(LS, "position [mm]"),
              aligned=cell.compute_reduction(LS, POSITION_ALIGNED)),
    )  # fmt: skip


def _list_medians(draw: Draw) -> dict[tuple[str, str], list[float]]:
    """Return the median position errors of each cell, before and by LS and MAP."""
    return {
        key: [c.compute_median(m, POSITION_ALIGNED) for m in (BEFORE, LS, PRIOR)]
        for key, c in draw.cells.items()
    }


def _judge_figure_5(results: Results) -> tuple[published.Verdict, ...]:
    ranked = sorted(results.candidates, key=lambda row: row["distance"])
    deviation, variance = (
        next(row for row in ranked if row["reading"] == reading)
        for reading in (steps.SD, steps.VARIANCE)
    )
    literal = next(r for r in ranked if (r["truth"], r["frame"]) == ("all 42", ABSOLUTE))
    texts = [
        [f"{row[name]:.0f} %" for name in ("parameters", "position", "orientation")]
        for row in (deviation, variance, literal)
    ]
    noise = SIZES.find("figure_5", "noise")
    return (
        TEXT.judge("variances", variance["distance"] < deviation["distance"], deviation=deviation,
                   variance=variance, deviations=texts[0], variances=texts[1], given=noise,
                   root=np.sqrt(noise)),
        TEXT.judge("figure_5", literal["distance"] < 10.0, literal=literal, reductions=texts[2],
                   nearest=ranked[0]),
    )  # fmt: skip


def _judge_points(results: Results) -> tuple[published.Verdict, ...]:
    """Judge the exchange, the number of planes, and fifty points."""
    ten, one, free = results.arrangements
    fifties, judge = results.draws[0].fifties, TEXT.judge
    places = {"ls": (ABSOLUTE, LS), "nominal": (AT_NOMINAL, LS), "aligned": (ALIGNED, LS),
              "prior": (ALIGNED, PRIOR)}  # fmt: skip
    changes = {name: [] for name in places}
    for name, (frame, method) in places.items():
        for cell in fifties.values():
            before, after = (compute_statistics(cell, m, frame)[0] for m in (BEFORE, method))
            changes[name].append(f"{before:.2g} to {after:.2g} mm")
    factors = {
        (groups, frame, m): compute_statistics(c, BEFORE, frame) / compute_statistics(c, m, frame)
        for groups, c in fifties.items() for frame in steps.FRAMES for m in METHODS
    }  # fmt: skip
    falling = sum(bool((of > 1.0).all()) for of in factors.values())
    gains = [draw.points["gain"] for draw in results.draws]
    least, most = min(fifties), max(fifties)
    within = [draw.fifties[least].within_five for draw in results.draws]
    agrees = published.decide(falling == len(factors), falling == 0)
    return (
        judge("exchange", [gain >= 3.0 for gain in gains], gain=gains[0], least=min(gains), ten=ten,
              one=one),
        judge("one_plane", one[LS] < 1.5 * ten[LS], one=one, ten=ten, free=free,
              noise=SIZES.find("figure_5", "noise"), cost_one=one[LS], cost_ten=ten[LS]),
        judge("iterations", [share >= 90.0 for share in within], within=within[0],
              one=int(fifties[least].iterations.max()), five=int(fifties[most].iterations.max()),
              five_within=fifties[most].within_five, least=min(within), most=max(within)),
        judge("full_poses", agrees, falling=falling, ways=len(factors), **changes,
              factors=", ".join(f"{f:.1f}" for f in factors[most, ABSOLUTE, PRIOR]),
              stated=", ".join(given.stated for given in results.table_4.values())),
    )  # fmt: skip


def _judge_arithmetic(results: Results) -> tuple[published.Verdict, ...]:
    """Judge the factors of Table 4, and those of root mean squares: rms^2 = mean^2 + sd^2."""
    table, possible, stated = results.table_4, {}, results.conclusion
    for name in stated:
        mean, sd = (table[f"{name}, {what}"] for what in ("mean", "standard deviation"))
        possible[name] = steps.bound_factor((mean.before, sd.before), (mean.after, sd.after))
    excess = max(steps.compute_excess(stated[name], possible[name]) for name in possible)
    return (
        *(TEXT.judge("factor", given.excess == 0.0, name=name, given=given)
          for name, given in table.items()),
        TEXT.judge("conclusion", excess == 0.0, stated=stated, possible=possible),
    )  # fmt: skip


def _judge_methods(results: Results) -> tuple[published.Verdict, published.Verdict]:
    """Judge the prior, and the weights of the rows."""
    sure, given, first = SIZES.find("sure"), SIZES.find("figure_5"), results.draws[0]
    priors, positions = [], []
    for draw in results.draws:
        medians = _list_medians(draw)
        better = sum(prior <= (1.0 + sure) * ls for _, ls, prior in medians.values())
        harmed = sum(not prior <= before for before, _, prior in medians.values())
        least = medians["0.01", "0.1"]
        priors.append({"better": better, "harmed": harmed, "medians": least})
        weights = draw.weights.items()
        positions.append({name: c.compute_median(LS, POSITION_ALIGNED) for name, c in weights})
    count, position = len(results.cells), positions[0]
    less = [{n: 100.0 * (1.0 - p["full"] / p[n]) for n in p} for p in positions]
    from_printed = [of["printed"] for of in less]
    return (
        TEXT.judge("prior", [(p["better"], p["harmed"]) == (count, 0) for p in priors],
                   sure=100 * sure, count=count, trials=results.trials,
                   worse=results.cells["0.01", "0.1"].count_worse(PRIOR, POSITION_ALIGNED),
                   **priors[0]),
        TEXT.judge("weights", [p["printed"] < (1.0 + sure) * p["full"] for p in positions],
                   parameters={n: c.compute_median(PRIOR, NO_GAUGE)
                               for n, c in first.weights.items()},
                   position=position, less=less[0], lowest=min(from_printed),
                   highest=max(from_printed), set=given["errors"], noise=given["noise"],
                   nearer=100.0 * (1.0 - position["distance"] / position["printed"])),
    )  # fmt: skip


def _judge_forms(results: Results) -> tuple[published.Verdict, published.Verdict]:
    """Judge the two forms of the equations."""
    forms, (hardest, *others), judge = results.forms, results.forms, TEXT.judge
    noises = sorted({row["noise"] for row in forms})
    calm, loud = (
        max(row["median"] for row in forms if row["noise"] == noise)
        for noise in (noises[0], noises[-1])
    )
    compared, fits = (sum(row[key] for row in forms) for key in ("converged", "machines"))
    largest = max((row["largest"] for row in forms if row["converged"]), default=np.nan)
    agrees = published.decide(largest < 0.05 and results.covariance < 1e-6, compared > 0)
    converged, rest = (sum(row[key] for row in others) for key in ("converged", "machines"))
    return (
        judge("forms", agrees, covariance=results.covariance, compared=compared, largest=largest,
              fits=fits, noise=noises[-1], least=noises[0], loud=loud, calm=calm),
        judge("converged", hardest["converged"] == hardest["machines"] and converged == rest,
              hardest=hardest, noise=hardest["noise"], converged=converged, fits=rest,
              most=max(row["iterations"] for row in forms),
              ranks=sorted({rank for row in forms for rank in row["ranks"]}),
              noises=[f"{noise:g}" for noise in noises]),
    )  # fmt: skip


def list_replaced(results: Results) -> tuple[str, ...]:
    """Return sentences on further sizes that another robot replaces."""
    return ()
