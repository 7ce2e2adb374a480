# SPDX-License-Identifier: Apache-2.0
"""The whole study: both manipulators with 6- and 5-DOF measurement, then many machines; its tables,
figures and verdicts.

The paper simulates one machine of each structure. Here each drawn pair of machines is one draw of
that simulation, and a claim is judged in every draw; it holds in a draw if it holds in all
situations it speaks of, and a draw in which neither of two methods is better decides nothing.
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
    HINDSIGHT,
    LS,
    NARROW,
    PICTURED,
    PRIOR,
    PRIOR_FIVE,
    RANKED,
    RAW_EARLY,
    RAW_FIVE,
    RAW_LS,
    RAW_RE,
    RAW_TSVD,
    RE,
    SIZES,
    TSVD,
    WHITENED,
    WIDE,
    Case,
    Draws,
    Sweep,
)
from loopcal.studies.simulation.published_steps import LINEARIZATIONS
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

TEXT = published.PaperText(__file__)
DIVERGED = "diverged"
"""Cell of a number that a diverged fit does not have."""
ROUNDING = 1e-10
"""Size below which an error [mm, deg, tolerances] is rounding."""
NOISE_COLUMNS = ("X [mm]", "Y [mm]", "Z [mm]", "phi [rad]", "theta [rad]", "psi [rad]")
DIMENSIONS = ("platform_radius", "base_radius", "rod", "post")
"""Of a robot file, as far as it has them."""
IDENTIFIED = (
    (LS, 6), (EARLY, 6), (RE, 6), (TSVD, 6), (RANKED, 5), (EARLY, 5), (RE, 5), (TSVD, 5),
    (WHITENED, 6), (PRIOR, 6), (PRIOR, 5),
)  # fmt: skip
"""Methods and measured coordinates of the columns of the identified errors."""
COMPARED = (RAW_LS, RAW_EARLY, RAW_RE, RAW_TSVD, WHITENED, CROSS, NARROW, WIDE, HINDSIGHT)
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
CURVES: Mapping[str, tuple[str, ...]] = {"RE": (RE, EARLY), "TSVD": (TSVD,)}
"""In one figure."""
SETTING, LOG = {RE: "lambda", TSVD: "k"}, {RE: "xy", TSVD: "y"}
NAMES = {"ls": LS, "ridge": RE, "tsvd": TSVD}
"""Of the paper's methods that claims are judged by."""
SHOWN = NAMES | {"early": EARLY}
"""Of those in the evidence of claims."""
Place = TypeVar("Place")


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged."""

    # all manipulators, each with 6- and 5-DOF measurement, or with the coordinates that it has
    cases: Mapping[tuple[str, int], Case]
    draws: tuple[Draws, ...]  # of all manipulators
    # see `steps.follow_ridge`, 3-PRS with 6-DOF measurement
    ridge_steps: list[tuple[int | str, float, bool, FloatArray]]
    noise: published.Printed  # Appendix 1 as printed
    is_adapted: bool = False  # to another robot

    @property
    def whole(self) -> dict[str, Case]:
        """By manipulator, the case with all measured coordinates."""
        return {d.name: self.cases[d.name, d.sweeps[0].study.freedoms] for d in self.draws}

    @property
    def sweeps(self) -> dict[str, Sweep]:
        """The paper's methods on drawn machines, by structure and measurement."""
        return {sweep.study.label: sweep for draws in self.draws for sweep in draws.sweeps}


def compute(
    seed: int, trials: int, progress: Callable[[str], None], case: StudyCase | None = None
) -> Results:
    """Compute everything: one machine of each kind with the printed noise, then drawn machines."""
    cases, designs = {}, steps.list_designs(case)
    for design in designs:
        for measured in steps.measure_case(design, seed).both:
            cases[design.name, measured.freedoms] = steps.solve_case(measured, progress)
    progress("ridge steps")
    followed = next(case for (name, _), case in cases.items() if name == designs[-1].name)
    draws = tuple(steps.simulate_machines(d, seed, trials, progress) for d in designs)
    noise = steps.PRINTED.table("appendix_1")
    is_adapted = case is not None and case.robot is not None
    return Results(cases, draws, steps.follow_ridge(followed), noise, is_adapted)


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
    tripod = results.cases["3-PRS", 6]
    chain = sum("1" in name for name in tripod.study.robot.parameters.names)
    numbers = (results.cases["RU-PUS-PRS", 6].rank, tripod.rank, chain,
               len(tripod.study.trials.readings))  # fmt: skip
    computed = np.array(numbers, dtype=np.float64)[:, None]
    yield TEXT.compare("counts", steps.PRINTED.table("counts"), computed)


def make_tables(results: Results) -> Iterator[published.Table]:
    """Yield all tables: the analogues of Tables 1 to 8, and the figures as numbers."""
    cases, draws, noise = results.cases.values(), results.draws, results.noise.values
    data = describe_design(draws[0].design)
    yield TEXT.table("given", [row for draw in draws for row in _list_machine(draw.design)], **data)

    limits = steps.list_limits() * np.array([1e3] * 3 + [1.0] * 3)
    largest, rms = np.abs(noise).max(axis=0), np.sqrt(np.mean(noise**2, axis=0))
    columns = (NOISE_COLUMNS, largest, limits, rms, limits / np.sqrt(3.0))
    yield TEXT.table("noise", zip(*columns, strict=True))

    ranks: list[tuple[Any, ...]] = []
    for case in cases:
        s, null = case.singular_values, "; ".join(map(str, case.known.unidentifiable)) or None
        values = (s[0], s[-2], s[-1], s[0] / s[case.rank - 1], case.known.condition)
        rank = f"{case.rank} of {len(s)}"
        ranks.append((case.study.label, rank, *values, case.normal_equations, null))
    yield TEXT.table("ranks", ranks)

    yield from (_list_outputs(name, results) for name in results.whole)
    yield from map(make_medians, draws)
    yield from map(make_ratios, draws)

    iterations = []
    for case in cases:
        ls = LS if case in results.whole.values() else RANKED
        counts = [describe_end(case, method)[0] for method in (ls, RE, TSVD, WHITENED, PRIOR)]
        iterations.append((case.study.label, *counts))
    yield TEXT.table("convergence", iterations)

    last = draws[-1].design  # 3-PRS, where there are two
    ridge = [(n, lam, "no" if is_at_end else "yes", *show_errors(last, errors[:2]))
             for n, lam, is_at_end, errors in results.ridge_steps]  # fmt: skip
    yield TEXT.table("ridge_steps", ridge, name=results.whole[last.name].study.label)

    for name, whole in results.whole.items():
        study, five = whole.study, results.cases.get((name, 5))
        columns = [show_all(to_paper_units(study, study.trials.truth[0]))]
        for method, freedoms in IDENTIFIED:
            case = whole if freedoms == 6 else five
            columns.append(
                [None] * len(columns[0]) if case is None
                else show_all(to_paper_units(study, case.answers[method].values[0]))
            )  # fmt: skip
        rows = [(*label, *row) for label, *row in zip(list_labels(study), *columns, strict=True)]
        number = TABLES.get(study.design.printed, ("", ""))[0]
        file = f"table_{number}" if number else f"identified_{study.design.file}"
        data = describe_design(study.design)
        yield TEXT.table("identified", rows, file, name=name, number=number, **data)

    yield from map(_list_curves, cases)
    yield from map(make_median_curves, results.sweeps.values())

    for case in cases:
        study, name = case.study, f"history_{case.study.file}"
        history = [
            (algorithm, i, *show_all(values))
            for algorithm in PICTURED
            for i, values in zip(*collect_history(case, algorithm), strict=True)
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


def _list_outputs(name: str, results: Results) -> published.Table:
    study = results.whole[name].study
    design = study.design
    rows: list[tuple[Any, ...]] = []
    for method, values in ((BEFORE, study.robot.parameters.nominal[None]),
                           (steps.TRUE, study.trials.truth)):  # fmt: skip
        commanded = study.compute_commanded_errors(values)[0]
        errors = show_errors(design, study.compute_output_errors(values)[0, :4])
        rows.append(("", method, None, *errors, *show_errors(design, commanded), None, None))
    for case in (case for (other, _), case in results.cases.items() if other == name):
        for method, answer in case.answers.items():
            numbers = (*show_errors(design, answer.errors[0, :4]),
                       *show_errors(design, answer.commanded[0]))  # fmt: skip
            label = (f"{case.study.freedoms}-DOF", method, case.describe_setting(method))
            rows.append((*label, *numbers, answer.iterations[0], describe_end(case, method)[1]))
    number = TABLES.get(design.printed, ("", ""))[1]
    file = f"table_{number}" if number else f"outputs_{design.file}"
    data = describe_design(design)
    return TEXT.table("outputs", rows, file, name=name, number=number, **data)


def _list_curves(case: Case) -> published.Table:
    """Return errors at every lambda and k; a page shows the bottom of each curve, and beside it."""
    sweep, rows, shown, parts = case.sweep, [], list[int](), case.study.design.parts
    for algorithm, first in ((EARLY, 1), (RE, 1), (TSVD, 0)):  # lambda = 0 is LS
        curve, start = sweep.curves[algorithm][:, first:], len(rows)
        bottom = int(steps.locate_bottoms(curve, parts)[0, -1])
        shown += range(start + max(bottom - 1, 0), start + min(bottom + 2, curve.shape[1]))
        for i, setting in enumerate(sweep.settings[algorithm][first:]):
            spacing = None if algorithm == TSVD else case.spacing[i]
            errors = show_errors(case.study.design, sweep.curves[algorithm][0, first + i, :3])
            count = sweep.counts[algorithm][0, first + i]
            rows.append((algorithm, setting, spacing, *errors, count))
    low, high = case.bracket
    tried = min(steps.SIZES.find("tried")), max(steps.SIZES.find("tried"))
    data = {"low": low, "high": high, "tried": tried, "lost": case.bracket != tried,
            **describe_design(case.study.design)}  # fmt: skip
    name = f"curves_{case.study.file}"
    return TEXT.table("curves", rows, name, (), shown, case=case.study.label, **data)


def make_medians(draws: Draws) -> published.Table:
    """Return medians with their intervals."""
    rows, design = [], draws.design
    for method in draws.errors:
        middle, ends = draws.compute_median(method), draws.compute_interval(method)
        cells: list[published.Cell] = []
        for i, shown in enumerate(show_errors(design, middle[:3])):
            low, high = (f"{e[i]:.2g}" if np.isfinite(e[i]) else DIVERGED for e in ends)
            cells += [shown, None if shown is None else f"{low} to {high}"]
        after: list[published.Cell] = [None, None]
        if method in draws.commanded:
            after = show_errors(design, np.median(draws.commanded[method], axis=0))
        lost = np.isinf(draws.errors[method][:, 0]).sum()
        ends = int(draws.at_end[method].sum()) if method in draws.at_end else None
        rows.append((method, *cells, *after, show_number(middle[3]), lost, ends))
    name = f"draws_{design.file}"
    data = describe_design(design)
    return TEXT.table("draws", rows, name, name=draws.name, trials=len(draws), **data)


def make_ratios(draws: Draws) -> published.Table:
    """Return ratios of medians: MAP, the default kind of fit, over each of the others."""
    rows, parts = [], draws.design.parts
    for other in COMPARED:
        ratio = draws.compute_ratio(PRIOR, other)[None, parts]
        columns = np.concatenate([ratio, draws.compute_ratio_interval(PRIOR, other)])
        cells = [show_all(columns[:, parts.index(i)]) if i in parts else [None] * 3 for i in (0, 1)]
        rows.append((f"MAP over {other}", *cells[0], *cells[1]))
    name, data = f"ratios_{draws.design.file}", describe_design(draws.design)
    return TEXT.table("ratios", rows, name, name=draws.name, trials=len(draws), **data)


def make_median_curves(sweep: Sweep) -> published.Table:
    """Return median errors at every lambda and k."""
    rows, design = [], sweep.study.design
    for algorithm, settings in sweep.settings.items():
        for i, errors in enumerate(sweep.compute_median(algorithm)[:, :3]):
            rows.append((algorithm, settings[i], *show_errors(design, errors)))
    name, data = f"curves_{sweep.study.file}_machines", {"name": sweep.study.label}
    return TEXT.table("median_curves", rows, name, **data, trials=len(sweep))


def describe_end(case: Case, method: str) -> tuple[str, str]:
    """Return the iterations of a method, and whether it converged, as text."""
    answer = case.answers[method]
    if case.is_diverged(method):
        return DIVERGED, DIVERGED
    count = f"{answer.iterations[0]:,}"
    return (count, "yes") if answer.is_converged[0] else (f"more than {count}", "no")


def collect_history(case: Case, algorithm: str) -> tuple[IntArray, FloatArray]:
    """Return iterations (k + 1,) and identified errors (k + 1, p) [mm, rad] of one of PICTURED;
    NaN after a step that diverged.
    """
    end = _count_drawn(case, algorithm) + 1
    i, runs = PICTURED.index(algorithm), case.runs
    return runs.done[:end, i], to_paper_units(case.study, runs.history[:end, i])


def _count_drawn(case: Case, algorithm: str) -> int:
    """Return how many steps of one of PICTURED are drawn."""
    done = case.runs.done[:, PICTURED.index(algorithm)]
    last = min(done[-1], steps.SHORT) if algorithm == EARLY else done[-1]
    return int(np.searchsorted(done, last))


def to_paper_units(study: steps.Study, values: FloatArray) -> FloatArray:
    """Return deviations from nominal [mm, rad] of the free ones of values (.., p)."""
    deviations = (values - study.robot.parameters.nominal) / steps.list_scales(study.robot)
    return deviations[..., study.design.free.places]


def list_labels(study: steps.Study) -> list[tuple[str, str]]:
    """Return the name of each parameter, and the unit of the paper's raw numbers."""
    free, known = study.design.free, {Dimension.LENGTH: "mm", Dimension.ANGLE: "rad"}
    units = [known.get(dimension, "1") for dimension in free.dimensions]
    return list(zip(free.names, units, strict=True))


def make_figures(results: Results) -> Iterator[published.Figure]:
    """Yield all figures: the analogues of figures 6 to 11, and medians over many machines."""
    for draws in results.draws:
        for sweep, method in zip(draws.sweeps, (PRIOR, PRIOR_FIVE), strict=False):
            prior, data = draws.compute_median(method), {"name": sweep.study.label}
            for a, of in CURVES.items():
                curves, chosen = {b: sweep.compute_median(b) for b in of}, sweep.chosen[of[0]]
                bottoms = [
                    published.Series.of(f"bottom of each machine, {LABELS[part]}",
                                        chosen.settings[usable], errors[usable], False)
                    for part in sweep.study.design.parts
                    for errors in [chosen.errors[:, part]] for usable in [np.isfinite(errors)]
                ]  # fmt: skip
                file = f"medians_{sweep.study.file}_{a.lower()}"
                yield _draw_curve("medians", file, sweep, a, curves, prior, bottoms, **data,
                                  trials=len(draws), early=EARLY in of)  # fmt: skip
    for case in results.cases.values():
        number = FIGURES.get((case.study.design.printed, case.study.freedoms))
        for (a, of), part in zip(CURVES.items(), "ab", strict=True):
            curves = {b: case.sweep.curves[b][0] for b in of}
            file = f"figure_{number}{part}" if number else f"curve_{case.study.file}_{a.lower()}"
            data = {"number": number and f"{number}({part})", "case": case.study.label,
                    "best": "; ".join(f"{b}: {case.describe_setting(b)}" for b in of)}  # fmt: skip
            prior = case.answers[PRIOR].errors[0]
            yield _draw_curve("curve", file, case.sweep, a, curves, prior, **data)
    for (_, freedoms), case in results.cases.items():
        if case.study.design.printed == "3-PRS":  # similar, says the paper
            continue
        algorithms = PICTURED[1:] if freedoms == 5 else PICTURED
        yield from (_draw_history(case, a, unit) for a in algorithms
                   for unit in dict.fromkeys(u for _, u in list_labels(case.study)))  # fmt: skip
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


def _draw_history(case: Case, algorithm: str, unit: str) -> published.Figure:
    """Return the parameters of one unit by iteration; those that RE changes most are named."""
    labels, names = list_labels(case.study), case.study.design.free.names
    chosen = [i for i, (_, u) in enumerate(labels) if u == unit]
    reference = collect_history(case, RE)[1][-1]
    named = sorted(chosen, key=lambda i: -abs(reference[i]))[:NAMED]
    done, values = collect_history(case, algorithm)
    log = "x" if done[-1] > LONG else ""
    usable = np.isfinite(values).all(axis=1) & ((done > 0) | (log == ""))
    lines = [
        published.Series.of(
            names[i] if i in named else f"_{names[i]}", done[usable], values[usable, i]
        )
        for i in (*named, *(i for i in chosen if i not in named))
    ]
    what = {"mm": "lengths", "rad": "angles"}.get(unit, "ratios")
    is_diverged, number = case.is_diverged(algorithm), None
    if case.study.design.printed:
        number = HISTORIES[case.study.freedoms]
    file = f"figure_{number}" if number else f"history_{case.study.file}"
    method = algorithm if algorithm == LS else f"{algorithm} ({case.describe_setting(algorithm)})"
    slug = re.sub(r"\W+", "_", algorithm.lower())
    return TEXT.figure(
        "history", lines, None, f"{file}_{slug}_{what}", log, number=number,
        method=f"{method}, {DIVERGED}" if is_diverged else method, what=what, unit=unit,
        case=case.study.label, chosen=len(chosen), count=len(names), named=len(named),
        file=case.study.file, diverged=is_diverged,
    )  # fmt: skip


def _draw_steps(results: Results) -> published.Figure:
    """Return the largest component of each step."""
    lines, longest = [], 0
    for name, case in results.whole.items():
        for i, algorithm in enumerate(PICTURED):
            end, sizes = _count_drawn(case, algorithm), case.runs.steps[:, i]
            done, usable = case.runs.done[:end, i] + 1, np.isfinite(sizes[:end])
            label = f"{algorithm}, {name}{f' ({DIVERGED})' * case.is_diverged(algorithm)}"
            lines.append(published.Series.of(label, done[usable], sizes[:end][usable]))
            longest = max(longest, int(done.max(initial=0)))
    log = "xy" if longest > LONG else "y"
    data = describe_design(results.draws[0].design)
    return TEXT.figure("convergence", lines, {"end of the iteration": 1e-6}, "", log, **data)


def judge_claims(results: Results) -> tuple[published.Verdict, ...]:
    """Return a verdict for each claim; of another robot without those on printed numbers and on
    different manipulators, and without those on coordinates that it does not have.
    """
    draws, sweeps = results.draws, results.sweeps
    judge = partial(_judge_places, **describe_design(draws[0].design))
    six = {d.sweeps[0].study.label: d for d in draws}
    five = {d.sweeps[1].study.label: d for d in draws if len(d.sweeps) > 1}
    whole = {draw.name: draw for draw in draws}
    both = {sweep.study.label: (draw, sweep) for draw in draws for sweep in draw.sweeps}
    of_five = (
        judge("ls_fails", five, _compare_five),
        judge("no_solution", five, _compare_exact),
        judge("six_better", {draw.name: draw for draw in five.values()}, _compare_parameters),
    ) if five else ()  # fmt: skip
    return (
        *map(_judge_curve, sweeps.values()),
        judge("ls_stable", six, _find_diverged, limit=LINEARIZATIONS),
        judge("ls_not_best", six, _compare_ls),
        judge("tsvd_best", sweeps, _compare_best, trials=len(draws[0])),
        *of_five,
        judge("deviate", both, _compare_deviations),
        judge("faster", sweeps, _compare_speed),
        *(() if results.is_adapted else (_judge_lambda(results),)),
        judge("no_rule", whole, _compare_rule, is_any=True),
        judge("k_near_j", sweeps, _find_best_k, near=SIZES.find("near")),
        *(() if results.is_adapted else (_judge_noise(results.noise),)),
        *_judge_own_checks(whole),
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
         "count": sum(steps.compute_rise(c) > gain for c in sweep.short[:, :, i])}
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


def _find_diverged(draw: Draws) -> Held:
    """Return where LS diverges, and its iterations, with 6-DOF measurement."""
    ls = draw.sweeps[0].chosen[LS]
    is_lost = np.isinf(ls.errors[:, 0])
    row = {"diverged": int(is_lost.sum()), "slow": int((~is_lost & ~ls.is_converged).sum())}
    return Held(ls.is_converged & ~is_lost, ~ls.is_converged | is_lost, row)


def _are_better(first: FloatArray, second: FloatArray, factor: float = 1.0) -> BoolArray:
    """Return where all errors (t, parts), position and angle, are below others times a factor."""
    return np.all(first < factor * second, axis=1)


def _compare_ls(draw: Draws) -> Held:
    """Compare LS with RE and TSVD at settings that were best on other machines. At its own best
    each is as good as LS at least, because a small lambda is LS.
    """
    unseen = {name: draw.sweeps[0].compare_unseen(a) for name, a in SHOWN.items() if a != LS}
    row = {name: format_pair(np.median(ratio, axis=0)) for name, ratio in unseen.items()}
    ratios = np.array([ratio for name, ratio in unseen.items() if name in NAMES])
    is_worse, is_best = np.any(np.all(ratios < 1.0, axis=2), axis=0), np.all(ratios > 1.0, (0, 2))
    return Held(is_worse, is_best, row)


def _compare_best(sweep: Sweep) -> Held:
    """Compare TSVD with LS and RE, each of the three at the bottom of its curve."""
    parts = sweep.study.design.parts
    errors = {name: sweep.chosen[a].errors[:, parts] for name, a in NAMES.items()}
    tsvd, others = errors["tsvd"], (errors["ls"], errors["ridge"])
    medians = {name: np.median(sweep.chosen[a].errors, axis=0) for name, a in SHOWN.items()}
    commanded = (sweep.chosen[a].commanded[:, parts] for a in (TSVD, RE))
    row = {"commanded": int(np.less_equal(*commanded).all(axis=1).sum()),
           **format_all(parts, **medians)}  # fmt: skip
    holds = np.all([(tsvd <= other).all(axis=1) for other in others], axis=0)
    return Held(holds, np.any([_are_better(other, tsvd) for other in others], axis=0), row)


def _compare_five(draw: Draws) -> Held:
    """Return where LS diverges with 5-DOF measurement, and by how much RE and TSVD improve."""
    chosen = draw.sweeps[1].chosen
    ridge, early, tsvd = (_compare_with_before(draw, chosen[a].errors) for a in (RE, EARLY, TSVD))
    is_lost = np.isinf(chosen[LS].errors[:, 0])
    row = {"diverged": int(is_lost.sum()), "of": len(is_lost), "ridge": float(np.median(ridge)),
           "early": float(np.median(early)), "tsvd": float(np.median(tsvd))}  # fmt: skip
    holds = is_lost & (ridge < 1.0) & (tsvd < 1.0)
    return Held(holds, ~holds, row)


def _compare_with_before(draw: Draws, errors: FloatArray) -> FloatArray:
    """Return the larger of the errors (t, 5) in position and angle, relative to those before."""
    parts = draw.design.parts
    return (errors[:, parts] / draw.errors[BEFORE][:, parts]).max(axis=1)


def _compare_exact(draw: Draws) -> Held:
    """Return whether exact 5-DOF measurements lead to the true parameters, where exact 6-DOF ones
    do.
    """
    limit = SIZES.find("reached") * draw.errors[BEFORE][:, 3]
    six, five = (sweep.exact[:, 3] for sweep in draw.sweeps)
    row = {"six": float(np.median(six)), "five": float(np.median(five)),
           **format_all(draw.design.parts, left=draw.sweeps[1].exact.max(axis=0))}  # fmt: skip
    is_decided = (six <= limit) & np.isfinite(five)
    return Held(is_decided & (five > limit), is_decided & (five <= limit), row)


def _compare_parameters(draw: Draws) -> Held:
    """Compare the parameter errors of the paper's RE and TSVD with 5- and 6-DOF measurement."""
    better, worse, row = [], [], {}
    for name, algorithm in (("ridge", RE), ("early", EARLY), ("tsvd", TSVD)):
        six, five = (sweep.chosen[algorithm].errors[:, 3] for sweep in draw.sweeps)
        if name in NAMES:
            better.append(six < five)
            worse.append(six > five)
        row |= {f"{name}_six": float(np.median(six)), f"{name}_five": float(np.median(five))}
    row |= {"six": draw.compute_median(PRIOR)[3], "five": draw.compute_median(PRIOR_FIVE)[3]}
    return Held(np.all(better, axis=0), np.all(worse, axis=0), row)


def _compare_deviations(place: tuple[Draws, Sweep]) -> Held:
    """Return whether acceptable solutions, those with small errors of poses, have parameters
    farther from the truth than nominal ones.
    """
    draw, sweep = place
    used = [sweep.chosen[a].errors for a in (RANKED, RE, TSVD)]
    worse = np.array([errors[:, 4] for errors in used])
    left = np.array([_compare_with_before(draw, errors) for errors in used])
    is_acceptable = left < SIZES.find("acceptable")
    row = dict(zip(NAMES, np.median(worse, axis=1), strict=True))
    fails = (is_acceptable & (worse == 0.0)).any(axis=0)
    return Held(is_acceptable.any(axis=0) & ~fails, fails, {**row, "left": np.median(left)})


def _compare_speed(sweep: Sweep) -> Held:
    """Compare iterations; a fit that does not converge needs infinitely many."""
    used = zip(SHOWN, (sweep.chosen[a] for a in (RANKED, RE, TSVD, EARLY)), strict=True)
    counts = {name: np.where(c.is_converged, c.iterations, np.inf) for name, c in used}
    least, tsvd = np.minimum(counts["ls"], counts["ridge"]), counts["tsvd"]
    row = {name: show_count(np.median(count)) for name, count in counts.items()}
    return Held(tsvd < least, (tsvd >= least) & np.isfinite(least), row)


def show_count(count: float) -> str:
    """Return a number of iterations as text."""
    return f"{count:,.0f}" if np.isfinite(count) else "not converged"


def _compare_rule(draw: Draws) -> Held:
    """Compare lambda by cross-validation with the best one of RE; a rule that works refutes."""
    parts = draw.design.parts
    found, best = (draw.errors[method][:, parts] for method in (CROSS, RAW_RE))
    works, ratio = _are_better(found, best, SIZES.find("rule")), draw.compute_ratio(CROSS, RAW_RE)
    early = draw.compute_ratio(CROSS, RAW_EARLY)
    row = {"ratio": format_pair(ratio[[*parts]]), "early": format_pair(early[[*parts]])}
    return Held(~works, works, row)


def _find_best_k(sweep: Sweep) -> Held:
    """Return the best k, all parameters included, by its distance from their number."""
    ks = sweep.settings[TSVD].astype(int)
    curves = sweep.curves[TSVD][:, :, sweep.study.design.parts]
    best = np.array([ks[steps.find_bottom(curve)] for curve in curves])
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
    converged = {label: sweep.chosen[RE].settings for label, sweep in results.sweeps.items()}
    early = {
        label: sweep.settings[RE][1:][[steps.find_bottom(curve[:, :2]) for curve in sweep.short]]
        for label, sweep in results.sweeps.items()
    }
    held = []
    for best in (converged, early):
        values = np.array(list(best.values()))
        six = np.array([best[draw.sweeps[0].study.label] for draw in results.draws])
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


def _judge_own_checks(draws: Mapping[str, Draws]) -> tuple[published.Verdict, ...]:
    """Judge rank detection and units, and MAP: against the raw methods, with wrong tolerances, and
    near the best choice; each on every machine.
    """
    raw = (RAW_LS, RAW_RE, RAW_TSVD)
    wrong = [(p, m) for p in (NARROW, WIDE) for m in raw]
    near = {(PRIOR, CROSS): 1.05, (PRIOR, HINDSIGHT): 1.15}

    has_five = all(len(draw.sweeps) > 1 for draw in draws.values())
    has_angle = all(1 in draw.design.parts for draw in draws.values())

    def judge(
        claim: str, limits: Mapping[tuple[str, str], float], first: int = 0, **data: Any
    ) -> published.Verdict:
        data |= describe_design(next(iter(draws.values())).design)
        compare = partial(_compare_methods, limits=limits, first=first)
        return _judge_places(claim, draws, compare, trials=len(next(iter(draws.values()))), **data)

    return (
        *((judge("five_usable", {(RAW_FIVE, RAW_LS): 1.1}),) if has_five else ()),
        *((judge("mixed_units", {(WHITENED, RAW_LS): 0.9}, first=1),) if has_angle else ()),
        judge("map_better", dict.fromkeys([(PRIOR, m) for m in raw], 1.0)),
        judge("map_tolerances", dict.fromkeys(wrong, 1.0), factor=SIZES.find("factor")),
        judge("map_near_best", near),
    )


def _compare_methods(draw: Draws, limits: Mapping[tuple[str, str], float], first: int = 0) -> Held:
    """Return where the errors of a method stay below those of another times a limit, in position
    and in angle; first = 1: in the angle alone.
    """
    parts = [i for i in draw.design.parts if i >= first]
    errors = {m: of[:, parts] for m, of in draw.errors.items()}
    holds = np.all([_are_better(errors[a], errors[b], x) for (a, b), x in limits.items()], axis=0)
    methods = {"prior": PRIOR, "narrow": NARROW, "wide": WIDE, "ls": RAW_LS, "six": RAW_LS,
               "ridge": RAW_RE, "early": RAW_EARLY, "tsvd": RAW_TSVD, "five": RAW_FIVE}  # fmt: skip
    medians = {key: draw.compute_median(m) for key, m in methods.items() if m in errors}
    ratios = {"gcv": (PRIOR, CROSS), "hindsight": (PRIOR, HINDSIGHT), "ratio": next(iter(limits))}
    row = format_all(draw.design.parts, **medians)
    row |= {key: format_pair(draw.compute_ratio(*pair)[parts]) for key, pair in ratios.items()}
    return Held(holds, ~holds, row)


def format_all(parts: tuple[int, ...], **errors: FloatArray) -> dict[str, str]:
    """Return errors in position and angle, as far as the platform has them, as text."""
    return {
        name: " / ".join(f"{e[i]:.2g} {('mm', 'deg')[i]}" for i in parts)
        if np.isfinite(e[[*parts]]).all() else DIVERGED
        for name, e in errors.items()
    }  # fmt: skip


def format_pair(values: FloatArray) -> str:
    """Return ratios in position and angle as text; DIVERGED for one that is not finite."""
    return " and ".join(f"{v:.2f}" if np.isfinite(v) else DIVERGED for v in values)


def list_replaced(results: Results) -> tuple[str, ...]:
    """Return sentences on further sizes that another robot replaces."""
    if not results.is_adapted:
        return ()
    design, of_paper = results.draws[0].design, steps.load_design("3-PRS")
    sentences = published.PaperFile(__file__, "text.yaml").find("replaced")
    ranges = {
        "measured": list_ranges(design, design.poses),
        "range": list_ranges(design, design.output_range),
        "of_paper": list_ranges(of_paper, of_paper.output_range),
        "of_paper_measured": list_ranges(of_paper, of_paper.poses),
    }
    data = {"robot": design.name, "parameters": len(design.free), "poses": len(design.poses),
            "checked": len(design.output_range),
            "paper_poses": len(of_paper.output_range),
            "last": int(results.draws[0].sweeps[0].settings[TSVD][-1]), **ranges}  # fmt: skip
    is_fixed = "psi" not in design.columns
    kept = ["poses", "range", "settings", *(["fixed"] if is_fixed else [])]
    kept += ["no_tilt"] if not is_fixed and 1 not in design.parts else []
    return tuple(published.fill_template(sentences[name], **data) for name in kept)
