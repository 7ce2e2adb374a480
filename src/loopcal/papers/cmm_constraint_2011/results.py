# SPDX-License-Identifier: Apache-2.0
"""The whole study: choose points, draw machines, calibrate, and judge the claims."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from loopcal.mechanism.platform_coordinates import POSITION as POSITION_AXES
from loopcal.papers import published
from loopcal.papers.cmm_constraint_2011 import steps
from loopcal.papers.cmm_constraint_2011.steps import (
    ABSOLUTE,
    ALIGNED,
    AT_NOMINAL,
    BEFORE,
    DETERMINED,
    LS,
    METHODS,
    PARAMETERS,
    PRINTED,
    PRIOR,
    SIZES,
    Cell,
    Draw,
    Key,
    name_measure,
)
from loopcal.papers.paper import StudyCase
from loopcal.papers.published import Row, decide, decide_each, decide_share
from loopcal.typing import FloatArray

TEXT = published.PaperText(__file__)
POSITION = name_measure("position", ALIGNED)


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged."""

    case: StudyCase
    study: steps.Study  # the ten groups
    draws: tuple[Draw, ...]  # tables and figures show the first
    ranks: list[Row]  # of random groups
    pair: tuple[int, int]  # points of a group and rank of the equations of all its pairs
    frame_effect: float  # of a motion of the measuring machine on the equations
    undetermined: list[tuple[str, float]]  # directions, and their effect on the rows

    @property
    def cells(self) -> Mapping[Key, Cell]:
        """Table 3 of the first draw."""
        return self.draws[0].cells

    @property
    def figure_5(self) -> Cell:
        """Its cell of the first draw."""
        return self.cells[steps.find_figure_5()]

    @property
    def trials(self) -> int:
        """Machines of each cell."""
        return len(self.figure_5.iterations)

    @property
    def is_elsewhere(self) -> bool:
        """Whether the dimensions are others than those of the paper."""
        return self.case.robot is not None or SIZES.find("dimensions") == "ours"

    def reduce(self, measure: str) -> FloatArray:
        """Return the reductions of an error [%] by least squares, figure 5, all machines."""
        cells = [draw.cells[steps.find_figure_5()] for draw in self.draws]
        return 100.0 * (1.0 - np.concatenate([c.compute_left(LS, measure) for c in cells]))

    def reduce_median(self, measure: str) -> float:
        """Return the median reduction of an error [%] on the machines of the tables."""
        return steps.take_median(100.0 * (1.0 - self.figure_5.compute_left(LS, measure)))

    def word_reduction(self, measure: str) -> str:
        """Return it in words."""
        return word_change(self.reduce_median(measure))

    def pool(self, judge: Callable[[Draw], Sequence[bool | None]]) -> list[bool | None]:
        """Return the decisions on the machines of all draws."""
        return [decision for draw in self.draws for decision in judge(draw)]


def compute(
    seed: int, trials: int, progress: Callable[[str], None], case: StudyCase = steps.CASE,
    draws: int = 0, sweeps: int | None = None,
) -> Results:  # fmt: skip
    """Compute everything.

    draws : of points, machines and noise, by default those of sizes.yaml. sweeps : of the
    coordinate exchange, by default those of study.yaml.

    Raises EstimationError: a robot whose end point cannot be held on planes and lines.
    """
    draws, drawn = draws or SIZES.find("draws"), list[Draw]()
    grid = steps.load_grid(case, seed, trials)
    (level,) = grid.poses.values()
    level = level if sweeps is None else replace(level, sweeps=sweeps)
    progress("coordinate exchange")
    study = steps.plan_points(grid, level)
    for i in range(draws):
        points = replace(grid, seed=seed + SIZES.find("seed_step") * i)
        label = f"draw {i + 1} of {draws}"
        drawn.append(
            steps.compute_draw(
                steps.plan_points(points, level) if i else study,
                lambda step, label=label: progress(f"{label}: {step}"),
            )
        )
    return Results(
        case=case,
        study=study,
        draws=tuple(drawn),
        ranks=steps.compute_ranks(study),
        pair=steps.compute_pair_rank(study),
        frame_effect=steps.compute_frame_effect(study),
        undetermined=steps.list_undetermined(study),
    )


def word_change(reduction: float) -> str:
    """Return the reduction of an error [%] in words, such as "51 % smaller" or "2 % larger"."""
    return f"{abs(reduction):.0f} % {'smaller' if reduction >= -0.5 else 'larger'}"


def list_replaced(results: Results) -> tuple[str, ...]:
    """Return sentences on further sizes that another robot replaces."""
    if results.case.robot is None:
        return ()
    study, sentences = results.study, published.PaperFile(__file__, "text.yaml").find("replaced")
    of = {"errors": study.describe_errors(steps.find_figure_5()[0]), "robot": study.robot.name,
          "unit": study.unit[1]}  # fmt: skip
    kept = ["errors", *(["fixed"] if len(study.parts) == 1 else [])]
    return tuple(published.fill_template(sentences[name], **of) for name in kept)


def compare_tables(results: Results) -> tuple[published.Comparison, ...]:
    """Return the stated numbers of figure 5 beside computed ones; nothing for other robots."""
    if results.case.robot is not None:
        return ()
    counts = published.Printed.parse({
        "parameters identified": PRINTED.find("parameters"),
        "iterations for the measured points, at most": PRINTED.find("experiment", "iterations"),
    })  # fmt: skip
    rank = max(row["rank"] for row in results.ranks)
    iterations = max(int(cell.iterations.max()) for cell in results.draws[0].fifties.values())
    figure, measures = PRINTED.find("figure_5"), list_printed_measures(results.study)
    stated = published.Printed.parse({name: figure[name]["stated"] for name in measures})
    falls = np.array([[results.reduce_median(measure)] for measure in measures.values()])
    return (
        TEXT.compare("counts", counts, np.array([[float(rank)], [float(iterations)]])),
        TEXT.compare("figure_5", stated, falls),
    )


def make_tables(results: Results) -> tuple[published.Table, ...]:
    """Return all tables of the reproduction."""
    study, first, trials = results.study, results.draws[0], results.trials
    parts = study.parts
    fifty = [
        (steps.name_planes(groups), frame, *row)
        for groups, cell in first.fifties.items() for frame in steps.FRAMES
        for row in list_methods(cell, list_statistics(study, frame))
    ]  # fmt: skip
    cell = next(iter(first.fifties.values()))
    experiment = {"errors": study.describe_errors(cell.size), "noise": cell.noise}
    statistics = [(study.label(name_measure(what, "", s)).replace(", ,", ","), ".3g")
                  for what in parts for s in steps.STATISTICS[1:]]  # fmt: skip
    aligned = tuple(name_measure(what, ALIGNED) for what in parts)
    absolute = tuple(name_measure(what, ABSOLUTE) for what in parts)
    at_nominal = name_measure("position", AT_NOMINAL)
    return (
        _list_given(study),
        TEXT.table("ranks", [tuple(row.values()) for row in results.ranks],
                   parameters=len(study.planned.free)),
        TEXT.table("gauge", results.undetermined, count=len(results.undetermined)),
        _list_table_3(results, "table_3", (*aligned, DETERMINED)),
        _list_table_3(results, "table_3_absolute", (*absolute, at_nominal, PARAMETERS)),
        TEXT.table("table_4", fifty, "", statistics, trials=trials, **experiment),
    )  # fmt: skip


def list_printed_measures(study: steps.Study) -> dict[str, str]:
    """Return which errors of figure 5 the robot has, and their measures in the absolute frame."""
    return {
        name: PARAMETERS if name == PARAMETERS else name_measure(name, ABSOLUTE)
        for name in PRINTED.find("figure_5")
        if name in (PARAMETERS, *study.parts)
    }


def list_statistics(study: steps.Study, frame: str) -> list[str]:
    """Return the means and standard deviations of Table 4 in a frame."""
    return [name_measure(what, frame, s) for what in study.parts for s in steps.STATISTICS[1:]]


def list_methods(
    cell: Cell, measures: Sequence[str], methods: Sequence[str] = (BEFORE, *METHODS)
) -> Iterator[tuple[Any, ...]]:
    """Yield method, number of machines and medians; machines on which a method did not converge
    have a row of their own.
    """
    for method in methods:
        for is_lost in (False, True):
            count = int((cell.converged[method] != is_lost).sum())
            medians = (cell.compute_median(method, measure, is_lost) for measure in measures)
            if count or not is_lost:
                name = f"{method}, not converged" if is_lost else method
                yield (name, count, *(x if np.isfinite(x) else None for x in medians))


def _list_given(study: steps.Study) -> published.Table:
    robot, scale = study.robot, {"m": (steps.MM, "mm"), "rad": (steps.DEGREE, "deg")}
    rows = [("robot", f"{robot.name}, {len(study.planned.free)} free parameters")]
    for name, (low, high) in robot.assembly.workspace.items():
        unit, symbol = scale["m" if name in POSITION_AXES else "rad"]
        rows.append((f"workspace, {name}", f"{low / unit:.4g} to {high / unit:.4g} {symbol}"))
    groups, points = study.layout.groups, study.layout.points
    each = f"{groups} planes of equal z, {points // groups} points each with their line"
    sets = ", ".join(study.describe_errors(level.tolerance_factor)
                     for level in study.grid.errors.values())  # fmt: skip
    history = ", ".join(f"{v:.1f}" for v in study.optimized.history)
    exchange = f"log det {history} [tolerances, noise 1 mm]"
    rows += [("standard deviations of the errors", sets), ("points", each)]
    return TEXT.table("given", [*rows, ("coordinate exchange", exchange)])


def _list_table_3(results: Results, name: str, measures: tuple[str, ...]) -> published.Table:
    rows, study, last = list[tuple[Any, ...]](), results.study, ""
    for (given, noise), cell in sorted(results.cells.items(), key=lambda of: of[1].size):
        errors = study.describe_errors(given)
        for method, *numbers in list_methods(cell, measures):
            if method == BEFORE and given == last:
                continue
            left = cell.compute_left(method, measures[0]) if method in METHODS else None
            worse = None if left is None else int((left > 1.0).sum())
            rows.append((errors, "-" if method == BEFORE else noise, method, *numbers, worse))
        last = given
    more = [(study.label(measure), ".2g") for measure in measures]
    more.append((f"worse than before in {measures[0]}", "d"))
    return TEXT.table(name, rows, "", more, trials=results.trials,
                      poses=study.grid.scores.held_out)  # fmt: skip


def make_figures(results: Results) -> tuple[published.Figure, ...]:
    """Return all figures."""
    return _draw_figure_4(results), _draw_figure_5(results), _draw_table_3(results)


def _draw_figure_4(results: Results) -> published.Figure:
    """Return pose error over parameter error, both after / before, so that growth has a place."""
    absolute = (PARAMETERS, name_measure("position", ABSOLUTE))
    lines = []
    for frame, measures in {"": absolute, ", aligned": (DETERMINED, POSITION)}.items():
        for method in METHODS:
            both = sorted(
                tuple(steps.take_median(cell.compute_left(method, m)) for m in measures)
                for cell in results.cells.values()
            )
            x, y = zip(*both, strict=True)
            lines.append(published.Series.of(f"{method}{frame}", x, y))
    return TEXT.figure("figure_4", lines, joined=False, count=len(results.cells))


def _draw_figure_5(results: Results) -> published.Figure:
    """Return position errors of single poses of the first machine, before and after."""
    study, made, sizes = results.study, results.figure_5, {}
    true = study.solve(made.truth[:1])
    for name, values in made.values.items():
        T = study.solve(values[:1])
        for frame in (ABSOLUTE, ALIGNED):
            twists = study.compute_twists(T, true, frame)[0]
            label = name if frame == ABSOLUTE else f"{name}, {frame}"
            sizes[label] = np.linalg.norm(twists[:, 3:], axis=1) / steps.MM
    order = np.argsort(sizes[BEFORE])
    x = range(1, len(order) + 1)
    lines = [published.Series.of(label, x, size[order]) for label, size in sizes.items()]
    return TEXT.figure("figure_5", lines, joined=False, errors=study.describe_errors(made.size),
                       noise=made.noise, count=len(order))  # fmt: skip


def _draw_table_3(results: Results) -> published.Figure:
    """Return the position error by noise, for each set of errors."""
    lines, levels = [], {}
    for given in results.study.grid.errors:
        cells = [cell for (of_set, _), cell in results.cells.items() if of_set == given]
        name = f"errors of {results.study.describe_errors(given)}"
        levels[f"before, {name}"] = cells[0].compute_median(BEFORE, POSITION)
        for method in METHODS:
            y = [cell.compute_median(method, POSITION) for cell in cells]
            lines.append(published.Series.of(f"{method}, {name}", [c.noise for c in cells], y))
    return TEXT.figure("table_3", lines, levels, trials=results.trials)


def judge_claims(results: Results) -> tuple[published.Verdict, ...]:
    """Return a verdict for each claim."""
    groups = [_judge_equations, _judge_table_3, _judge_experiment, _judge_methods]
    return tuple(verdict for judge in groups for verdict in judge(results))


def decide_all(decisions: Sequence[bool | None]) -> bool | None:
    """Return True if all are true, False if all are false, else None."""
    return decide(all(d is True for d in decisions), all(d is False for d in decisions))


def _judge_equations(results: Results) -> tuple[published.Verdict, ...]:
    (points, rank), effect = results.pair, results.frame_effect
    missing, judge = points - rank, TEXT.judge
    last = [row["last"] for row in results.ranks]
    regular = [decide(smallest > 1e-8, smallest < 1e-12) for smallest in last]
    groups = [row["groups"] for row in results.ranks]
    return (
        judge("independent", decide(effect < 1e-9, effect > 1e-6), effect=effect),
        judge("counted", decide(missing == 1, missing != 2), points=points, rank=rank,
              missing=missing),
        judge("least_squares", decide_all(regular), parameters=len(results.study.planned.free),
              ranks=sorted({row["rank"] for row in results.ranks}), fewest=min(groups),
              most=max(groups), largest=max(last), count=len(results.undetermined)),
    )  # fmt: skip


def _judge_table_3(results: Results) -> tuple[published.Verdict, ...]:
    from scipy.stats import beta

    study, cells, cell, judge = results.study, results.cells, results.figure_5, TEXT.judge
    p, left = len(study.planned.free), len(study.planned.free) - len(study.observable)
    stated, falls = PRINTED.number("figure_5", PARAMETERS, "stated"), results.reduce(PARAMETERS)
    reached = decide_each(falls >= stated - 0.5, np.isfinite(falls))
    best = chance = 1.0
    if left:  # distribution of the share of undetermined directions in the squared norm
        share = beta(left / 2, (p - left) / 2)
        best, chance = 1.0 - np.sqrt(share.median()), share.cdf((1.0 - stated / 100.0) ** 2)
    aligned = [name_measure(what, ALIGNED) for what in study.parts]
    better = {
        key: decide_share(results.pool(lambda draw, k=key: draw.cells[k].are_reduced(LS, aligned)))
        for key in cells
    }
    worse = [f"errors {study.describe_errors(s)} with noise {n} mm"
             for (s, n), decision in better.items() if decision is False]  # fmt: skip
    good, ranks = SIZES.find("good"), [
        {m: steps.rank_correlations(d.cells.values(), m) for m in METHODS} for d in results.draws
    ]  # fmt: skip
    of_ls = np.concatenate([of[LS] for of in ranks])
    correlated = decide_each(of_ls > good, np.isfinite(of_ls))
    ratio = np.median([c.compute_median(LS, POSITION) / c.noise for c in cells.values()])
    change, elsewhere = results.word_reduction(PARAMETERS), results.is_elsewhere
    sizes = {"errors": study.describe_errors(cell.size), "noise": cell.noise,
             "trials": results.trials}  # fmt: skip
    figure, gains = PRINTED.find("figure_5"), [draw.gain for draw in results.draws]
    each = np.min([results.reduce(name_measure(what, ABSOLUTE)) - float(figure[what]["stated"])
                   for what in study.parts], axis=0)  # fmt: skip

    def word_poses(numbers: Mapping[str, float]) -> list[str]:
        return [f"{what} {numbers[what]:.3g} {steps.PARTS[what][2]}" for what in study.parts]

    return (
        judge("three_quarters", reached, elsewhere=elsewhere, stated=stated, parameters=p,
              left=left, best=100.0 * best, chance=100.0 * chance, change=change, **sizes),
        judge("better", decide(True in better.values(), set(better.values()) == {False}),
              elsewhere=elsewhere,
              better=sum(d is True for d in better.values()), count=len(cells),
              worse=worse or ["none"], parts=study.parts, ratio=ratio),
        judge("figure_5", decide_each(each >= -0.5, np.isfinite(each)), elsewhere=elsewhere,
              trials=results.trials,
              stated=[f"{what} {figure[what]['stated']} %" for what in study.parts],
              reductions=[f"{what} {results.word_reduction(name_measure(what, ABSOLUTE))}"
                          for what in study.parts],
              before=word_poses({what: cell.compute_median(BEFORE, name_measure(what, ABSOLUTE))
                                 for what in study.parts}),
              printed=word_poses({what: float(figure[what]["before"]) for what in study.parts})),
        judge("exchange", [gain >= 3.0 for gain in gains], gain=gains[0], least=min(gains),
              unit=study.unit[1], drawn=study.spreads[0], optimized=study.spreads[1]),
        judge("correlation", correlated, elsewhere=elsewhere, good=good, count=len(cells),
              ratios=len({c.ratio for c in cells.values()}),
              ranks={m: steps.take_median(r) for m, r in ranks[0].items()}, parameters=change,
              position=results.word_reduction(name_measure("position", ABSOLUTE)),
              aligned=results.word_reduction(POSITION), **sizes),
    )  # fmt: skip


def _judge_experiment(results: Results) -> tuple[published.Verdict, ...]:
    """Judge iterations, time and full poses of the points of the experiment."""
    fifties, study, elsewhere = results.draws[0].fifties, results.study, results.is_elsewhere
    stated, falling, within = PRINTED.find("experiment"), dict[Any, bool | None](), []
    most = int(stated["iterations"])
    for groups in fifties:
        is_within = results.pool(lambda d, g=groups: d.fifties[g].is_within(most).tolist())
        within.append((steps.name_planes(groups), published.estimate_share(is_within),
                       decide_share(is_within)))  # fmt: skip
        for frame in steps.FRAMES:
            measures = list_statistics(study, frame)
            falling[groups, frame] = decide_share(results.pool(
                lambda d, g=groups, m=measures: d.fifties[g].are_reduced(LS, m)))  # fmt: skip
    places = {"ls": (ABSOLUTE, LS), "nominal": (AT_NOMINAL, LS), "aligned": (ALIGNED, LS),
              "prior": (ALIGNED, PRIOR), "absolute_prior": (ABSOLUTE, PRIOR)}  # fmt: skip
    changes = {
        name: [
            "{:.2g} to {:.2g} mm on {}".format(
                *(cell.compute_median(m, name_measure("position", frame, ", mean"))
                  for m in (BEFORE, method)), steps.name_planes(groups))
            for groups, cell in fifties.items()
        ]
        for name, (frame, method) in places.items()
    }  # fmt: skip
    seconds = [s for draw in results.draws for s in draw.seconds]
    limit, longest = float(stated["seconds"]), max(seconds)
    return (
        TEXT.judge("iterations", decide_all([decision for _, _, decision in within]),
                   elsewhere=elsewhere, points=PRINTED.find("points", "measured"), stated=most,
                   aligned=changes["aligned"],
                   shares=[f"{100 * s.value:.0f} % (95 % interval {100 * s.low:.0f} to "
                           f"{100 * s.high:.0f} %) on {name}" for name, s, _ in within]),
        TEXT.judge("seconds", [s <= limit for s in seconds], stated=limit, longest=longest,
                   ratio=limit / longest),
        TEXT.judge("full_poses", decide_all(list(falling.values())), elsewhere=elsewhere,
                   falling=sum(d is True for d in falling.values()),
                   rising=sum(d is False for d in falling.values()), ways=len(falling), **changes),
    )  # fmt: skip


def _judge_methods(results: Results) -> tuple[published.Verdict]:
    """Judge the prior."""
    sure, cells, study = SIZES.find("sure"), results.cells, results.study

    def judge_prior(cell: Cell) -> list[bool | None]:
        before, ls, prior = (cell.errors[m][POSITION] for m in (BEFORE, LS, PRIOR))
        good = (prior <= (1.0 + sure) * ls) & (prior <= before)
        return decide_each(good, cell.converged[LS] & cell.converged[PRIOR])

    priors = {
        key: decide_share(results.pool(lambda draw, k=key: judge_prior(draw.cells[k])))
        for key in cells
    }
    key = max(cells, key=lambda k: cells[k].ratio)  # the hardest
    left = {m: cells[key].compute_median(m, POSITION) for m in (BEFORE, LS, PRIOR)}
    worse = published.estimate_share(results.pool(
        lambda draw: [x > 1.0 for x in draw.cells[key].compute_left(PRIOR, POSITION)]))  # fmt: skip

    return (
        TEXT.judge("prior", decide(all(d is True for d in priors.values()), False in
                                   priors.values()), sure=100 * sure, count=len(cells),
                   better=sum(d is True for d in priors.values()),
                   worse=sum(d is False for d in priors.values()), share=100.0 * worse.value,
                   errors=study.describe_errors(key[0]), noise=key[1], left=left),
    )  # fmt: skip
