# SPDX-License-Identifier: Apache-2.0
"""The analogues of figures 6 to 11, as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from loopcal.papers.reproduction import Figure, Series
from loopcal.papers.tsvd_2016.cases import LS, PRIOR, RE, TSVD, Case
from loopcal.papers.tsvd_2016.draws import Draws, write_file_name
from loopcal.papers.tsvd_2016.tables import (
    Results,
    collect_history,
    collect_steps,
    list_units,
    name_file,
)
from loopcal.papers.wording import read_wording
from loopcal.typing import BoolArray, FloatArray, IntArray

NUMBERS = {("RU-PUS-PRS", 6): 6, ("RU-PUS-PRS", 5): 8, ("3-PRS", 6): 10, ("3-PRS", 5): 11}
HISTORIES = {6: 7, 5: 9}
"""Figures of the paper with parameters by iteration, RU-PUS-PRS, by measured coordinates."""
NAMED = 6
"""Parameters named in the legend of a figure of all of them."""
LABELS = ("position [mm]", "phi and theta [deg]")
SETTING = {RE: "lambda", TSVD: "k"}
LOG = {RE: "xy", TSVD: "y"}


def make_figures(results: Results) -> tuple[Figure, ...]:
    """Return all figures."""
    medians = [_draw_medians(draws, a) for draws in results.draws for a in (RE, TSVD)]
    curves = [_draw_curve(case, algorithm) for case in results.cases for algorithm in (RE, TSVD)]
    histories = []
    for freedoms, algorithms in ((6, (LS, RE, TSVD)), (5, (RE, TSVD))):
        case = results.find_case("RU-PUS-PRS", freedoms)
        histories += [_draw_history(case, a, unit) for a in algorithms for unit in ("mm", "rad")]
    return (*medians, *curves, *histories, _draw_steps(results))


def _draw_curve(case: Case, algorithm: str) -> Figure:
    """Return output errors over lambda or k."""
    sweep = case.ridge if algorithm == RE else case.truncated
    usable = ~sweep.runs.is_diverged
    number = NUMBERS[case.study.name, case.study.freedoms]
    part = "a" if algorithm == RE else "b"
    figure = read_wording(__file__).figure(
        "curve",
        _make_series(sweep.settings, sweep.errors, usable),
        _mark_prior(case.answers[PRIOR].errors),
        f"figure_{number}{part}",
        number=f"{number}({part})",
        algorithm=algorithm,
        case=case.name,
        setting=SETTING[algorithm],
        best=case.answers[algorithm].setting,
        diverged=int((~usable).sum()),
    )
    return replace(figure, log=LOG[algorithm])


def _draw_medians(draws: Draws, algorithm: str) -> Figure:
    """Return the same curves as medians over many machines."""
    settings = draws.lambdas if algorithm == RE else draws.ks
    curve = draws.compute_curve(algorithm)[-len(settings) :]
    figure = read_wording(__file__).figure(
        "medians",
        _make_series(settings, curve, np.asarray(np.isfinite(curve).all(axis=1))),
        _mark_prior(draws.compute_median(PRIOR)),
        f"medians_{write_file_name(draws.name)}_{algorithm.lower()}",
        algorithm=algorithm,
        name=draws.name,
        setting=SETTING[algorithm],
        trials=len(draws),
    )
    return replace(figure, log=LOG[algorithm])


def _draw_history(case: Case, algorithm: str, unit: str) -> Figure:
    """Return the parameters of one unit by iteration.

    Those that LS (RE with 5-DOF) changes most are named.
    """
    names, units = case.study.robot.parameters.names, list_units(case.study.robot)
    chosen = [i for i, u in enumerate(units) if u == unit]
    reference = collect_history(case, LS if case.study.freedoms == 6 else RE)[-1]
    named = sorted(chosen, key=lambda i: -abs(reference[i]))[:NAMED]
    values = collect_history(case, algorithm)
    k = tuple(float(i) for i in range(len(values)))
    lines = [
        Series(names[i] if i in named else f"_{names[i]}", k, tuple(map(float, values[:, i])))
        for i in (*named, *(i for i in chosen if i not in named))
    ]
    number, what = HISTORIES[case.study.freedoms], "lengths" if unit == "mm" else "angles"
    return read_wording(__file__).figure(
        "history",
        lines,
        None,
        f"figure_{number}_{algorithm.lower()}_{what}",
        number=number,
        method=algorithm if algorithm == LS else f"{algorithm} ({case.answers[algorithm].setting})",
        what=what,
        unit=unit,
        case=case.name,
        chosen=len(chosen),
        count=len(names),
        named=len(named),
        file=name_file(case),
    )


def _draw_steps(results: Results) -> Figure:
    """Return the largest component of each step."""
    lines = []
    for case in (case for case in results.cases if case.study.freedoms == 6):
        for algorithm in (LS, RE, TSVD):
            y = collect_steps(case, algorithm)
            x = tuple(float(i + 1) for i in range(len(y)))
            lines.append(Series(f"{algorithm}, {case.study.name}", x, tuple(map(float, y))))
    return read_wording(__file__).figure("convergence", lines, {"end of the iteration": 1e-6})


def _make_series(
    settings: FloatArray | IntArray, errors: FloatArray, usable: BoolArray
) -> list[Series]:
    """Return position and angle errors (s, ..) over the usable settings (s,)."""
    x = tuple(map(float, np.asarray(settings, dtype=np.float64)[usable]))
    return [
        Series(label, x, tuple(map(float, errors[usable, i]))) for i, label in enumerate(LABELS)
    ]


def _mark_prior(errors: FloatArray) -> Mapping[str, float]:
    return {f"MAP, {label}": float(errors[i]) for i, label in enumerate(LABELS)}
