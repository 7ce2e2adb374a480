# SPDX-License-Identifier: Apache-2.0
"""The whole study: drawn machines of both manipulators with 6- and 5-DOF measurement; its tables,
figures and verdicts.

The paper simulates one machine of each structure. Here each drawn pair of machines is one draw of
that simulation, the first of them with the printed noise: it is the machine of single tables and
figures. A claim is judged in every draw; it holds in a draw if it holds in all situations it speaks
of, and a draw in which neither of two methods is better decides nothing.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np

from loopcal.mechanism.platform_coordinates import POSITION
from loopcal.papers import published
from loopcal.papers.paper import StudyCase
from loopcal.papers.tsvd_2016 import steps
from loopcal.papers.tsvd_2016.steps import (
    BEFORE,
    CROSS,
    EARLY,
    LS,
    PICTURED,
    PRIOR,
    RANKED,
    RE,
    SIZES,
    TSVD,
    WHITENED,
    Sweep,
)
from loopcal.studies.simulation.published_steps import LINEARIZATIONS, list_raw_units
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

TEXT = published.PaperText(__file__)
DIVERGED = "diverged"  # cell of a number that a diverged fit does not have
ROUNDING = 1e-10  # size below which an error [mm, deg, spreads] is rounding
NOISE_COLUMNS = ("X [mm]", "Y [mm]", "Z [mm]", "phi [rad]", "theta [rad]", "psi [rad]")
# Of a robot file, as far as it has them.
DIMENSIONS = ("platform_radius", "base_radius", "rod", "post")
# Methods and measured coordinates of the columns of the identified errors.
IDENTIFIED = (
    (LS, 6), (EARLY, 6), (RE, 6), (TSVD, 6), (RANKED, 5), (EARLY, 5), (RE, 5), (TSVD, 5),
    (WHITENED, 6), (PRIOR, 6), (PRIOR, 5),
)  # fmt: skip
# Tables of the paper with identified parameters and with output errors.
TABLES = {"identified": {"RU-PUS-PRS": 5, "3-PRS": 6}, "outputs": {"RU-PUS-PRS": 7, "3-PRS": 8}}
# Figures of the paper with curves over lambda and k.
FIGURES = {("RU-PUS-PRS", 6): 6, ("RU-PUS-PRS", 5): 8, ("3-PRS", 6): 10, ("3-PRS", 5): 11}
# Figures of the paper with parameters by iteration, RU-PUS-PRS, by measured coordinates.
HISTORIES = {6: 7, 5: 9}
NAMED, LONG = 6, 50
"""Parameters named in a legend, and iterations above which their axis is logarithmic."""
LABELS = ("position [mm]", "phi and theta [deg]")
CURVES: Mapping[str, tuple[str, ...]] = {"RE": (RE, EARLY), "TSVD": (TSVD,)}  # in one figure
SETTING, LOG = {RE: "lambda", TSVD: "k"}, {RE: "xy", TSVD: "y"}
NAMES = {"ls": LS, "ridge": RE, "tsvd": TSVD}  # of the paper's methods that claims are judged by
SHOWN = NAMES | {"early": EARLY}  # of those in the evidence of claims
Place = TypeVar("Place")


Draws = tuple[Sweep, ...]
"""Machines of a manipulator: with all measured coordinates and, if possible, without psi."""


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged."""

    draws: Mapping[str, Draws]  # by manipulator
    # see `steps.follow_ridge`, the last manipulator with all measured coordinates
    ridge_steps: list[tuple[int | str, float, bool, FloatArray]]
    noise: published.Printed  # Appendix 1 as printed
    is_adapted: bool = False  # to another robot

    @property
    def sweeps(self) -> dict[str, Sweep]:
        """By manipulator and measurement."""
        return {sweep.study.label: sweep for draws in self.draws.values() for sweep in draws}

    @property
    def design(self) -> steps.Design:
        """The first manipulator."""
        return next(iter(self.sweeps.values())).study.design


def compute(
    seed: int, trials: int, progress: Callable[[str], None], case: StudyCase | None = None
) -> Results:
    """Compute everything."""
    if case is None or case.robot is None:
        designs = [*map(steps.load_design, steps.ROBOTS)]
    else:
        designs = [steps.adapt_design(case)]
    draws = {design.name: steps.simulate_machines(design, seed, trials, progress)
             for design in designs}  # fmt: skip
    progress("ridge steps")
    followed = steps.follow_ridge([*draws.values()][-1][0])
    return Results(
        draws, followed, steps.PRINTED.table("appendix_1"), designs[0].errors is not None
    )


def show_number(value: float) -> published.Cell:
    """Return a number as a cell: rounding as 0, and what is not finite as a fit that diverged."""
    if not np.isfinite(value):
        return DIVERGED
    return float(value) if abs(value) > ROUNDING else 0.0


def show_all(values: Iterable[float]) -> list[published.Cell]:
    """Return numbers as cells, see `show_number`."""
    return [show_number(value) for value in values]


def show_errors(design: steps.Design, values: Iterable[float]) -> list[published.Cell]:
    """Return errors in the order of MEASURES as cells; None for a part that the platform lacks."""
    return [show_number(value) if i > 2 or min(i, 1) in design.parts else None
            for i, value in enumerate(values)]  # fmt: skip


def compare_tables(results: Results) -> Iterator[published.Comparison]:
    """Yield the numbers that the text states, beside the computed ranks; none of another robot."""
    if results.is_adapted:
        return
    tripod = results.draws["3-PRS"][0].study
    chain = sum("1" in name for name in tripod.robot.parameters.names)
    ranks = [steps.find_rank(results.draws[name][0].study) for name in ("RU-PUS-PRS", "3-PRS")]
    numbers = (*ranks, chain, len(tripod.trials.readings))
    computed = np.array(numbers, dtype=np.float64)[:, None]
    yield TEXT.compare("counts", steps.PRINTED.table("counts"), computed)


def make_tables(results: Results) -> Iterator[published.Table]:
    """Yield all tables: the analogues of Tables 1 to 8, and the figures as numbers."""
    draws, noise, data = results.draws, results.noise.values, describe_design(results.design)
    machines = [row for of in draws.values() for row in _list_machine(of[0].study.design)]
    yield TEXT.table("given", machines, **data)

    limits = steps.list_limits() * np.array([1e3] * 3 + [1.0] * 3)
    largest, rms = np.abs(noise).max(axis=0), np.sqrt(np.mean(noise**2, axis=0))
    columns = (NOISE_COLUMNS, largest, limits, rms, limits / np.sqrt(3.0))
    yield TEXT.table("noise", zip(*columns, strict=True))

    ranks: list[tuple[Any, ...]] = []
    for label, sweep in results.sweeps.items():
        s, known, rank = sweep.singular_values, sweep.study.known, steps.find_rank(sweep.study)
        null = "; ".join(map(str, known.unidentifiable)) or None
        values = (s[0], s[-2], s[-1], s[0] / s[rank - 1], known.condition)
        ranks.append((label, f"{rank} of {len(s)}", *values, null))
    yield TEXT.table("ranks", ranks)

    yield from map(_list_outputs, draws.values())
    yield from map(make_medians, draws.values())

    ridge = [(n, lam, "no" if is_at_end else "yes", *show_errors(sweep.study.design, errors[:2]))
             for sweep in [[*draws.values()][-1][0]]
             for n, lam, is_at_end, errors in results.ridge_steps]  # fmt: skip
    yield TEXT.table("ridge_steps", ridge, name=[*draws.values()][-1][0].study.label)

    yield from map(_list_identified, draws.values())
    yield from map(make_curves, results.sweeps.values())

    for sweep in results.sweeps.values():
        study, name = sweep.study, f"history_{sweep.study.file}"
        history = [
            (algorithm, i, *show_all(values))
            for algorithm in PICTURED
            for i, values in zip(*collect_history(sweep, algorithm), strict=True)
        ]
        more = [(f"{parameter} [{unit}]", ".3g") for parameter, unit in list_labels(study)]
        yield TEXT.table("history", history, name, more, case=study.label)


def describe_design(design: steps.Design) -> dict[str, Any]:
    """Return what claims, captions and notes say of a structure and of its measurement."""
    return {"robot": design.name, "is_ours": bool(design.printed),
            "measured": f"{len(design.columns)}-DOF", "poses": len(design.poses),
            "checked": len(design.output_range),
            "parts": [("position", "angle")[i] for i in design.parts]}  # fmt: skip


def _list_machine(design: steps.Design) -> list[tuple[str, str, str]]:
    name, robot = design.name, design.robot
    sizes = vars(robot.record.record)  # of the file: dimensions in SI
    rows = [(name, size.replace("_", " "), f"{1e3 * sizes[size]:g} mm")
            for size in DIMENSIONS if isinstance(sizes.get(size), float)]  # fmt: skip
    rows += [(name, "error parameters", f"{len(design.free)}")]
    for what, poses in (("measured", design.poses), ("output range", design.output_range)):
        rows += [(name, what, f"{len(poses)} poses: {', '.join(list_ranges(design, poses))}")]
    return [*rows, (name, "coordinates", " ".join(design.columns))]


def list_ranges(design: steps.Design, poses: FloatArray) -> list[str]:
    """Return the range of each controlled coordinate of poses (n, c), such as `z 650 to 750 mm`."""
    ranges = []
    for name, values in zip(design.robot.controlled, poses.T, strict=True):
        factor, unit = (1e3, "mm") if name in POSITION else (np.rad2deg(1.0), "deg")
        ends = dict.fromkeys(f"{factor * end:.4g}" for end in (values.min(), values.max()))
        ranges.append(f"{name} {' to '.join(ends)} {unit}")
    return ranges


def _list_outputs(draws: Draws) -> published.Table:
    """Return the errors of the first machine by all methods."""
    study = draws[0].study
    design, rows = study.design, list[tuple[Any, ...]]()
    rows.append(("", BEFORE, None, *show_errors(design, study.before[0, :4]), None, None))
    for sweep in draws:
        for method, answer in sweep.chosen.items():
            errors, count = answer.errors[0, :4], int(answer.iterations[0])
            is_converged = "yes" if answer.is_converged[0] else "no"
            end = (None, DIVERGED) if sweep.is_diverged(method) else (count, is_converged)
            label = (f"{sweep.study.freedoms}-DOF", method, sweep.describe_setting(method))
            rows.append((*label, *show_errors(design, errors), *end))
    return _show_table("outputs", design, rows)


def make_medians(draws: Draws) -> published.Table:
    """Return median errors by all methods, and the middle half of the machines."""
    study, rows = draws[0].study, list[tuple[Any, ...]]()
    found: list[tuple[str, str, FloatArray, int | None]] = [("", BEFORE, study.before, None)]
    for sweep in draws:
        for method, answer in sweep.chosen.items():
            end = int(sweep.are_at_end(method).sum()) if method in sweep.curves else None
            found.append((f"{sweep.study.freedoms}-DOF", method, answer.errors, end))
    for measured, method, errors, end in found:
        quartiles = np.quantile(errors, [0.25, 0.75], axis=0, method="nearest")
        middle, cells = np.median(errors, axis=0), list[published.Cell]()
        for i, shown in enumerate(show_errors(study.design, middle[:3])):
            ends = (f"{e[i]:.2g}" if np.isfinite(e[i]) else DIVERGED for e in quartiles)
            cells += [shown, None if shown is None else " to ".join(ends)]
        lost = int(np.isinf(errors[:, 0]).sum())
        rows.append((measured, method, *cells, show_number(middle[3]), lost, end))
    data = describe_design(study.design) | {"name": study.design.name, "trials": len(draws[0])}
    return TEXT.table("draws", rows, f"draws_{study.design.file}", **data)


def _list_identified(draws: Draws) -> published.Table:
    """Return the errors of the parameters of the first machine, true and identified."""
    study, by_freedoms = draws[0].study, {sweep.study.freedoms: sweep for sweep in draws}
    columns = [show_all(to_paper_units(study, study.trials.truth[0]))]
    for method, freedoms in IDENTIFIED:
        sweep = draws[0] if freedoms == 6 else by_freedoms.get(freedoms)
        columns.append(
            [None] * len(columns[0]) if sweep is None
            else show_all(to_paper_units(study, sweep.chosen[method].values[0]))
        )  # fmt: skip
    rows = [(*label, *row) for label, *row in zip(list_labels(study), *columns, strict=True)]
    return _show_table("identified", study.design, rows)


def _show_table(name: str, design: steps.Design, rows: Iterable[Sequence[Any]]) -> published.Table:
    """Return a table of the first machine, in place of one of the paper for its manipulators."""
    number = TABLES[name].get(design.printed)
    file = f"table_{number}" if number else f"{name}_{design.file}"
    data = describe_design(design) | {"name": design.name, "number": number or ""}
    return TEXT.table(name, rows, file, **data)


def make_curves(sweep: Sweep) -> published.Table:
    """Return errors at every lambda and k, of the first machine and in the median; a page shows the
    bottom of each curve of the first machine, and beside it.
    """
    rows, shown, design = list[tuple[Any, ...]](), list[int](), sweep.study.design
    for algorithm, settings in sweep.settings.items():
        first = int(algorithm != TSVD)  # lambda = 0 is LS
        curve, start = sweep.curves[algorithm][:1, first:], len(rows)
        bottom = int(steps.locate_bottoms(curve, design.parts)[0, -1])
        shown += range(start + max(bottom - 1, 0), start + min(bottom + 2, curve.shape[1]))
        median = sweep.compute_median(algorithm)[first:]
        counts = sweep.counts[algorithm][0, first:]
        for i, setting in enumerate(settings[first:]):
            errors = (show_errors(design, e[i, :3]) for e in (curve[0], median))
            rows.append((algorithm, setting, *next(errors), int(counts[i]), *next(errors)))
    data = describe_design(design) | {"case": sweep.study.label, "trials": len(sweep)}
    return TEXT.table("curves", rows, f"curves_{sweep.study.file}", (), shown, **data)


def collect_history(sweep: Sweep, algorithm: str) -> tuple[IntArray, FloatArray]:
    """Return iterations (k + 1,) and identified errors (k + 1, p) [mm, rad] of one of PICTURED on
    the first machine; NaN after a step that diverged.
    """
    end = _count_drawn(sweep, algorithm) + 1
    i, runs = PICTURED.index(algorithm), sweep.runs
    return runs.done[:end, i], to_paper_units(sweep.study, runs.history[:end, i])


def _count_drawn(sweep: Sweep, algorithm: str) -> int:
    """Return how many steps of one of PICTURED are drawn."""
    done = sweep.runs.done[:, PICTURED.index(algorithm)]
    last = min(done[-1], steps.SHORT) if algorithm == EARLY else done[-1]
    return int(np.searchsorted(done, last))


def to_paper_units(study: steps.Study, values: FloatArray) -> FloatArray:
    """Return deviations from nominal [mm, rad] of the free ones of values (.., p)."""
    deviations = (values - study.robot.parameters.nominal) / list_raw_units(
        study.robot.parameters.dimensions
    )
    return deviations[..., study.design.free.places]


def list_labels(study: steps.Study) -> list[tuple[str, str]]:
    """Return the name of each parameter, and the unit of the paper's raw numbers."""
    free, known = study.design.free, {Dimension.LENGTH: "mm", Dimension.ANGLE: "rad"}
    units = [known.get(dimension, "1") for dimension in free.dimensions]
    return list(zip(free.names, units, strict=True))


def make_figures(results: Results) -> Iterator[published.Figure]:
    """Yield all figures: the analogues of figures 6 to 11, and medians over many machines."""
    for sweep in results.sweeps.values():
        study, prior, trials = sweep.study, sweep.chosen[PRIOR].errors, len(sweep)
        number = FIGURES.get((study.design.printed, study.freedoms))
        for (a, of), part in zip(CURVES.items(), "ab", strict=True):
            curves, chosen = {b: sweep.compute_median(b) for b in of}, sweep.chosen[of[0]]
            bottoms = [
                published.Series.of(f"bottom of each machine, {LABELS[part]}",
                                    chosen.settings[usable], errors[usable], False)
                for part in study.design.parts
                for errors in [chosen.errors[:, part]] for usable in [np.isfinite(errors)]
            ]  # fmt: skip
            yield _draw_curve("medians", f"medians_{study.file}_{a.lower()}", sweep, a, curves,
                              np.median(prior, axis=0), bottoms, name=study.label, trials=trials,
                              early=EARLY in of)  # fmt: skip
            curves = {b: sweep.curves[b][0] for b in of}
            file = f"figure_{number}{part}" if number else f"curve_{study.file}_{a.lower()}"
            data = {"number": number and f"{number}({part})", "case": study.label,
                    "best": "; ".join(f"{b}: {sweep.describe_setting(b)}" for b in of)}  # fmt: skip
            yield _draw_curve("curve", file, sweep, a, curves, prior[0], **data)
        if study.design.printed != "3-PRS":  # similar, says the paper
            algorithms = PICTURED[1:] if study.freedoms == 5 else PICTURED
            yield from (_draw_history(sweep, a, unit) for a in algorithms
                        for unit in dict.fromkeys(u for _, u in list_labels(study)))  # fmt: skip
    yield _draw_steps(results)


def _draw_curve(
    text: str, file: str, sweep: Sweep, kind: str, curves: Mapping[str, FloatArray],
    prior: FloatArray, points: Sequence[published.Series] = (), **data: Any,
) -> published.Figure:  # fmt: skip
    """Return position and angle errors of curves (s, ..) over their settings, those of MAP, and
    further points.

    Settings that diverged have no error; they are a series of their own at the upper end.
    """
    main, parts = CURVES[kind][0], sweep.study.design.parts
    first = int(main == RE)  # lambda = 0 has no place on its axis
    lines, lost, top = [*points], set[float](), 1.0
    for algorithm, curve in curves.items():
        settings, errors = sweep.settings[algorithm][first:], curve[first:, parts]
        usable = np.isfinite(errors).all(axis=1)
        what = f", {algorithm}" if len(curves) > 1 else ""
        lines += [published.Series.of(LABELS[part] + what, settings[usable], errors[usable, i])
                  for i, part in enumerate(parts)]  # fmt: skip
        lost |= {*settings[~usable]}
        top = float(errors[usable].max(initial=0.0)) or top
    if lost:
        lines.append(published.Series.of(DIVERGED, sorted(lost), [top] * len(lost), False))
    levels = {f"MAP, {LABELS[i]}": float(prior[i]) for i in parts}
    data |= {"algorithm": kind, "setting": SETTING[main], "diverged": len(lost),
             **describe_design(sweep.study.design)}  # fmt: skip
    return TEXT.figure(text, lines, levels, file, LOG[main], **data)


def _draw_history(sweep: Sweep, algorithm: str, unit: str) -> published.Figure:
    """Return the parameters of one unit by iteration; those that RE changes most are named."""
    labels, names = list_labels(sweep.study), sweep.study.design.free.names
    chosen = [i for i, (_, u) in enumerate(labels) if u == unit]
    reference = collect_history(sweep, RE)[1][-1]
    named = sorted(chosen, key=lambda i: -abs(reference[i]))[:NAMED]
    done, values = collect_history(sweep, algorithm)
    log = "x" if done[-1] > LONG else ""
    usable = np.isfinite(values).all(axis=1) & ((done > 0) | (log == ""))
    lines = [
        published.Series.of(
            names[i] if i in named else f"_{names[i]}", done[usable], values[usable, i]
        )
        for i in (*named, *(i for i in chosen if i not in named))
    ]
    what = {"mm": "lengths", "rad": "angles"}.get(unit, "ratios")
    is_diverged, number = sweep.is_diverged(algorithm), None
    if sweep.study.design.printed:
        number = HISTORIES[sweep.study.freedoms]
    file = f"figure_{number}" if number else f"history_{sweep.study.file}"
    method = algorithm if algorithm == LS else f"{algorithm} ({sweep.describe_setting(algorithm)})"
    slug = re.sub(r"\W+", "_", algorithm.lower())
    return TEXT.figure(
        "history", lines, None, f"{file}_{slug}_{what}", log, number=number,
        method=f"{method}, {DIVERGED}" if is_diverged else method, what=what, unit=unit,
        case=sweep.study.label, chosen=len(chosen), count=len(names), named=len(named),
        file=sweep.study.file, diverged=is_diverged,
    )  # fmt: skip


def _draw_steps(results: Results) -> published.Figure:
    """Return the largest component of each step."""
    lines, longest = [], 0
    for name, (sweep, *_) in results.draws.items():
        for i, algorithm in enumerate(PICTURED):
            end, sizes = _count_drawn(sweep, algorithm), sweep.runs.steps[:, i]
            done, usable = sweep.runs.done[:end, i] + 1, np.isfinite(sizes[:end])
            label = f"{algorithm}, {name}{f' ({DIVERGED})' * sweep.is_diverged(algorithm)}"
            lines.append(published.Series.of(label, done[usable], sizes[:end][usable]))
            longest = max(longest, int(done.max(initial=0)))
    log = "xy" if longest > LONG else "y"
    data = describe_design(results.design)
    return TEXT.figure("convergence", lines, {"end of the iteration": 1e-6}, "", log, **data)


def judge_claims(results: Results) -> tuple[published.Verdict, ...]:
    """Return a verdict for each claim; of another robot without those on printed numbers and on
    different manipulators, and without those on coordinates that it does not have.
    """
    sweeps, draws = results.sweeps, results.draws
    judge = partial(_judge_places, **describe_design(results.design))
    six = {of[0].study.label: of[0] for of in draws.values()}
    whole = {name: of[0] for name, of in draws.items()}
    pairs = {name: of for name, of in draws.items() if len(of) > 1}
    five = {of[1].study.label: of for of in pairs.values()}
    of_five = (
        judge("ls_fails", {name: of[1] for name, of in five.items()}, _compare_five),
        judge("no_solution", five, _compare_exact),
        judge("six_better", pairs, _compare_parameters),
        judge("five_usable", pairs, _compare_ranked),
    ) if five else ()  # fmt: skip
    of_paper = (_judge_lambda(results), _judge_noise(results.noise))
    return (
        *map(_judge_curve, sweeps.values()),
        judge("ls_stable", six, _find_diverged, limit=LINEARIZATIONS),
        judge("ls_not_best", six, _compare_ls),
        judge("tsvd_best", sweeps, _compare_best),
        *of_five,
        judge("deviate", sweeps, _compare_deviations),
        judge("faster", sweeps, _compare_speed),
        *(() if results.is_adapted else of_paper),
        judge("no_rule", whole, _compare_rule, is_any=True),
        judge("k_near_j", sweeps, _find_best_k, near=SIZES.find("near")),
        judge("map_better", whole, _compare_prior),
    )


class Held(NamedTuple):
    """A claim at a place: in which draws (t,) it is true and false there (neither: the draw decides
    nothing), and the numbers that the evidence shows.
    """

    holds: BoolArray
    fails: BoolArray
    row: dict[str, Any]


def _judge_places(
    claim: str, places: Mapping[str, Place], compare: Callable[[Place], Held], *,
    is_any: bool = False, **data: Any,
) -> published.Verdict:  # fmt: skip
    """Judge a claim that is true in a draw if it is true there in all places, or in any, and false
    if it is false in any place, or in all.
    """
    held = {name: compare(place) for name, place in places.items()}
    holds, fails = (np.array([h[i] for h in held.values()]) for i in (0, 1))
    true, false = (np.any, np.all) if is_any else (np.all, np.any)
    decided = [*map(published.decide, true(holds, axis=0), false(fails, axis=0))]
    rows = [{"name": name, **h.row} for name, h in held.items()]
    shares = [{"name": name, "count": int(h.holds.sum()), "against": int(h.fails.sum()),
               "of": len(h.holds)} for name, h in held.items()]  # fmt: skip
    return TEXT.judge(claim, decided, rows=rows, shares=shares, **data)


def _judge_curve(sweep: Sweep) -> published.Verdict:
    """Judge the curves over lambda and k of one figure: position and angle, each machine. An end
    that is the least but for the gain decides nothing.
    """
    gain, curves = SIZES.find("gain"), []
    holds, fails = np.ones(len(sweep), dtype=bool), np.zeros(len(sweep), dtype=bool)
    for algorithm in (RE, TSVD):
        for i in sweep.study.design.parts:
            error = ("position", "angle")[i]
            rises = sweep.compute_rises(algorithm, i)
            holds, fails = holds & (rises > gain), fails | (rises <= 1.0)
            curves.append(
                {"letter": SETTING[algorithm], "error": error, "count": int((rises > gain).sum()),
                 "of": len(sweep), **_describe_curve(sweep, algorithm, i)}
            )  # fmt: skip
    short = [
        {"error": ("position", "angle")[i],
         "count": sum(steps.compute_rise(c) > gain for c in sweep.curves[EARLY][:, 1:, i])}
        for i in sweep.study.design.parts
    ]  # fmt: skip
    return TEXT.judge(
        "u_shape", [*map(published.decide, holds, fails)], name=sweep.study.label, curves=curves,
        iterations=SIZES.find("short"),
        number=FIGURES.get((sweep.study.design.printed, sweep.study.freedoms)), short=short,
        **describe_design(sweep.study.design),
    )  # fmt: skip


def _describe_curve(sweep: Sweep, algorithm: str, i: int) -> dict[str, str]:
    curve, settings = sweep.compute_median(algorithm)[:, i], sweep.settings[algorithm]
    usable = np.flatnonzero(np.isfinite(curve))
    if not usable.size:
        return dict.fromkeys(("first", "least", "last"), DIVERGED)
    best = usable[np.argmin(curve[usable])]
    return {
        name: f"{curve[j]:.2g} {('mm', 'deg')[i]} at {settings[j]:.2g}"
        for name, j in (("first", usable[0]), ("least", best), ("last", usable[-1]))
    }


def _find_diverged(sweep: Sweep) -> Held:
    """Return where LS diverges, and its iterations, with 6-DOF measurement."""
    ls = sweep.chosen[LS]
    is_lost = np.isinf(ls.errors[:, 0])
    row = {"diverged": int(is_lost.sum()), "slow": int((~is_lost & ~ls.is_converged).sum())}
    return Held(ls.is_converged & ~is_lost, ~ls.is_converged | is_lost, row)


def _are_better(first: FloatArray, second: FloatArray, factor: float = 1.0) -> BoolArray:
    """Return where all errors (t, parts), position and angle, are below others times a factor."""
    return np.all(first < factor * second, axis=1)


def _compare_ls(sweep: Sweep) -> Held:
    """Compare LS with RE and TSVD at settings that were best on other machines. At its own best
    each is as good as LS at least, because a small lambda is LS.
    """
    unseen = {name: sweep.compare_unseen(a) for name, a in SHOWN.items() if a != LS}
    row = {name: format_pair(np.median(ratio, axis=0)) for name, ratio in unseen.items()}
    ratios = np.array([ratio for name, ratio in unseen.items() if name in NAMES])
    is_worse, is_best = np.any(np.all(ratios < 1.0, axis=2), axis=0), np.all(ratios > 1.0, (0, 2))
    return Held(is_worse, is_best, row)


def _compare_best(sweep: Sweep) -> Held:
    """Compare TSVD with LS and RE, each of the three at the bottom of its curve."""
    parts = sweep.study.design.parts
    errors = {name: sweep.chosen[a].errors[:, parts] for name, a in NAMES.items()}
    tsvd, others = errors["tsvd"], (errors["ls"], errors["ridge"])
    holds = np.all([(tsvd <= other).all(axis=1) for other in others], axis=0)
    fails = np.any([_are_better(other, tsvd) for other in others], axis=0)
    return Held(holds, fails, _show_medians(sweep, SHOWN))


def _show_medians(sweep: Sweep, names: Mapping[str, str]) -> dict[str, str]:
    """Return name -> median errors of an algorithm in position and angle as text."""
    return {name: format_errors(sweep.study.design.parts, np.median(sweep.chosen[a].errors, axis=0))
            for name, a in names.items()}  # fmt: skip


def _compare_five(sweep: Sweep) -> Held:
    """Return where LS diverges with 5-DOF measurement, and by how much RE and TSVD improve."""
    chosen = sweep.chosen
    ridge, early, tsvd = (_compare_with_before(sweep, chosen[a].errors) for a in (RE, EARLY, TSVD))
    is_lost = np.isinf(chosen[LS].errors[:, 0])
    row = {"diverged": int(is_lost.sum()), "of": len(is_lost), "ridge": float(np.median(ridge)),
           "early": float(np.median(early)), "tsvd": float(np.median(tsvd))}  # fmt: skip
    holds = is_lost & (ridge < 1.0) & (tsvd < 1.0)
    return Held(holds, ~holds, row)


def _compare_with_before(sweep: Sweep, errors: FloatArray) -> FloatArray:
    """Return the larger of the errors (t, 5) in position and angle, relative to those before."""
    parts = sweep.study.design.parts
    return (errors[:, parts] / sweep.study.before[:, parts]).max(axis=1)


def _compare_exact(draws: Draws) -> Held:
    """Return whether exact 5-DOF measurements lead to the truth, where exact 6-DOF ones do."""
    study, left = draws[1].study, draws[1].exact.max(axis=0)
    limit = SIZES.find("reached") * study.before[:, 3]
    six, five = (sweep.exact[:, 3] for sweep in draws)
    row = {"six": float(np.median(six)), "five": float(np.median(five)),
           "left": format_errors(study.design.parts, left)}  # fmt: skip
    is_decided = (six <= limit) & np.isfinite(five)
    return Held(is_decided & (five > limit), is_decided & (five <= limit), row)


def _compare_parameters(draws: Draws) -> Held:
    """Compare the parameter errors of the paper's RE and TSVD with 5- and 6-DOF measurement."""
    names, errors = {**SHOWN, "map": PRIOR}, dict[str, list[FloatArray]]()
    for name, algorithm in names.items():
        errors[name] = [sweep.chosen[algorithm].errors[:, 3] for sweep in draws]
    row = {
        f"{name}_{end}": float(np.median(of))
        for name, both in errors.items()
        for end, of in zip(("six", "five"), both, strict=True)
    }
    six, five = np.array([errors[name] for name in ("ridge", "tsvd")]).swapaxes(0, 1)
    return Held(np.all(six < five, axis=0), np.all(six > five, axis=0), row)


def _compare_deviations(sweep: Sweep) -> Held:
    """Return whether acceptable solutions, those with small errors of poses, have parameters
    farther from the truth than nominal ones.
    """
    used = [sweep.chosen[a].errors for a in (RANKED, RE, TSVD)]
    worse = np.array([errors[:, 4] for errors in used])
    left = np.array([_compare_with_before(sweep, errors) for errors in used])
    is_acceptable = left < SIZES.find("acceptable")
    row = dict(zip(NAMES, np.median(worse, axis=1), strict=True))
    fails = (is_acceptable & (worse == 0.0)).any(axis=0)
    return Held(is_acceptable.any(axis=0) & ~fails, fails, {**row, "left": np.median(left)})


def _compare_speed(sweep: Sweep) -> Held:
    """Compare iterations; a fit that does not converge needs infinitely many."""
    used = zip(SHOWN, (sweep.chosen[a] for a in (RANKED, RE, TSVD, EARLY)), strict=True)
    counts = {name: np.where(c.is_converged, c.iterations, np.inf) for name, c in used}
    least, tsvd = np.minimum(counts["ls"], counts["ridge"]), counts["tsvd"]
    medians = {name: np.median(count) for name, count in counts.items()}
    row = {n: f"{m:,.0f}" if np.isfinite(m) else "not converged" for n, m in medians.items()}
    return Held(tsvd < least, (tsvd >= least) & np.isfinite(least), row)


def _compare_rule(sweep: Sweep) -> Held:
    """Compare lambda by cross-validation with the best one of RE; a rule that works refutes."""
    parts = sweep.study.design.parts
    found, best, early = (sweep.chosen[m].errors[:, parts] for m in (CROSS, RE, EARLY))
    works = _are_better(found, best, SIZES.find("rule"))
    with np.errstate(divide="ignore", invalid="ignore"):  # of diverged fits
        ratios = [np.median(found, axis=0) / np.median(other, axis=0) for other in (best, early)]
    return Held(~works, works, dict(zip(("ratio", "early"), map(format_pair, ratios), strict=True)))


def _compare_ranked(draws: Draws) -> Held:
    """Compare LS with rank detection and 5-DOF measurement with LS and 6-DOF measurement."""
    parts = draws[0].study.design.parts
    six, five = draws[0].chosen[LS].errors, draws[1].chosen[RANKED].errors
    holds = _are_better(five[:, parts], six[:, parts], 1.1)
    row = _show_medians(draws[0], {"six": LS}) | _show_medians(draws[1], {"five": RANKED})
    return Held(holds, ~holds, row)


def _compare_prior(sweep: Sweep) -> Held:
    """Compare MAP with the paper's methods at their best."""
    prior, *raw = (sweep.chosen[a].errors[:, sweep.study.design.parts]
                   for a in (PRIOR, *NAMES.values()))  # fmt: skip
    holds = np.all([_are_better(prior, errors) for errors in raw], axis=0)
    return Held(holds, ~holds, _show_medians(sweep, {**SHOWN, "prior": PRIOR}))


def _find_best_k(sweep: Sweep) -> Held:
    """Return the best k, all parameters included, by its distance from their number."""
    ks = sweep.settings[TSVD].astype(int)
    best = ks[steps.locate_bottoms(sweep.curves[TSVD], sweep.study.design.parts)[:, -1]]
    distance = (ks[0] - best) / ks[0]
    row = {"low": int(best.min()), "high": int(best.max()), "middle": float(np.median(best)),
           "of": int(ks[0])}  # fmt: skip
    is_near = (distance <= SIZES.find("near")) & (distance > 0.0)
    return Held(is_near, ~is_near, row)


def _judge_lambda(results: Results) -> published.Verdict:
    """Judge the range of the best lambda, looked for beyond that range, and its differences: after
    the whole iteration and after the short one, which must not contradict each other.
    """
    smallest, largest = (steps.PRINTED.number("lambda", end) for end in ("smallest", "largest"))
    converged, early = (
        {label: sweep.chosen[algorithm].settings for label, sweep in results.sweeps.items()}
        for algorithm in (RE, EARLY)
    )
    held = []
    for best in (converged, early):
        values = np.array(list(best.values()))
        six = np.array([best[of[0].study.label] for of in results.draws.values()])
        apart = six.max(axis=0) / six.min(axis=0) > 9.9  # of powers of ten
        held.append((values.min(axis=0) > 0.9 * smallest) & (values.max(axis=0) < 1.1 * largest)
                    & apart)  # fmt: skip
    decided = map(published.decide, np.all(held, axis=0), ~np.any(held, axis=0))
    rows = [
        {"name": label, **{f"{when}_{name}": float(function(best[label]))
                           for when, best in (("late", converged), ("early", early))
                           for name, function in (("low", np.min), ("middle", np.median),
                                                  ("high", np.max))}}
        for label in converged
    ]  # fmt: skip
    lambdas = np.concatenate([sweep.settings[RE][1:] for sweep in results.sweeps.values()])
    ends = {"low": lambdas.min(), "high": lambdas.max(), "iterations": SIZES.find("short")}
    return TEXT.judge("lambda_range", [*decided], rows=rows, **ends,
                      smallest=smallest, largest=largest)  # fmt: skip


def _judge_noise(noise: published.Printed) -> published.Verdict:
    """Judge whether the printed noise is uniform within its limits: by its root mean square, which
    has a standard deviation of sqrt(1 / (15 n)) of the limit.
    """
    limits = steps.list_limits() / ([steps.MM] * 3 + [1.0] * 3)  # [mm, rad]
    shares = noise.values / limits
    largest, rms = np.abs(noise.values).max(axis=0), float(np.sqrt(np.mean(shares**2)))
    apart = abs(rms - 1.0 / np.sqrt(3.0)) * np.sqrt(15.0 * shares.size)
    return TEXT.judge(
        "noise", published.decide(apart < 2.0, apart > 3.0), count=shares.size, rms=rms,
        length=largest[:3].max(), angle=largest[3:].max(), degrees=np.rad2deg(largest[3:].max()),
        limit=limits[0], turn=np.rad2deg(limits[3]),
    )  # fmt: skip


def format_errors(parts: tuple[int, ...], errors: FloatArray) -> str:
    """Return errors in position and angle, as far as the platform has them, as text."""
    if not np.isfinite(errors[[*parts]]).all():
        return DIVERGED
    return " / ".join(f"{errors[i]:.2g} {('mm', 'deg')[i]}" for i in parts)


def format_pair(values: FloatArray) -> str:
    """Return ratios in position and angle as text; DIVERGED for one that is not finite."""
    return " and ".join(f"{v:.2f}" if np.isfinite(v) else DIVERGED for v in values)


def list_replaced(results: Results) -> tuple[str, ...]:
    """Return sentences on further sizes that another robot replaces."""
    if not results.is_adapted:
        return ()
    design, of_paper = results.design, steps.load_design("3-PRS")
    ranges = {
        "measured": list_ranges(design, design.poses),
        "range": list_ranges(design, design.output_range),
        "of_paper": list_ranges(of_paper, of_paper.output_range),
        "of_paper_measured": list_ranges(of_paper, of_paper.poses),
    }
    data = {"robot": design.name, "parameters": len(design.free), "poses": len(design.poses),
            "checked": len(design.output_range),
            "paper_poses": len(of_paper.output_range), **ranges}  # fmt: skip
    is_fixed = "psi" not in design.columns
    kept = ["poses", "range", "settings", *(["fixed"] if is_fixed else [])]
    kept += ["no_tilt"] if not is_fixed and 1 not in design.parts else []
    return TEXT.list_replaced(kept, **data)
