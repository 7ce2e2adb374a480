# SPDX-License-Identifier: Apache-2.0
"""The analogues of figures 6 to 11, as data."""

from __future__ import annotations

import numpy as np

from loopcal.papers.reproduction import Figure, Series
from loopcal.papers.tsvd_2016.cases import LS, PRIOR, RE, TSVD, Case
from loopcal.papers.tsvd_2016.draws import Draws
from loopcal.papers.tsvd_2016.tables import Results, file_name, history, parameter_units, steps

NUMBERS = {("RU-PUS-PRS", 6): 6, ("RU-PUS-PRS", 5): 8, ("3-PRS", 6): 10, ("3-PRS", 5): 11}
HISTORIES = {6: 7, 5: 9}
"""Figures of the paper with parameters over iterations, RU-PUS-PRS, by measured coordinates."""
NAMED = 6
"""Parameters named in the legend of a figure of all of them."""
ERRORS = "rms error [mm], [deg]"
POSITION, ANGLE = "position [mm]", "phi and theta [deg]"
SETTING = {RE: "lambda [1]", TSVD: "k [1]"}


def figures(found: Results) -> tuple[Figure, ...]:
    """All figures."""
    curves = [_curve(case, algorithm) for case in found.cases for algorithm in (RE, TSVD)]
    medians = [_medians(drawn, algorithm) for drawn in found.draws for algorithm in (RE, TSVD)]
    histories = []
    for freedoms, algorithms in ((6, (LS, RE, TSVD)), (5, (RE, TSVD))):
        case = found.case("RU-PUS-PRS", freedoms)
        histories += [
            _history(case, algorithm, unit) for algorithm in algorithms for unit in ("mm", "rad")
        ]
    return (*medians, *curves, *histories, _steps(found))


def _curve(case: Case, algorithm: str) -> Figure:
    """Output errors over lambda or k."""
    sweep = case.ridge if algorithm == RE else case.truncated
    there = ~sweep.runs.diverged
    x = tuple(map(float, sweep.settings[there]))
    series = tuple(
        Series(label, x, tuple(map(float, sweep.errors[there, i])))
        for i, label in enumerate((POSITION, ANGLE))
    )
    number, part = NUMBERS[case.study.name, case.study.freedoms], "a" if algorithm == RE else "b"
    best = case.answers[algorithm]
    prior = case.answers[PRIOR].errors
    lost = "" if there.all() else f" Diverged: {int((~there).sum())} settings, not drawn."
    return Figure(
        f"figure_{number}{part}", f"Figure {number}({part}): {algorithm}, {case.name}", SETTING[algorithm], ERRORS,
        "One machine with our dimensions, 36 poses measured with the noise of Appendix 1, errors "
        "over 96 poses. Bottom:"
        f" {best.setting}.{lost} Dashed: MAP, without any setting.", series,
        {f"MAP, {POSITION}": float(prior[0]), f"MAP, {ANGLE}": float(prior[1])}, "xy" if algorithm == RE else "y",
    )  # fmt: skip


def _medians(drawn: Draws, algorithm: str) -> Figure:
    """The same curves, medians over many machines."""
    settings = drawn.lambdas if algorithm == RE else drawn.ks
    curve = drawn.curve(algorithm)[-len(settings) :]
    there = np.isfinite(curve).all(axis=1)
    x = tuple(map(float, np.asarray(settings, dtype=np.float64)[there]))
    series = tuple(
        Series(label, x, tuple(map(float, curve[there, i])))
        for i, label in enumerate((POSITION, ANGLE))
    )
    prior = drawn.median(PRIOR)
    return Figure(
        f"medians_{drawn.name.lower().replace('-', '_')}_{algorithm.lower()}",
        f"{algorithm}, {drawn.name}, 6-DOF: medians over machines", SETTING[algorithm], ERRORS,
        f"Medians over {len(drawn)} drawn machines and noises, errors over 96 poses each. Dashed: "
        "MAP, without any setting.",
        series, {f"MAP, {POSITION}": float(prior[0]), f"MAP, {ANGLE}": float(prior[1])}, "xy" if algorithm == RE else "y",
    )  # fmt: skip


def _history(case: Case, algorithm: str, unit: str) -> Figure:
    """Parameters of one unit over iterations; those that LS (RE with 5-DOF) moves most are named."""
    robot = case.study.robot
    chosen = [i for i, u in enumerate(parameter_units(robot)) if u == unit]
    reference = history(case, LS if case.study.freedoms == 6 else RE)[-1]
    named = sorted(chosen, key=lambda i: -abs(reference[i]))[:NAMED]
    values = history(case, algorithm)
    k = tuple(float(i) for i in range(len(values)))
    series = [
        Series(
            robot.parameters.names[i] if i in named else f"_{robot.parameters.names[i]}",
            k,
            tuple(map(float, values[:, i])),
        )
        for i in (*named, *(i for i in chosen if i not in named))
    ]  # matplotlib leaves a label that begins with _ out of the legend
    number = HISTORIES[case.study.freedoms]
    what = "lengths" if unit == "mm" else "angles"
    setting = "" if algorithm == LS else f" ({case.answers[algorithm].setting})"
    return Figure(
        f"figure_{number}_{algorithm.lower()}_{what}", f"Figure {number}: {algorithm}{setting}, "
                                                       f"{what}", "iteration [1]",
        f"identified error [{unit}]",
        f"{case.name}: {len(chosen)} of {len(robot.parameters)} parameters; named are the "
        f"{len(named)} largest. All numbers:"
        f" tables/history_{file_name(case)}.csv.", tuple(series), log="",
    )  # fmt: skip


def _steps(found: Results) -> Figure:
    """Largest component of each step."""
    series = []
    for case in found.cases:
        if case.study.freedoms == 6:
            for algorithm in (LS, RE, TSVD):
                y = steps(case, algorithm)
                x = tuple(float(i + 1) for i in range(len(y)))
                series.append(Series(f"{algorithm}, {case.study.name}", x, tuple(map(float, y))))
    return Figure("convergence", "How fast the iterations converge", "iteration [1]", "largest component of the step [mm, rad]",
                  "6-DOF measurement, one machine each, RE and TSVD at the bottom of their curves.", tuple(series),
                  {"end of the iteration": 1e-6})  # fmt: skip
