# SPDX-License-Identifier: Apache-2.0
"""What was computed, as tables: the analogues of Tables 1 to 8, and what the figures show as
numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.mechanism import Mechanism
from loopcal.papers.printed import Cell, Comparison, Table
from loopcal.papers.tsvd_2016.cases import (
    LS,
    PRIOR,
    RANKED,
    RE,
    TSVD,
    WHITENED,
    Case,
    Sweep,
    in_paper_units,
)
from loopcal.papers.tsvd_2016.draws import BEFORE, Draws, curves_table, medians_table, ratios_table
from loopcal.papers.tsvd_2016.published import NOISE_COLUMNS, Published, published
from loopcal.papers.tsvd_2016.study import EVALUATED_TILTS, HEIGHTS, LIMITS, MEASURES, machine
from loopcal.typing import FloatArray
from loopcal.units import Dimension

RIDGE_STEPS = (5, 10, 20, 50, 100)
"""Iterations of RE after which its curve over lambda is looked at."""
SIZES = {
    "3-PRS": ("platform_radius", "base_radius", "rod"),
    "RU-PUS-PRS": ("platform_radius", "base_radius", "rod", "post"),
}
IDENTIFIED = (
    (LS, 6),
    (RE, 6),
    (TSVD, 6),
    (RANKED, 5),
    (RE, 5),
    (TSVD, 5),
    (WHITENED, 6),
    (PRIOR, 6),
    (PRIOR, 5),
)


@dataclass(frozen=True, eq=False)
class Results:
    """All that was computed, before it is judged.

    Attributes
    ----------
    cases : both manipulators, each with 6- and 5-DOF measurement. draws : of both manipulators.
    steps : best lambda and errors of RE after RIDGE_STEPS, 3-PRS with 6-DOF measurement. counts :
        published beside computed.
    """

    printed: Published
    cases: tuple[Case, ...]
    draws: tuple[Draws, ...]
    steps: list[tuple[int, float, FloatArray]]
    counts: Comparison

    def case(self, name: str, freedoms: int) -> Case:
        """The case of a manipulator and a measurement."""
        return next(c for c in self.cases if c.study.name == name and c.study.freedoms == freedoms)

    def drawn(self, name: str) -> Draws:
        """The draws of a manipulator."""
        return next(d for d in self.draws if d.name == name)


def tables(found: Results) -> tuple[Table, ...]:
    """All tables of the reproduction."""
    robots = tuple(dict.fromkeys(case.study.name for case in found.cases))
    return (
        _given(robots),
        _noise(),
        _ranks(found.cases),
        *(_outputs(name, found) for name in robots),
        *(medians_table(drawn) for drawn in found.draws),
        *(ratios_table(drawn) for drawn in found.draws),
        _convergence(found.cases),
        _ridge_steps(found),
        *(_identified(name, found) for name in robots),
        *(_curves(case) for case in found.cases),
        *(curves_table(drawn) for drawn in found.draws),
        *(_history(case) for case in found.cases),
    )


def file_name(case: Case) -> str:
    """Of a case, in names of files."""
    return f"{case.study.name.lower().replace('-', '_')}_{case.study.freedoms}"


def history(case: Case, algorithm: str) -> FloatArray:
    """(k + 1, p) identified errors [mm, rad] over the iterations of LS, RE or TSVD at its best."""
    sweep: Sweep = case.ridge if algorithm == RE else case.truncated
    i = 0 if algorithm == LS else sweep.best
    return in_paper_units(case.study, sweep.runs.history[: sweep.runs.count[i] + 1, i])


def steps(case: Case, algorithm: str) -> FloatArray:
    """(k,) largest component of each step [mm, rad]."""
    sweep: Sweep = case.ridge if algorithm == RE else case.truncated
    i = 0 if algorithm == LS else sweep.best
    return sweep.runs.steps[: sweep.runs.count[i], i]


def parameter_units(robot: Mechanism) -> tuple[str, ...]:
    """(p,) of the paper's raw numbers."""
    return tuple("mm" if d is Dimension.LENGTH else "rad" for d in robot.parameters.dimensions)


def _given(robots: Sequence[str]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name in robots:
        robot = machine(name)
        record = robot.record.record  # of the file: dimensions in SI
        rows += [
            (name, size.replace("_", " "), f"{1e3 * getattr(record, size):g} mm")
            for size in SIZES[name]
        ]
        tilts = ", ".join(f"{tilt:g}" for tilt in EVALUATED_TILTS)
        heights = (
            f" at z {', '.join(f'{1e3 * z:g}' for z in HEIGHTS)} mm"
            if "z" in robot.controlled
            else ""
        )
        rows.append((name, "output range", f"96 poses, tilts of {tilts} deg{heights}"))
    note = "Ours: the paper's Tables 1 to 4 are not in our text, so no number below can equal one of Tables 5 to 8."
    return Table(
        "given",
        "What is given (in place of Tables 1 to 4)",
        ("manipulator", "", "value"),
        tuple(rows),
        ("",) * 3,
        note,
    )


def _noise() -> Table:
    values = published().noise.values
    limits = np.array([*LIMITS[:3] * 1e3, *LIMITS[3:]])
    rows = tuple(
        (
            name,
            float(np.abs(column).max()),
            float(limit),
            float(np.sqrt(np.mean(column**2))),
            float(limit / np.sqrt(3.0)),
        )
        for name, column, limit in zip(NOISE_COLUMNS, values.T, limits, strict=True)
    )
    columns = (
        "column",
        "largest as printed",
        "limit taken: 0.01 mm, 0.01 deg",
        "rms as printed",
        "rms of uniform noise",
    )
    return Table("noise", "Appendix 1: the noise", columns, rows, ("", ".6f", ".6f", ".6f", ".6f"))


def _ranks(cases: Sequence[Case]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for case in cases:
        s = case.singular_values
        null = "; ".join(str(c) for c in case.known.unidentifiable)
        rows.append((case.name, f"{case.rank} of {len(s)}", float(s[0]), float(s[-2]), float(s[-1]),
                     float(s[0] / s[case.rank - 1]), case.known.condition, case.normal_equations, null or None))  # fmt: skip
    columns = ("case", "rank", "largest singular value", "last but one", "smallest", ("condition, "
                                                                                     "raw"),
               "condition, whitened and scaled", "first step of (H'H)^-1 H'D [mm, rad]", "cannot be told")  # fmt: skip
    note = (
        "At nominal parameters; raw: in mm and rad. Rank and the combination that changes nothing: "
        "`identifiability`. With a"
        " singular value that is zero but for rounding, the printed formula returns rounding times "
        "its inverse."
    )
    formats = ("", "", ".5g", ".2g", ".2g", ".1e", ".1e", ".2g", "")
    return Table("ranks", "What 5-DOF measurement leaves open", columns, tuple(rows), formats, note)


def _outputs(name: str, found: Results) -> Table:
    number = 8 if name == "3-PRS" else 7
    rows: list[tuple[Cell, ...]] = []
    for freedoms in (6, 5):
        case = found.case(name, freedoms)
        before = case.study.output_errors(case.study.robot.parameters.nominal[None])[0]
        if freedoms == 6:
            rows.append(("", BEFORE, None, *map(float, before), None, None))
        for method, answer in case.answers.items():
            errors = [None] * 4 if answer.diverged else [float(e) for e in answer.errors]
            ended = "diverged" if answer.diverged else "yes" if answer.converged else "no"
            rows.append(
                (f"{freedoms}-DOF", method, answer.setting, *errors, answer.iterations, ended)
            )
    columns = ("measured", "method", "setting", *MEASURES, "iterations", "converged")
    note = (
        "One machine with drawn errors, the noise of Appendix 1, 96 poses of the output range at "
        "equal readings. LS, RE, TSVD"
        " as in the paper, RE and TSVD at the bottom of their curves; below them the methods of "
        "loopcal.calibrate."
    )
    formats = ("", "", "", ".2g", ".2g", ".2g", ".2g", "d", "")
    title = f"Output errors of the {name} manipulator (in place of Table {number})"
    return Table(f"table_{number}", title, columns, tuple(rows), formats, note)


def _identified(name: str, found: Results) -> Table:
    number = 6 if name == "3-PRS" else 5
    case = found.case(name, 6)
    robot = case.study.robot
    true = in_paper_units(case.study, case.study.trials.truth[0])
    answers = [
        in_paper_units(case.study, found.case(name, f).answers[m].values) for m, f in IDENTIFIED
    ]
    rows = tuple(
        (parameter, unit, float(true[i]), *(float(a[i]) for a in answers))
        for i, (parameter, unit) in enumerate(
            zip(robot.parameters.names, parameter_units(robot), strict=True)
        )
    )
    columns = ("parameter", "unit", "true", *(f"{m}, {f}-DOF" for m, f in IDENTIFIED))
    title = f"Identified errors of the {name} manipulator (in place of Table {number})"
    return Table(
        f"table_{number}", title, columns, rows, ("", "", *[".4f"] * (1 + len(answers))), shown=11
    )


def _convergence(cases: Sequence[Case]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for case in cases:
        shown = (LS if case.study.freedoms == 6 else RANKED, RE, TSVD, WHITENED, PRIOR)
        rows.append((case.name, *(_count(case, m) for m in shown)))
    note = "Until no component of a step exceeds 1e-6 mm or rad (MAP, whitened LS: by the rule of the library)."
    columns = ("case", "LS (5-DOF: with rank detection)", RE, TSVD, WHITENED, PRIOR)
    return Table("convergence", "Iterations needed", columns, tuple(rows), ("",) * 6, note)


def _count(case: Case, method: str) -> str:
    answer = case.answers[method]
    return str(answer.iterations) if answer.converged else f"more than {answer.iterations}"


def _ridge_steps(found: Results) -> Table:
    rows = tuple((count, lam, *map(float, errors[:2])) for count, lam, errors in found.steps)
    note = "3-PRS, 6-DOF. lambda acts on each step, so that RE forgets it step by step: its bottom wanders with their number."
    columns = ("iterations", "lambda at the bottom", *MEASURES[:2])
    return Table(
        "ridge_steps",
        "The bottom of RE depends on the iterations",
        columns,
        rows,
        ("d", ".2g", ".2g", ".2g"),
        note,
    )


def _curves(case: Case) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for algorithm, sweep in ((RE, case.ridge), (TSVD, case.truncated)):
        for i, setting in enumerate(sweep.settings):
            errors = (
                [None] * 3 if sweep.runs.diverged[i] else [float(e) for e in sweep.errors[i, :3]]
            )
            place = (
                ("equal intervals" if case.equal[i] else "equal ratios")
                if algorithm == RE
                else None
            )
            rows.append((algorithm, float(setting), place, *errors, int(sweep.runs.count[i])))
    columns = ("algorithm", "lambda or k", "spacing", *MEASURES[:3], "iterations")
    low, high = case.bracket
    note = f"Of the lambdas tried from 1e-20 to 1e6, {low:.0e} to {high:.0e} do not diverge. A dash: diverged."
    return Table(f"curves_{file_name(case)}", f"Errors over lambda and k, {case.name}", columns, tuple(rows),
                 ("", ".3g", "", ".2g", ".2g", ".2g", "d"), note, 8)  # fmt: skip


def _history(case: Case) -> Table:
    robot = case.study.robot
    names = tuple(
        f"{n} [{u}]" for n, u in zip(robot.parameters.names, parameter_units(robot), strict=True)
    )
    rows = [
        (algorithm, i, *map(float, values))
        for algorithm in (LS, RE, TSVD)
        for i, values in enumerate(history(case, algorithm))
    ]
    formats = ("", "d", *([".3g"] * len(names)))
    title = f"Every parameter over iterations, {case.name}"
    return Table(
        f"history_{file_name(case)}",
        title,
        ("algorithm", "iteration", *names),
        tuple(rows),
        formats,
        shown=2,
    )
