# SPDX-License-Identifier: Apache-2.0
"""The whole study: both manipulators with 6- and 5-DOF measurement, then many machines; its tables,
figures and verdicts.

The paper simulates one machine of each structure. Here each drawn pair of machines is one draw of
that simulation, and a claim is judged in every draw; it holds in a draw if it holds in all
situations it speaks of. Claims about medians are judged in groups of machines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.estimate.published_steps import LINEARIZATIONS
from loopcal.mechanism.model import Mechanism
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
from loopcal.papers.tsvd_2016 import steps
from loopcal.papers.tsvd_2016.steps import (
    BEFORE,
    CROSS,
    GAIN,
    HINDSIGHT,
    LS,
    NARROW,
    PRIOR,
    PRIOR_FIVE,
    RANKED,
    RAW_FIVE,
    RAW_LS,
    RAW_RE,
    RAW_TSVD,
    RE,
    TSVD,
    WHITENED,
    WIDE,
    Case,
    Draws,
    Situation,
)
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

TEXT = PaperText(__file__)
DIVERGED = "diverged"
"""Cell of a number that a diverged fit does not have."""
ROUNDING = 1e-10
"""Size below which an error [mm, deg, tolerances] is rounding."""
RIDGE_STEPS = (5, 10, 20, 50, 100)
"""Iterations of RE after which its curve over lambda is examined."""
NOISE_COLUMNS = ("X [mm]", "Y [mm]", "Z [mm]", "phi [rad]", "theta [rad]", "psi [rad]")
SIZES: dict[str, tuple[str, ...]] = {
    "3-PRS": ("platform_radius", "base_radius", "rod"),
    "RU-PUS-PRS": ("platform_radius", "base_radius", "rod", "post"),
}
IDENTIFIED = (
    (LS, 6), (RE, 6), (TSVD, 6), (RANKED, 5), (RE, 5), (TSVD, 5), (WHITENED, 6), (PRIOR, 6),
    (PRIOR, 5),
)  # fmt: skip
"""Methods and measured coordinates of the columns of the identified errors."""
COMPARED = (RAW_LS, RAW_RE, RAW_TSVD, WHITENED, CROSS, NARROW, WIDE, HINDSIGHT)
"""Methods that MAP is compared with, all with 6-DOF measurement."""
TABLES = {"RU-PUS-PRS": (5, 7), "3-PRS": (6, 8)}
"""Tables of the paper with identified parameters and with output errors."""
FIGURES = {("RU-PUS-PRS", 6): 6, ("RU-PUS-PRS", 5): 8, ("3-PRS", 6): 10, ("3-PRS", 5): 11}
"""Figures of the paper with curves over lambda and k."""
HISTORIES = {6: 7, 5: 9}
"""Figures of the paper with parameters by iteration, RU-PUS-PRS, by measured coordinates."""
NAMED, LONG = 6, 50
"""Parameters named in a legend, and iterations above which their axis is logarithmic."""
LABELS = ("position [mm]", "phi and theta [deg]")
SETTING, LOG = {RE: "lambda", TSVD: "k"}, {RE: "xy", TSVD: "y"}


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged."""

    cases: Mapping[tuple[str, int], Case]  # both manipulators, each with 6- and 5-DOF measurement
    draws: tuple[Draws, ...]  # of both manipulators
    # best lambda and errors of RE after RIDGE_STEPS, 3-PRS with 6-DOF measurement
    ridge_steps: list[tuple[int | str, float, FloatArray]]
    noise: Printed  # Appendix 1 as printed


def compute(seed: int, trials: int, progress: Callable[[str], None]) -> Results:
    """Compute everything: one machine of each kind with the printed noise, then drawn machines."""
    cases = {}
    for name in steps.ROBOTS:
        whole = steps.measure_case(name, seed)
        for measured in (whole, whole.five):
            cases[name, measured.freedoms] = steps.solve_case(measured, progress)
    progress("ridge steps")
    ridge_steps = steps.follow_ridge(cases["3-PRS", 6].study, RIDGE_STEPS)
    draws = tuple(steps.draw_machines(name, seed, trials, progress) for name in steps.ROBOTS)
    return Results(cases, draws, ridge_steps, steps.PRINTED.table("appendix_1"))


def present(results: Results) -> Content:
    """Return the results as tables, verdicts and figures."""
    counts = _compare_counts(results)
    return Content((counts,), make_tables(results), judge_claims(results), make_figures(results))


def show_number(value: float) -> Cell:
    """Return a number as a cell: rounding as 0, and what is not finite as a fit that diverged."""
    if not np.isfinite(value):
        return DIVERGED
    return float(value) if abs(value) > ROUNDING else 0.0


def _compare_counts(results: Results) -> Comparison:
    """Return the numbers that the text states, beside the computed ranks."""
    tripod = results.cases["3-PRS", 6]
    chain = sum("1" in name for name in tripod.study.robot.parameters.names)
    numbers = (results.cases["RU-PUS-PRS", 6].rank, tripod.rank, chain,
               len(tripod.study.trials.readings))  # fmt: skip
    computed = np.array(numbers, dtype=np.float64)[:, None]
    return TEXT.compare("counts", steps.PRINTED.table("counts"), computed)


def make_tables(results: Results) -> tuple[Table, ...]:
    """Return all tables: the analogues of Tables 1 to 8, and the figures as numbers."""
    cases, draws = results.cases.values(), results.draws
    ridge = [(n, lam, *map(show_number, errors[:2])) for n, lam, errors in results.ridge_steps]
    noise, limits = results.noise.values, np.array([*steps.LIMITS[:3] * 1e3, *steps.LIMITS[3:]])
    largest, rms = np.abs(noise).max(axis=0), np.sqrt(np.mean(noise**2, axis=0))
    return (
        TEXT.table("given", [row for name in steps.ROBOTS for row in _list_machine(name)]),
        TEXT.table(
            "noise", zip(NOISE_COLUMNS, largest, limits, rms, limits / np.sqrt(3.0), strict=True)
        ),
        _list_ranks(cases),
        *(_list_outputs(name, results) for name in steps.ROBOTS),
        *map(make_medians, draws),
        *map(make_ratios, draws),
        _list_convergence(cases),
        TEXT.table("ridge_steps", ridge),
        *(_list_identified(name, results) for name in steps.ROBOTS),
        *map(_list_curves, cases),
        *(make_median_curves(situation) for draw in draws for situation in draw.situations),
        *map(_list_history, cases),
    )


def _list_machine(name: str) -> list[tuple[str, str, str]]:
    robot = steps.load_machine(name)
    record = robot.record.record  # of the file: dimensions in SI
    rows = [(name, size.replace("_", " "), f"{1e3 * getattr(record, size):g} mm")
            for size in SIZES[name]]  # fmt: skip
    tilts = ", ".join(f"{tilt:g}" for tilt in steps.EVALUATED_TILTS)
    heights = ", ".join(f"{1e3 * z:g}" for z in steps.HEIGHTS)
    z = f" at z {heights} mm" if "z" in robot.controlled else ""
    return [*rows, (name, "output range", f"96 poses, tilts of {tilts} deg{z}")]


def _list_ranks(cases: Iterable[Case]) -> Table:
    rows = []
    for case in cases:
        s = case.singular_values
        null = "; ".join(map(str, case.known.unidentifiable)) or None
        values = (s[0], s[-2], s[-1], s[0] / s[case.rank - 1])
        tail = (case.known.condition, case.normal_equations, null)
        rows.append((case.study.label, f"{case.rank} of {len(s)}", *values, *tail))
    return TEXT.table("ranks", rows)


def _list_outputs(name: str, results: Results) -> Table:
    study = results.cases[name, 6].study
    rows: list[tuple[Any, ...]] = []
    for method, values in ((BEFORE, study.robot.parameters.nominal[None]),
                           (steps.TRUE, study.trials.truth)):  # fmt: skip
        commanded = study.compute_commanded_errors(values)[0]
        errors = study.compute_output_errors(values)[0, :4]
        rows.append(("", method, None, *errors, *commanded, None, None))
    for freedoms in (6, 5):
        for method, answer in results.cases[name, freedoms].answers.items():
            numbers = map(show_number, (*answer.errors[:4], *answer.commanded))
            end = DIVERGED if answer.is_diverged else "yes" if answer.is_converged else "no"
            label = (f"{freedoms}-DOF", method, answer.setting)
            rows.append((*label, *numbers, answer.iterations, end))
    number = TABLES[name][1]
    return TEXT.table("outputs", rows, f"table_{number}", name=name, number=number)


def _list_identified(name: str, results: Results) -> Table:
    study = results.cases[name, 6].study
    columns = [study.trials.truth[0]]
    columns += [results.cases[name, f].answers[m].values for m, f in IDENTIFIED]
    values = to_paper_units(study, np.array(columns)).T
    labels = zip(study.robot.parameters.names, list_units(study.robot), strict=True)
    rows = [(*label, *map(show_number, row)) for label, row in zip(labels, values, strict=True)]
    number = TABLES[name][0]
    return TEXT.table("identified", rows, f"table_{number}", name=name, number=number)


def _list_convergence(cases: Iterable[Case]) -> Table:
    rows = []
    for case in cases:
        cells = []
        for method in (LS if case.study.freedoms == 6 else RANKED, RE, TSVD, WHITENED, PRIOR):
            answer = case.answers[method]
            more = "" if answer.is_converged else "more than "
            cells.append(DIVERGED if answer.is_diverged else f"{more}{answer.iterations:,}")
        rows.append((case.study.label, *cells))
    return TEXT.table("convergence", rows)


def _list_curves(case: Case) -> Table:
    rows = []
    for algorithm, sweep in case.sweeps.items():
        for i, setting in enumerate(sweep.settings):
            spacing = None
            if algorithm == RE:
                spacing = "equal intervals" if case.is_equal[i] else "equal ratios"
            errors = map(show_number, sweep.errors[i, :3])
            rows.append((algorithm, setting, spacing, *errors, sweep.runs.count[i]))
    low, high = case.bracket
    name = f"curves_{case.study.file}"
    return TEXT.table("curves", rows, name, case=case.study.label, low=low, high=high)


def _list_history(case: Case) -> Table:
    robot = case.study.robot
    rows = [
        (algorithm, i, *map(show_number, values))
        for algorithm in (LS, RE, TSVD)
        for i, values in zip(*collect_history(case, algorithm), strict=True)
    ]
    labels = zip(robot.parameters.names, list_units(robot), strict=True)
    more = [(f"{parameter} [{unit}]", ".3g") for parameter, unit in labels]
    name = f"history_{case.study.file}"
    return TEXT.table("history", rows, name, more, case=case.study.label)


def make_medians(draws: Draws) -> Table:
    """Return medians with their intervals."""
    rows = []
    for method in steps.METHODS:
        middle, ends = draws.compute_median(method), draws.compute_interval(method)
        cells: list[Cell] = []
        for i in (0, 1, 2):
            low, high = (f"{e[i]:.2g}" if np.isfinite(e[i]) else DIVERGED for e in ends)
            cells += [show_number(middle[i]), f"{low} to {high}"]
        after: list[Cell] = [None, None]
        if method in draws.commanded:
            after = [show_number(x) for x in np.median(draws.commanded[method], axis=0)]
        lost = np.isinf(draws.errors[method][:, 0]).sum()
        rows.append((method, *cells, *after, show_number(middle[3]), lost))
    name = f"draws_{steps.ROBOTS[draws.name].replace('-', '_')}"
    return TEXT.table("draws", rows, name, name=draws.name, trials=len(draws))


def make_ratios(draws: Draws) -> Table:
    """Return ratios of medians: MAP, the default kind of fit, over each of the others."""
    rows = []
    for other in COMPARED:
        columns = (draws.compute_ratio(PRIOR, other), *draws.compute_ratio_interval(PRIOR, other))
        cells = (show_number(column[i]) for i in (0, 1) for column in columns)
        rows.append((f"MAP over {other}", *cells))
    name = f"ratios_{steps.ROBOTS[draws.name].replace('-', '_')}"
    return TEXT.table("ratios", rows, name, name=draws.name, trials=len(draws))


def make_median_curves(situation: Situation) -> Table:
    """Return median errors at every lambda and k."""
    rows, short = [], np.median(situation.short, axis=0)[:, :2]
    for algorithm, settings in situation.settings.items():
        for i, errors in enumerate(situation.compute_median(algorithm)[:, :3]):
            early: list[Cell] = [None, None]
            if algorithm == RE and i > 0:
                early = [show_number(x) for x in short[i - 1]]
            rows.append((algorithm, settings[i], *map(show_number, errors), *early))
    name = f"curves_{situation.file}_machines"
    data = {"name": situation.label, "trials": len(situation)}
    return TEXT.table("median_curves", rows, name, **data)


def to_document(draws: Draws, seed: int) -> dict[str, Any]:
    """Return the draws for evidence: tables by name, and which curves have an interior minimum."""
    tables = {
        "medians": make_medians(draws),
        "ratios": make_ratios(draws),
        "curves": make_median_curves(draws.six),
        "curves_5": make_median_curves(draws.five),
    }

    def describe(situation: Situation, algorithm: str, measure: int) -> dict[str, Any]:
        median = situation.compute_median(algorithm)[:, measure]
        is_higher = situation.compute_rises(algorithm, measure) > GAIN
        return {"median": steps.compute_rise(median) > GAIN, "machines": int(is_higher.sum())}

    inside = {
        str(situation.freedoms): {
            algorithm: {name: describe(situation, algorithm, i)
                        for i, name in enumerate(steps.MEASURES[:2])}
            for algorithm in (RE, TSVD)
        }
        for situation in draws.situations
    }  # fmt: skip
    columns = ("columns", "formats", "rows")
    return {
        "robot": draws.name,
        "seed": seed,
        "draws": len(draws),
        "minimum_inside": inside,
        "tables": {
            name: {key: [list(x) if key == "rows" else x for x in getattr(table, key)]
                   for key in columns}
            for name, table in tables.items()
        },
    }  # fmt: skip


def collect_history(case: Case, algorithm: str) -> tuple[IntArray, FloatArray]:
    """Return iterations (k + 1,) and identified errors (k + 1, p) [mm, rad] of LS, or of RE or TSVD
    at their best setting; NaN after a step that diverged.
    """
    sweep, i = _find_run(case, algorithm)
    done, history = sweep.runs.done[:, i], sweep.runs.history[:, i]
    end = int(np.searchsorted(done, done[-1])) + 1
    return done[:end], to_paper_units(case.study, history[:end])


def _find_run(case: Case, algorithm: str) -> tuple[steps.Sweep, int]:
    sweep = case.sweeps[RE if algorithm == RE else TSVD]
    return sweep, 0 if algorithm == LS else sweep.best


def to_paper_units(measured: steps.Study, values: FloatArray) -> FloatArray:
    """Return deviations from nominal [mm, rad] of values (.., p)."""
    return (values - measured.robot.parameters.nominal) / steps.list_scales(measured.robot)


def list_units(robot: Mechanism) -> tuple[str, ...]:
    """Return the unit of each of the paper's raw numbers (p,)."""
    return tuple("mm" if d is Dimension.LENGTH else "rad" for d in robot.parameters.dimensions)


def make_figures(results: Results) -> tuple[Figure, ...]:
    """Return all figures: the analogues of figures 6 to 11, and medians over many machines."""
    figures = []
    for draws, situation in ((d, s) for d in results.draws for s in d.situations):
        prior = draws.compute_median(PRIOR if situation.freedoms == 6 else PRIOR_FIVE)
        for algorithm, first in ((RE, 1), (TSVD, 0)):  # lambda = 0 has no place on its axis
            settings, errors = situation.settings[algorithm], situation.compute_median(algorithm)
            file = f"medians_{situation.file}_{algorithm.lower()}"
            drawn = algorithm, settings[first:], errors[first:], prior
            data = {"name": situation.label, "trials": len(draws)}
            figures.append(_draw_curve("medians", file, *drawn, **data))
    for case in results.cases.values():
        number, prior = FIGURES[case.study.name, case.study.freedoms], case.answers[PRIOR].errors
        for algorithm, part in ((RE, "a"), (TSVD, "b")):
            sweep = case.sweeps[algorithm]
            drawn = algorithm, sweep.settings, sweep.errors, prior
            data = {"number": f"{number}({part})", "case": case.study.label,
                    "best": case.answers[algorithm].setting,
                    "diverged": int(sweep.runs.is_diverged.sum())}  # fmt: skip
            figures.append(_draw_curve("curve", f"figure_{number}{part}", *drawn, **data))
    for freedoms, algorithms in ((6, (LS, RE, TSVD)), (5, (RE, TSVD))):
        case = results.cases["RU-PUS-PRS", freedoms]
        figures += [_draw_history(case, a, unit) for a in algorithms for unit in ("mm", "rad")]
    return (*figures, _draw_steps(results))


def _draw_curve(
    text: str, file: str, algorithm: str, settings: FloatArray, errors: FloatArray,
    prior: FloatArray, **data: Any,
) -> Figure:  # fmt: skip
    """Return position and angle errors (s, ..) over the settings (s,), and those of MAP.

    Settings that diverged have no error; they are a series of their own at the upper end.
    """
    usable = np.isfinite(errors[:, :2]).all(axis=1)
    lines = [Series.of(label, settings[usable], errors[usable, i])
             for i, label in enumerate(LABELS)]  # fmt: skip
    if not usable.all():
        top = float(errors[usable, :2].max(initial=0.0)) or 1.0
        lines.append(Series.of(DIVERGED, settings[~usable], [top] * int((~usable).sum())))
    levels = {f"MAP, {label}": float(prior[i]) for i, label in enumerate(LABELS)}
    data |= {"algorithm": algorithm, "setting": SETTING[algorithm]}
    return TEXT.figure(text, lines, levels, file, LOG[algorithm], **data)


def _draw_history(case: Case, algorithm: str, unit: str) -> Figure:
    """Return the parameters of one unit by iteration; those that RE changes most are named."""
    names, units = case.study.robot.parameters.names, list_units(case.study.robot)
    chosen = [i for i, u in enumerate(units) if u == unit]
    reference = collect_history(case, RE)[1][-1]
    named = sorted(chosen, key=lambda i: -abs(reference[i]))[:NAMED]
    done, values = collect_history(case, algorithm)
    log = "x" if done[-1] > LONG else ""
    usable = np.isfinite(values).all(axis=1) & ((done > 0) | (log == ""))
    lines = [
        Series.of(names[i] if i in named else f"_{names[i]}", done[usable], values[usable, i])
        for i in (*named, *(i for i in chosen if i not in named))
    ]
    answer, what = case.answers[algorithm], "lengths" if unit == "mm" else "angles"
    number = HISTORIES[case.study.freedoms]
    method = algorithm if algorithm == LS else f"{algorithm} ({answer.setting})"
    return TEXT.figure(
        "history", lines, None, f"figure_{number}_{algorithm.lower()}_{what}", log, number=number,
        method=f"{method}, {DIVERGED}" if answer.is_diverged else method, what=what, unit=unit,
        case=case.study.label, chosen=len(chosen), count=len(names), named=len(named),
        file=case.study.file, diverged=answer.is_diverged,
    )  # fmt: skip


def _draw_steps(results: Results) -> Figure:
    """Return the largest component of each step."""
    lines, longest = [], 0
    for name in steps.ROBOTS:
        case = results.cases[name, 6]
        for algorithm in (LS, RE, TSVD):
            sweep, i = _find_run(case, algorithm)
            done, sizes = sweep.runs.done[:, i], sweep.runs.steps[:, i]
            end = int(np.searchsorted(done, done[-1]))
            done, usable = done[:end] + 1, np.isfinite(sizes[:end])
            lost = f" ({DIVERGED})" * case.answers[algorithm].is_diverged
            label = f"{algorithm}, {name}{lost}"
            lines.append(Series.of(label, done[usable], sizes[:end][usable]))
            longest = max(longest, int(done.max(initial=0)))
    log = "xy" if longest > LONG else "y"
    return TEXT.figure("convergence", lines, {"end of the iteration": 1e-6}, "", log)


Numbers = Mapping[str, Any]
"""Quantity -> (t,) its number in each draw."""


def judge_claims(results: Results) -> tuple[Verdict, ...]:
    """Return a verdict for each claim."""
    draws = results.draws
    situations = {s.label: s for draw in draws for s in draw.situations}
    six, five = ({draw.situations[i].label: draw for draw in draws} for i in (0, 1))
    before = {s.label: (draw, s) for draw in draws for s in draw.situations}
    trials, judge = len(draws[0]), _judge_places
    with np.errstate(divide="ignore", invalid="ignore"):
        return (
            *map(_judge_curve, situations.values()),
            judge("ls_stable", six, _find_diverged, limit=LINEARIZATIONS),
            judge("ls_not_best", six, _compare_unseen),
            judge("tsvd_best", situations, _compare_best, trials=trials),
            judge("ls_fails", five, _compare_five),
            judge("no_solution", five, _compare_exact),
            judge("six_better", {draw.name: draw for draw in draws}, _compare_parameters),
            judge("deviate", before, _compare_deviations),
            judge("faster", situations, _compare_speed),
            _judge_lambda(results),
            _judge_ratio(draws, "no_rule", CROSS, RAW_RE),
            judge("k_near_j", situations, _find_best_k),
            _judge_noise(results.noise),
            *_judge_own_checks(draws),
        )


def _judge_places(
    claim: str, places: Mapping[str, Any], compare: Callable[[Any], tuple[Numbers, dict[str, Any]]],
    **data: Any,
) -> Verdict:  # fmt: skip
    """Judge a claim that holds in a draw if it holds in all places; `compare` returns the numbers
    of a place, and those that the evidence shows.
    """
    numbers, rows = {}, []
    for label, place in places.items():
        numbers[label], row = compare(place)
        rows.append({"name": label, **row})
    return TEXT.claim(claim).judge_everywhere(numbers, rows=rows, **data)


def _judge_curve(situation: Situation) -> Verdict:
    """Judge the curves over lambda and k of one figure: position and angle, each machine."""
    rises = {a: [situation.compute_rises(a, i) for i in (0, 1)] for a in (RE, TSVD)}
    errors = ("position", "angle")
    places = {error: {"least_ridge": rises[RE][i], "least_tsvd": rises[TSVD][i]}
              for i, error in enumerate(errors)}  # fmt: skip
    curves = [
        {"letter": SETTING[algorithm], "error": error, "count": int((rise[i] > GAIN).sum()),
         "of": len(situation), **_describe_curve(situation, algorithm, i)}
        for algorithm, rise in rises.items() for i, error in enumerate(errors)
    ]  # fmt: skip
    short = [
        sum(steps.compute_rise(curve) > GAIN for curve in situation.short[:, :, i]) for i in (0, 1)
    ]
    return TEXT.claim("u_shape").judge_everywhere(
        places, name=situation.label, curves=curves, iterations=steps.SHORT,
        number=FIGURES[situation.name, situation.freedoms], short=short,
    )  # fmt: skip


def _describe_curve(situation: Situation, algorithm: str, i: int) -> dict[str, str]:
    curve, settings = situation.compute_median(algorithm)[:, i], situation.settings[algorithm]
    usable = np.flatnonzero(np.isfinite(curve))
    if not usable.size:
        return dict.fromkeys(("first", "least", "last"), DIVERGED)
    best = usable[np.argmin(curve[usable])]
    return {
        name: f"{curve[j]:.2g} {('mm', 'deg')[i]} at {settings[j]:.2g}"
        for name, j in (("first", usable[0]), ("least", best), ("last", usable[-1]))
    }


def _find_diverged(draw: Draws) -> tuple[Numbers, dict[str, Any]]:
    """Return where LS diverges, and its iterations, with 6-DOF measurement."""
    lost, count = np.isinf(draw.six.chosen[LS].errors[:, 0]), draw.six.chosen[LS].iterations
    row = {"diverged": int(lost.sum()), "slow": int((count >= LINEARIZATIONS).sum())}
    return {"most_diverged": lost, "most_iterations": count}, row


def _compare_unseen(draw: Draws) -> tuple[Numbers, dict[str, Any]]:
    """Compare RE and TSVD with LS at settings that were best on other machines."""
    ratios = {key: draw.six.compare_unseen(a) for key, a in (("ridge", RE), ("tsvd", TSVD))}
    row = {key: format_pair(np.median(ratio, axis=0)) for key, ratio in ratios.items()}
    return {f"most_{key}": ratio.max(axis=1) for key, ratio in ratios.items()}, row


def _compare_best(situation: Situation) -> tuple[Numbers, dict[str, Any]]:
    """Compare TSVD with LS and RE, each of the three at the bottom of its curve."""
    chosen = {key: situation.chosen[a] for key, a in (("ls", LS), ("ridge", RE), ("tsvd", TSVD))}
    tsvd, ridge = chosen["tsvd"], chosen["ridge"]
    numbers = {
        f"most_{key}": (tsvd.errors[:, :2] / chosen[key].errors[:, :2]).max(axis=1)
        for key in ("ridge", "ls")
    }
    medians = {key: np.median(of.errors, axis=0) for key, of in chosen.items()}
    commanded = int(((tsvd.commanded / ridge.commanded).max(axis=1) <= 1.0).sum())
    return numbers, {"commanded": commanded, **format_all(**medians)}


def _compare_five(draw: Draws) -> tuple[Numbers, dict[str, Any]]:
    """Return where LS diverges with 5-DOF measurement, and by how much RE and TSVD improve."""
    chosen = draw.five.chosen
    ridge, tsvd = (_compare_with_before(draw, chosen[a].errors) for a in (RE, TSVD))
    lost = np.isinf(chosen[LS].errors[:, 0])
    row = {"diverged": int(lost.sum()), "of": len(lost), "ridge": float(np.median(ridge)),
           "tsvd": float(np.median(tsvd))}  # fmt: skip
    return {"least_diverged": lost, "most_ridge": ridge, "most_tsvd": tsvd}, row


def _compare_with_before(draw: Draws, errors: FloatArray) -> FloatArray:
    """Return the larger of the errors (t, 5) in position and angle, relative to those before."""
    return (errors[:, :2] / draw.errors[BEFORE][:, :2]).max(axis=1)


def _compare_exact(draw: Draws) -> tuple[Numbers, dict[str, Any]]:
    """Return the error of the poses that exact 5-DOF measurements leave."""
    exact = draw.five.exact
    left = "{:.0e} mm / {:.0e} deg".format(*exact.max(axis=0)[:2])
    row = {"left": left, "parameters": float(np.median(exact[:, 3]))}
    return {"least_left": _compare_with_before(draw, exact)}, row


def _compare_parameters(draw: Draws) -> tuple[Numbers, dict[str, Any]]:
    """Compare the parameter errors of the paper's RE and TSVD with 5- and 6-DOF measurement."""
    numbers, row = {}, {}
    for key, algorithm in (("ridge", RE), ("tsvd", TSVD)):
        six, five = (s.chosen[algorithm].errors[:, 3] for s in draw.situations)
        numbers[f"least_{key}"] = five / six
        row |= {f"{key}_six": float(np.median(six)), f"{key}_five": float(np.median(five))}
    prior = {"six": draw.compute_median(PRIOR)[3], "five": draw.compute_median(PRIOR_FIVE)[3]}
    return numbers, {**row, **prior}


def _compare_deviations(place: tuple[Draws, Situation]) -> tuple[Numbers, dict[str, Any]]:
    """Return both halves: parameters farther from the truth than nominal, and better poses."""
    draw, situation = place
    used = [situation.chosen[a].errors for a in (RANKED, RE, TSVD)]
    worse = np.array([errors[:, 4] for errors in used])
    left = np.array([_compare_with_before(draw, errors) for errors in used])
    shares = dict(zip(("ls", "ridge", "tsvd"), np.median(worse, axis=1), strict=True))
    numbers = {"least_worse": worse.min(axis=0), "most_left": left.max(axis=0)}
    return numbers, {**shares, "left": np.median(left)}


def _compare_speed(situation: Situation) -> tuple[Numbers, dict[str, Any]]:
    chosen = {"ls": RANKED, "ridge": RE, "tsvd": TSVD}
    counts = {key: situation.chosen[a].iterations for key, a in chosen.items()}
    numbers = {f"most_{key}": counts["tsvd"] / counts[key] for key in ("ls", "ridge")}
    return numbers, {key: f"{np.median(count):,.0f}" for key, count in counts.items()}


def _find_best_k(situation: Situation) -> tuple[Numbers, dict[str, Any]]:
    """Return the best k, all parameters included, by its distance from their number."""
    ks = situation.settings[TSVD].astype(int)
    best = np.array([ks[steps.find_bottom(curve)] for curve in situation.curves[TSVD]])
    distance = (ks[0] - best) / ks[0]
    row = {"low": int(best.min()), "high": int(best.max()), "middle": float(np.median(best)),
           "of": int(ks[0])}  # fmt: skip
    return {"most_distance": distance, "least_distance": distance}, row


def _judge_lambda(results: Results) -> Verdict:
    """Judge the range of the best lambda, looked for beyond that range, and its differences."""
    best = {s.label: s.chosen[RE].settings for d in results.draws for s in d.situations}
    first, *others = (draws.six.chosen[RE].settings for draws in results.draws)
    apart = np.max([np.maximum(first / other, other / first) for other in others], axis=0)
    values = np.array(list(best.values()))
    numbers = {"least_lambda": values.min(axis=0), "most_lambda": values.max(axis=0),
               "least_factor": apart}  # fmt: skip
    rows = [{"name": name, "low": s.min(), "middle": np.median(s), "high": s.max()}
            for name, s in best.items()]  # fmt: skip
    by_steps = [{"end": f"after {n}" if isinstance(n, int) else n, "value": value}
                for n, value, _ in results.ridge_steps]  # fmt: skip
    low, high = steps.LAMBDAS.min(), steps.LAMBDAS.max()
    claim = TEXT.claim("lambda_range")
    return claim.judge_everywhere({"": numbers}, rows=rows, by_steps=by_steps, low=low, high=high)


def _judge_noise(noise: Printed) -> Verdict:
    shares = noise.values * np.array([steps.MM] * 3 + [1.0] * 3) / steps.LIMITS
    largest, rms = np.abs(noise.values).max(axis=0), float(np.sqrt(np.mean(shares**2)))
    # three standard deviations of the rms of that many uniform numbers
    spread = 3.0 * np.sqrt(4.0 / 45.0 / shares.size) / (2.0 / np.sqrt(3.0))
    return TEXT.claim("noise").judge(
        largest=float(np.abs(shares).max()), off=abs(rms - 1.0 / np.sqrt(3.0)), allowed=spread,
        count=shares.size, length=largest[:3].max(), angle=largest[3:].max(),
        degrees=np.rad2deg(largest[3:].max()), rms=rms,
    )  # fmt: skip


def _judge_own_checks(draws: Sequence[Draws]) -> tuple[Verdict, ...]:
    """Judge rank detection and units, and MAP: against the raw methods, with wrong tolerances, and
    near the best choice.
    """
    raw = (RAW_LS, RAW_RE, RAW_TSVD)
    methods = {"prior": PRIOR, "narrow": NARROW, "wide": WIDE, "ls": RAW_LS, "six": RAW_LS,
               "ridge": RAW_RE, "tsvd": RAW_TSVD, "five": RAW_FIVE}  # fmt: skip
    rows = [
        {"name": d.name, **format_all(**{key: d.compute_median(m) for key, m in methods.items()}),
         "gcv": format_pair(d.compute_ratio(PRIOR, CROSS)),
         "hindsight": format_pair(d.compute_ratio(PRIOR, HINDSIGHT))}
        for d in draws
    ]  # fmt: skip
    better = {"most": [(PRIOR, m) for m in raw]}
    wrong = {"most": [(p, m) for p in (NARROW, WIDE) for m in raw]}
    near = {"gcv": [(PRIOR, CROSS)], "hindsight": [(PRIOR, HINDSIGHT)]}
    tripod = [d for d in draws if d.name == "3-PRS"]
    return (
        _judge_groups("five_usable", draws, {"most": [(RAW_FIVE, RAW_LS)]}, rows=rows),
        _judge_ratio(draws, "mixed_units", WHITENED, RAW_LS, first=1),
        _judge_groups("map_better", draws, better, rows=rows),
        _judge_groups("map_tolerances", draws, wrong, rows=rows, factor=steps.FACTOR),
        _judge_groups("map_near_best", tripod, near, rows=rows),
    )


def _judge_ratio(
    draws: Sequence[Draws], claim: str, method: str, other: str, first: int = 0
) -> Verdict:
    """Judge one ratio of medians, see `_judge_groups`."""
    ratios = [{"name": d.name, "ratio": format_pair(d.compute_ratio(method, other)[first:2])}
              for d in draws]  # fmt: skip
    return _judge_groups(claim, draws, {"most": [(method, other)]}, first, ratios=ratios)


def _judge_groups(
    claim: str, draws: Sequence[Draws], pairs: Mapping[str, list[tuple[str, str]]], first: int = 0,
    /, **data: Any,
) -> Verdict:  # fmt: skip
    """Judge ratios of medians in each group of machines.

    A number is the largest of its ratios, of all structures, in position and angle, or with
    first = 1 in the angle alone.
    """
    groups = [
        {
            name: float(np.max([d.compute_ratio(*pair)[first:2] for d in members for pair in of]))
            for name, of in pairs.items()
        }
        for members in zip(*(draw.list_groups() for draw in draws), strict=True)
    ]
    return TEXT.claim(claim).judge(groups, groups=len(groups), trials=len(draws[0]), **data)


def format_all(**errors: FloatArray) -> dict[str, str]:
    """Return errors in position and angle as text."""
    return {
        name: f"{e[0]:.2g} mm / {e[1]:.2g} deg" if np.isfinite(e[:2]).all() else DIVERGED
        for name, e in errors.items()
    }


def format_pair(values: FloatArray) -> str:
    """Return ratios in position and angle as text; DIVERGED for one that is not finite."""
    return " and ".join(f"{v:.2f}" if np.isfinite(v) else DIVERGED for v in values[:2])
