# SPDX-License-Identifier: Apache-2.0
"""Tables of the computed numbers: the analogues of Tables 1 to 8, and the figures as numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal.mechanism.model import Mechanism
from loopcal.papers.printed import Cell, Comparison, Table
from loopcal.papers.tsvd_2016.cases import PRIOR, WHITENED, Case, Sweep, to_paper_units
from loopcal.papers.tsvd_2016.draw_tables import (
    DIVERGED,
    make_median_curves,
    make_medians,
    make_ratios,
    show_number,
    write_file_name,
)
from loopcal.papers.tsvd_2016.draws import BEFORE, TRUE, Draws
from loopcal.papers.tsvd_2016.machines import EVALUATED_TILTS, HEIGHTS, LIMITS, load_machine
from loopcal.papers.tsvd_2016.published import NOISE_COLUMNS, Published, read_published
from loopcal.papers.tsvd_2016.situations import LS, RANKED, RE, TSVD
from loopcal.papers.wording import read_wording
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

RIDGE_STEPS = (5, 10, 20, 50, 100)
"""Iterations of RE after which its curve over lambda is examined."""
SIZES: Mapping[str, tuple[str, ...]] = {
    "3-PRS": ("platform_radius", "base_radius", "rod"),
    "RU-PUS-PRS": ("platform_radius", "base_radius", "rod", "post"),
}
IDENTIFIED = (
    (LS, 6), (RE, 6), (TSVD, 6), (RANKED, 5), (RE, 5), (TSVD, 5), (WHITENED, 6), (PRIOR, 6),
    (PRIOR, 5),
)  # fmt: skip
"""Methods and measured coordinates of the columns of the identified errors."""


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged.

    Attributes
    ----------
    cases : both manipulators, each with 6- and 5-DOF measurement. draws : of both manipulators.
    steps : best lambda and errors of RE after RIDGE_STEPS, 3-PRS with 6-DOF measurement.
    counts : published beside computed.
    """

    printed: Published
    cases: tuple[Case, ...]
    draws: tuple[Draws, ...]
    steps: list[tuple[int | str, float, FloatArray]]
    counts: Comparison

    def find_case(self, name: str, freedoms: int) -> Case:
        """Return the case of a manipulator and a number of measured coordinates."""
        return next(c for c in self.cases if c.study.name == name and c.study.freedoms == freedoms)

    def find_draws(self, name: str) -> Draws:
        """Return the draws of a manipulator."""
        return next(draws for draws in self.draws if draws.name == name)


def make_tables(results: Results) -> tuple[Table, ...]:
    """Return all tables of the reproduction."""
    names = tuple(dict.fromkeys(case.study.name for case in results.cases))
    return (
        _list_machines(names),
        _list_noise(),
        _list_ranks(results.cases),
        *(_list_outputs(name, results) for name in names),
        *(make_medians(draws) for draws in results.draws),
        *(make_ratios(draws) for draws in results.draws),
        _list_convergence(results.cases),
        _list_ridge_steps(results),
        *(_list_identified(name, results) for name in names),
        *(_list_curves(case) for case in results.cases),
        *(make_median_curves(s) for draws in results.draws for s in draws.situations),
        *(_list_history(case) for case in results.cases),
    )


def name_file(case: Case) -> str:
    """Return the name of a case in file names."""
    return f"{write_file_name(case.study.name)}_{case.study.freedoms}"


def collect_history(case: Case, algorithm: str) -> tuple[IntArray, FloatArray]:
    """Return iterations (k + 1,) and identified errors (k + 1, p) [mm, rad] of LS, or of RE or TSVD
    at their best setting; NaN after a step that diverged.
    """
    sweep, i = _find_run(case, algorithm)
    done, history = sweep.runs.done[:, i], sweep.runs.history[:, i]
    end = int(np.searchsorted(done, done[-1])) + 1
    return done[:end], to_paper_units(case.study, history[:end])


def collect_steps(case: Case, algorithm: str) -> tuple[IntArray, FloatArray]:
    """Return iterations (k,) and the largest component of each step (k,) [mm, rad], NaN where it
    diverged.
    """
    sweep, i = _find_run(case, algorithm)
    done, steps = sweep.runs.done[:, i], sweep.runs.steps[:, i]
    end = int(np.searchsorted(done, done[-1]))
    return done[:end] + 1, steps[:end]


def list_units(robot: Mechanism) -> tuple[str, ...]:
    """Return the unit of each of the paper's raw numbers (p,)."""
    return tuple("mm" if d is Dimension.LENGTH else "rad" for d in robot.parameters.dimensions)


def _find_run(case: Case, algorithm: str) -> tuple[Sweep, int]:
    sweep = case.ridge if algorithm == RE else case.truncated
    return sweep, 0 if algorithm == LS else sweep.best


def _list_machines(names: Sequence[str]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name in names:
        robot = load_machine(name)
        record = robot.record.record  # of the file: dimensions in SI
        rows += [
            (name, size.replace("_", " "), f"{1e3 * getattr(record, size):g} mm")
            for size in SIZES[name]
        ]
        tilts = ", ".join(f"{tilt:g}" for tilt in EVALUATED_TILTS)
        heights = ", ".join(f"{1e3 * z:g}" for z in HEIGHTS)
        z = f" at z {heights} mm" if "z" in robot.controlled else ""
        rows.append((name, "output range", f"96 poses, tilts of {tilts} deg{z}"))
    return read_wording(__file__).table("given", rows)


def _list_noise() -> Table:
    values = read_published().noise.values
    limits = np.array([*LIMITS[:3] * 1e3, *LIMITS[3:]])
    largest, rms = np.abs(values).max(axis=0), np.sqrt(np.mean(values**2, axis=0))
    columns = np.stack([largest, limits, rms, limits / np.sqrt(3.0)], axis=1)
    rows = [(name, *map(float, row)) for name, row in zip(NOISE_COLUMNS, columns, strict=True)]
    return read_wording(__file__).table("noise", rows)


def _list_ranks(cases: Sequence[Case]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for case in cases:
        s = case.singular_values
        null = "; ".join(str(c) for c in case.known.unidentifiable)
        values = (float(s[0]), float(s[-2]), float(s[-1]), float(s[0] / s[case.rank - 1]))
        rank = f"{case.rank} of {len(s)}"
        tail = (case.known.condition, case.normal_equations, null or None)
        rows.append((case.name, rank, *values, *tail))
    return read_wording(__file__).table("ranks", rows)


def _list_outputs(name: str, results: Results) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for freedoms in (6, 5):
        case = results.find_case(name, freedoms)
        study = case.study
        nominal, truth = study.robot.parameters.nominal[None], study.trials.truth
        for method, values in ((BEFORE, nominal), (TRUE, truth)) if freedoms == 6 else ():
            numbers = (*study.compute_output_errors(values)[0, :4],
                       *study.compute_commanded_errors(values)[0])  # fmt: skip
            rows.append(("", method, None, *map(float, numbers), None, None))
        for method, answer in case.answers.items():
            numbers = (*answer.errors[:4], *answer.commanded)
            end = DIVERGED if answer.is_diverged else "yes" if answer.is_converged else "no"
            label = (f"{freedoms}-DOF", method, answer.setting)
            rows.append((*label, *map(show_number, numbers), answer.iterations, end))
    number = 8 if name == "3-PRS" else 7
    words = read_wording(__file__)
    return words.table("outputs", rows, f"table_{number}", name=name, number=number)


def _list_identified(name: str, results: Results) -> Table:
    case = results.find_case(name, 6)
    robot = case.study.robot
    columns = [case.study.trials.truth[0]]
    columns += [results.find_case(name, f).answers[m].values for m, f in IDENTIFIED]
    values = to_paper_units(case.study, np.array(columns))
    labels = zip(robot.parameters.names, list_units(robot), strict=True)
    rows = [(*label, *map(show_number, values[:, i])) for i, label in enumerate(labels)]
    number = 6 if name == "3-PRS" else 5
    words = read_wording(__file__)
    return words.table("identified", rows, f"table_{number}", name=name, number=number)


def _list_convergence(cases: Sequence[Case]) -> Table:
    rows = []
    for case in cases:
        shown = (LS if case.study.freedoms == 6 else RANKED, RE, TSVD, WHITENED, PRIOR)
        rows.append((case.name, *(case.answers[method].needed for method in shown)))
    return read_wording(__file__).table("convergence", rows)


def _list_ridge_steps(results: Results) -> Table:
    rows = [(count, lam, *map(show_number, errors[:2])) for count, lam, errors in results.steps]
    return read_wording(__file__).table("ridge_steps", rows)


def _list_curves(case: Case) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for algorithm, sweep in ((RE, case.ridge), (TSVD, case.truncated)):
        for i, setting in enumerate(sweep.settings):
            errors = map(show_number, sweep.errors[i, :3])
            spacing = None
            if algorithm == RE:
                spacing = "equal intervals" if case.is_equal[i] else "equal ratios"
            count = int(sweep.runs.count[i])
            rows.append((algorithm, float(setting), spacing, *errors, count))
    low, high = case.bracket
    words, name = read_wording(__file__), f"curves_{name_file(case)}"
    return words.table("curves", rows, name, case=case.name, low=low, high=high)


def _list_history(case: Case) -> Table:
    robot = case.study.robot
    labels = zip(robot.parameters.names, list_units(robot), strict=True)
    rows = [
        (algorithm, int(i), *map(show_number, values))
        for algorithm in (LS, RE, TSVD)
        for i, values in zip(*collect_history(case, algorithm), strict=True)
    ]
    words, name = read_wording(__file__), f"history_{name_file(case)}"
    table = words.table("history", rows, name, case=case.name)
    columns = (*table.columns, *(f"{parameter} [{unit}]" for parameter, unit in labels))
    formats = (*table.formats, *[".3g"] * len(robot.parameters))
    return replace(table, columns=columns, formats=formats)
