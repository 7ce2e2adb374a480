# SPDX-License-Identifier: Apache-2.0
"""The analogues of figures 6 to 11, as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from loopcal.papers.reproduction import Figure, Series
from loopcal.papers.tsvd_2016.cases import PRIOR, Case
from loopcal.papers.tsvd_2016.draw_tables import DIVERGED, write_file_name
from loopcal.papers.tsvd_2016.draws import PRIOR_FIVE, Draws
from loopcal.papers.tsvd_2016.situations import LS, RE, TSVD, Situation
from loopcal.papers.tsvd_2016.tables import (
    Results,
    collect_history,
    collect_steps,
    list_units,
    name_file,
)
from loopcal.papers.wording import read_wording
from loopcal.typing import FloatArray, IntArray

NUMBERS = {("RU-PUS-PRS", 6): 6, ("RU-PUS-PRS", 5): 8, ("3-PRS", 6): 10, ("3-PRS", 5): 11}
HISTORIES = {6: 7, 5: 9}
"""Figures of the paper with parameters by iteration, RU-PUS-PRS, by measured coordinates."""
NAMED = 6
"""Parameters named in the legend of a figure of all of them."""
LABELS = ("position [mm]", "phi and theta [deg]")
SETTING = {RE: "lambda", TSVD: "k"}
LOG = {RE: "xy", TSVD: "y"}
LONG = 50
"""Iterations above which their axis is logarithmic."""


def make_figures(results: Results) -> tuple[Figure, ...]:
    """Return all figures."""
    medians = [
        _draw_medians(draws, situation, algorithm)
        for draws in results.draws
        for situation in draws.situations
        for algorithm in (RE, TSVD)
    ]
    curves = [_draw_curve(case, algorithm) for case in results.cases for algorithm in (RE, TSVD)]
    histories = []
    for freedoms, algorithms in ((6, (LS, RE, TSVD)), (5, (RE, TSVD))):
        case = results.find_case("RU-PUS-PRS", freedoms)
        histories += [_draw_history(case, a, unit) for a in algorithms for unit in ("mm", "rad")]
    return (*medians, *curves, *histories, _draw_steps(results))


def _draw_curve(case: Case, algorithm: str) -> Figure:
    """Return output errors over lambda or k."""
    sweep = case.ridge if algorithm == RE else case.truncated
    number = NUMBERS[case.study.name, case.study.freedoms]
    part = "a" if algorithm == RE else "b"
    figure = read_wording(__file__).figure(
        "curve",
        _make_series(sweep.settings, sweep.errors),
        _mark_prior(case.answers[PRIOR].errors),
        f"figure_{number}{part}",
        number=f"{number}({part})",
        algorithm=algorithm,
        case=case.name,
        setting=SETTING[algorithm],
        best=case.answers[algorithm].setting,
        diverged=int(sweep.runs.is_diverged.sum()),
    )
    return replace(figure, log=LOG[algorithm])


def _draw_medians(draws: Draws, situation: Situation, algorithm: str) -> Figure:
    """Return the same curves as medians over many machines."""
    settings = situation.lambdas if algorithm == RE else situation.ks
    curve = np.median(situation.get_curves(algorithm)[:, -len(settings) :], axis=0)
    figure = read_wording(__file__).figure(
        "medians",
        _make_series(settings, curve),
        _mark_prior(draws.compute_median(PRIOR if situation.freedoms == 6 else PRIOR_FIVE)),
        f"medians_{write_file_name(draws.name)}_{situation.freedoms}_{algorithm.lower()}",
        algorithm=algorithm,
        name=situation.label,
        setting=SETTING[algorithm],
        trials=len(draws),
    )
    return replace(figure, log=LOG[algorithm])


def _draw_history(case: Case, algorithm: str, unit: str) -> Figure:
    """Return the parameters of one unit by iteration.

    Those that RE changes most are named.
    """
    names, units = case.study.robot.parameters.names, list_units(case.study.robot)
    chosen = [i for i, u in enumerate(units) if u == unit]
    reference = collect_history(case, RE)[1][-1]
    named = sorted(chosen, key=lambda i: -abs(reference[i]))[:NAMED]
    done, values = collect_history(case, algorithm)
    usable = np.isfinite(values).all(axis=1) & ((done > 0) | (_choose_axis(done) == ""))
    k = tuple(map(float, done[usable]))
    lines = [
        Series(names[i] if i in named else f"_{names[i]}", k, tuple(map(float, values[usable, i])))
        for i in (*named, *(i for i in chosen if i not in named))
    ]
    number, what = HISTORIES[case.study.freedoms], "lengths" if unit == "mm" else "angles"
    figure = read_wording(__file__).figure(
        "history",
        lines,
        None,
        f"figure_{number}_{algorithm.lower()}_{what}",
        number=number,
        method=_name_run(case, algorithm),
        what=what,
        unit=unit,
        case=case.name,
        chosen=len(chosen),
        count=len(names),
        named=len(named),
        file=name_file(case),
        diverged=case.answers[algorithm].is_diverged,
    )
    return replace(figure, log=_choose_axis(done))


def _draw_steps(results: Results) -> Figure:
    """Return the largest component of each step."""
    lines, longest = [], 0
    for case in (case for case in results.cases if case.study.freedoms == 6):
        for algorithm in (LS, RE, TSVD):
            done, steps = collect_steps(case, algorithm)
            usable = np.isfinite(steps)
            x, y = tuple(map(float, done[usable])), tuple(map(float, steps[usable]))
            label = f"{algorithm}, {case.study.name}"
            if case.answers[algorithm].is_diverged:
                label += f" ({DIVERGED})"
            lines.append(Series(label, x, y))
            longest = max(longest, int(done.max(initial=0)))
    figure = read_wording(__file__).figure("convergence", lines, {"end of the iteration": 1e-6})
    return replace(figure, log="xy" if longest > LONG else "y")


def _name_run(case: Case, algorithm: str) -> str:
    """Return algorithm and setting, and whether it diverged."""
    answer = case.answers[algorithm]
    name = algorithm if algorithm == LS else f"{algorithm} ({answer.setting})"
    return f"{name}, {DIVERGED}" if answer.is_diverged else name


def _choose_axis(done: IntArray) -> str:
    """Return the logarithmic axis of a history: iterations where there are many."""
    return "x" if int(done[-1]) > LONG else ""


def _make_series(settings: FloatArray | IntArray, errors: FloatArray) -> list[Series]:
    """Return position and angle errors (s, ..) over the settings (s,).

    Settings that diverged have no error; they are a series of their own at the upper end.
    """
    x, usable = np.asarray(settings, dtype=np.float64), np.isfinite(errors[:, :2]).all(axis=1)
    lines = [
        Series(label, tuple(map(float, x[usable])), tuple(map(float, errors[usable, i])))
        for i, label in enumerate(LABELS)
    ]
    if not usable.all():
        top = float(errors[usable, :2].max(initial=0.0)) or 1.0
        lines.append(Series(DIVERGED, tuple(map(float, x[~usable])), (top,) * int((~usable).sum())))
    return lines


def _mark_prior(errors: FloatArray) -> Mapping[str, float]:
    return {f"MAP, {label}": float(errors[i]) for i, label in enumerate(LABELS)}
