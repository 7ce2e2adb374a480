# SPDX-License-Identifier: Apache-2.0
"""What was computed, as tables: Table 3 in both frames, ranks and gauge directions, the paper's own
arithmetic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.papers.cmm_constraint_2011.cells import BEFORE, LS, PRIOR, Cell
from loopcal.papers.cmm_constraint_2011.fifty import Fifty, fifty_table
from loopcal.papers.cmm_constraint_2011.forms import Forms, forms_table
from loopcal.papers.cmm_constraint_2011.gauge import NAMES, gauge_directions
from loopcal.papers.cmm_constraint_2011.layouts import (
    Arrangement,
    Candidate,
    arrangements_table,
    candidates_table,
    weights_table,
)
from loopcal.papers.cmm_constraint_2011.published import MM, Published
from loopcal.papers.cmm_constraint_2011.study import AXES, MEASURES, ROBOT, Study
from loopcal.papers.printed import Cell as Entry
from loopcal.papers.printed import Table
from loopcal.planning.plane_line_groups import PlaneLineGroups
from loopcal.typing import FloatArray
from loopcal.units import Dimension

RANKS = ((1, 100), (2, 50), (5, 20), (10, 10), (20, 10), (30, 10))
"""Groups and points of each, drawn at random, whose rank is looked at."""


@dataclass(frozen=True, eq=False)
class Results:
    """All that was computed, before it is judged.

    Attributes
    ----------
    study : the ten groups. cells : Table 3, by (set, noise) as printed. arrangements, candidates,
        weights : see layouts.py.
    fifties : see fifty.py. forms : see forms.py. ranks : groups, points of each, rows, rank, and
        the singular values (p,).
    """

    printed: Published
    study: Study
    cells: Mapping[tuple[str, str], Cell]
    arrangements: tuple[Arrangement, ...]
    candidates: tuple[Candidate, ...]
    weights: Mapping[str, Cell]
    fifties: tuple[Fifty, ...]
    forms: Forms
    ranks: tuple[tuple[int, int, int, int, FloatArray], ...]


def tables(found: Results) -> tuple[Table, ...]:
    """All tables of the reproduction."""
    return (
        _given(found.study),
        _ranks(found),
        _gauge(found.study),
        _table_3(found, aligned=True),
        _table_3(found, aligned=False),
        candidates_table(found.candidates),
        arrangements_table(found.arrangements),
        weights_table(found.weights),
        fifty_table(found.fifties),
        forms_table(found.forms),
        _arithmetic(found.printed),
    )


def ranks(study: Study, seed: int) -> tuple[tuple[int, int, int, int, FloatArray], ...]:
    """Ranks of random groups, with the tolerance 1e-10 of the largest singular value."""
    found = []
    for groups, points in RANKS:
        planned = PlaneLineGroups(study.robot, points, MM, AXES)
        rows = planned.linearize(planned.draw(groups, seed)).reshape(-1, len(planned.free))
        s = np.linalg.svd(rows, compute_uv=False)
        found.append((groups, points, len(rows), int((s > 1e-10 * s[0]).sum()), s))
    return tuple(found)


def pair_rank(study: Study) -> tuple[int, int]:
    """Points of the first group, and the rank of the equations (14) of all its pairs, at the points
    as commanded.
    """
    nominal = study.robot.parameters.nominal[None]
    points, slopes, _ = study.layout.sloped(nominal, study.layout.held(nominal, 0.0, 0))
    at, J = points[0, 0], slopes[0, 0]
    plane = [0, *range(2, len(at))]
    pairs = [(i, j) for i in plane for j in plane if i < j]
    d_1, slope_1 = at[1] - at[0], J[1] - J[0]
    rows = np.array([(at[i] - at[j]) @ slope_1 + d_1 @ (J[i] - J[j]) for i, j in pairs])
    return len(at), int(np.linalg.matrix_rank(rows, rtol=1e-9))


def _given(study: Study) -> Table:
    rows: list[tuple[Entry, ...]] = [
        ("robot", f"{ROBOT}, 42 parameters, nominal geometry of Nategh and Agheli 2009")
    ]
    for name, (low, high) in study.robot.assembly.workspace.items():
        angle = name in {"roll", "pitch", "yaw"}
        shown = (np.rad2deg(low), np.rad2deg(high), "deg") if angle else (low / MM, high / MM, "mm")
        rows.append((f"workspace, {name}", f"{shown[0]:.4g} to {shown[1]:.4g} {shown[2]}"))
    layout = study.layout
    rows.append(
        (
            "points",
            (
                f"{layout.groups} planes of equal z, {layout.points // layout.groups} points each "
                "with "
                "their line"
            ),
        )
    )
    history = ", ".join(f"{v:.1f}" for v in study.optimised.history)
    rows.append(("coordinate exchange", f"log det {history} [tolerance 1 mm, noise 1 mm]"))
    assert all(p.dimension is Dimension.LENGTH for p in study.robot.parameters.entries)
    note = "Ours: the paper's Tables 1 and 2 and the number of its planes are not in our text."
    return Table(
        "given",
        "What is given (in place of Tables 1 and 2)",
        ("", "value"),
        tuple(rows),
        ("", ""),
        note,
    )


def _ranks(found: Results) -> Table:
    rows = tuple(
        (g, k, m, r, float(s[r - 1]), float(s[r]) if r < len(s) else None)
        for g, k, m, r, s in found.ranks
    )
    columns = (
        "planes",
        "points of each",
        "rows",
        "rank",
        "smallest that counts",
        "largest that does not",
    )
    note = (
        "Of 42 parameters; singular values of rows in noise of 1 mm by errors of 1 mm; points "
        "drawn at random; cut at 1e-10 of"
        " the largest."
    )
    return Table(
        "ranks",
        "33 of 42 for any number of planes and lines",
        columns,
        rows,
        ("d",) * 4 + (".2g", ".1e"),
        note,
    )


def _gauge(study: Study) -> Table:
    rows_of = study.optimised.rows.reshape(-1, 42)
    top = np.linalg.svd(rows_of, compute_uv=False)[0]
    g = gauge_directions(study.robot)
    effect = np.linalg.norm(rows_of @ g.T, axis=0) / np.linalg.norm(g, axis=1) / top
    moved = (
        "moves along it",
        "turns about it, the base's origin staying",
        "stays; the platform turns about it",
    )
    rows = tuple(
        (name, f"the end point {moved[i // 3]}", float(effect[i])) for i, name in enumerate(NAMES)
    )
    note = "Effect on the rows of the ten groups, over the largest singular value: rounding."
    columns = ("direction", "what it does to every pose", "effect")
    return Table(
        "gauge",
        "The nine directions that plane and line cannot tell",
        columns,
        rows,
        ("", "", ".0e"),
        note,
    )


def _table_3(found: Results, aligned: bool) -> Table:
    chosen = (
        ("position, aligned [mm]", "orientation, aligned [deg]", "parameters without gauge [mm]")
        if aligned
        else (
            "position [mm]",
            "orientation [deg]",
            "parameters [mm]",
            "position, gauge at nominal [mm]",
        )
    )
    places = [MEASURES.index(name) for name in chosen]
    rows = []
    for (given, noise), c in found.cells.items():
        medians = [float(c.median(m)[i]) for i in places for m in (BEFORE, LS, PRIOR)]
        rows.append((given, noise, *medians, c.worse(LS, places[0]), c.worse(PRIOR, places[0])))
    columns = ("errors, sd [mm]", "noise, sd [mm]", *(f"{name}, {m}" for name in chosen for m in (BEFORE, LS, PRIOR)),
               "LS worse than before", "MAP worse than before")  # fmt: skip
    first = next(iter(found.cells.values()))
    frame = (
        "after the base's best motion and the platform's best turn, which the data leave open"
        if aligned
        else "as they are, which for least squares is mostly where the least deviation puts what "
        "the data leave open (gauge at"
        " nominal: put where poses are nearest to those as designed, as good an answer to the same "
        "data)"
    )
    note = (
        f"Medians of {len(first.iterations)} drawn machines; root mean squares over 100 unseen "
        "poses at equal readings,"
        f" {frame}; the 2-norm of the parameters' error. Rows with their full covariance. Last: "
        "how many machines a method made"
        " worse in position."
    )
    name = "table_3" if aligned else "table_3_absolute"
    title = f"Table 3 repeated, {'after alignment' if aligned else 'in the absolute frame'}"
    return Table(
        name, title, columns, tuple(rows), ("", "", *[".2g"] * 3 * len(chosen), "d", "d"), note
    )


def _arithmetic(printed: Published) -> Table:
    rows: list[tuple[Entry, ...]] = []
    for name, given in printed.table_4.items():
        low, high = given.possible
        rows.append((f"Table 4, {name}", given.before, given.after, given.stated, given.factor, f"{low:.2f} to {high:.2f}",
                     given.follows))  # fmt: skip
    for name, given in printed.figure_5.items():
        if given.before:
            follows = abs(given.reduction - float(given.stated)) <= 0.5
            rows.append(
                (
                    f"Figure 5, {name} [%]",
                    given.before,
                    given.after,
                    given.stated,
                    given.reduction,
                    None,
                    follows,
                )
            )
    columns = (
        "quantity",
        "before",
        "after",
        "stated",
        "from the printed numbers",
        "possible, numbers being rounded",
        "follows",
    )
    return Table(
        "arithmetic",
        "The paper's own quotients",
        columns,
        tuple(rows),
        ("", "", "", "", ".3g", "", ""),
    )
