# SPDX-License-Identifier: Apache-2.0
"""Tables of the computed numbers: Table 3 in both frames, ranks, interpretations, arithmetic."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from loopcal.papers.cmm_constraint_2011.calibrations import BEFORE, LS, PRIOR, Cell, FiftyPoints
from loopcal.papers.cmm_constraint_2011.draws import Draw
from loopcal.papers.cmm_constraint_2011.forms import ERRORS, FormRow, Forms
from loopcal.papers.cmm_constraint_2011.layouts import Arrangement, Candidate, list_printed
from loopcal.papers.cmm_constraint_2011.machines import (
    AXES,
    GAUGE_NAMES,
    MEASURES,
    ROBOT,
    Study,
    list_gauge_directions,
)
from loopcal.papers.cmm_constraint_2011.published import MM, Published
from loopcal.papers.printed import Cell as Entry
from loopcal.papers.printed import Table
from loopcal.papers.wording import Wording, read_wording
from loopcal.planning.plane_line_planning import PlaneLineGroups
from loopcal.typing import FloatArray
from loopcal.units import Dimension

RANKS = ((1, 100), (2, 50), (5, 20), (10, 10), (20, 10), (30, 10))
"""Groups and points of each, drawn at random, whose rank is computed."""
ALIGNED = ("position, aligned [mm]", "orientation, aligned [deg]", "parameters without gauge [mm]")
ABSOLUTE = (
    "position [mm]",
    "orientation [deg]",
    "parameters [mm]",
    "position, gauge at nominal [mm]",
)
WEIGHTS = {
    "printed": "as printed: weight one",
    "distance": "divided by |d_1|",
    "single": "divided by the sd of each",
    "full": "full covariance",
}
MOTIONS = (
    "the end point moves along it",
    "the end point rotates about it, the base's origin fixed",
    "the end point stays; the platform rotates about it",
)


@dataclass(frozen=True, eq=False)
class GroupRank:
    """Rank of random groups. rows : their number. singular_values : (p,)."""

    groups: int
    points: int
    rows: int
    rank: int
    singular_values: FloatArray

    @property
    def unused(self) -> float:
        """Largest singular value that does not count, relative to the largest; 0 without one."""
        s = self.singular_values
        return float(s[self.rank] / s[0]) if self.rank < len(s) else 0.0


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged.

    Attributes
    ----------
    study : the ten groups. draws : see draws.py; tables and figures show the first.
    arrangements, candidates : see layouts.py. forms : see forms.py.
    ranks : of random groups. pair : points of a group and rank of the equations of all its pairs.
    gauge_effects : (9,) of the directions of GAUGE_NAMES on the rows.
    """

    printed: Published
    study: Study
    draws: tuple[Draw, ...]
    arrangements: tuple[Arrangement, ...]
    candidates: tuple[Candidate, ...]
    forms: Forms
    ranks: tuple[GroupRank, ...]
    pair: tuple[int, int]
    gauge_effects: FloatArray

    @property
    def cells(self) -> Mapping[tuple[str, str], Cell]:
        """Table 3 of the first draw."""
        return self.draws[0].cells

    @property
    def fifties(self) -> tuple[FiftyPoints, ...]:
        """Calibrations from fifty points of the first draw."""
        return self.draws[0].fifties


def make_tables(results: Results) -> tuple[Table, ...]:
    """Return all tables of the reproduction."""
    words = read_wording(__file__)
    trials = len(results.arrangements[0].cell.iterations)
    printed: tuple[Entry, ...] = ("as printed", "", "", "", *map(float, list_printed()), None)
    candidates = [
        (c.name, c.reading, c.truth, c.frame, *map(float, c.reductions), c.distance)
        for c in results.candidates
    ]
    forms = results.forms
    return (
        _list_given(words, results.study),
        _list_ranks(words, results),
        _list_gauge(words, results.gauge_effects),
        _list_table_3(words, results, "table_3", ALIGNED),
        _list_table_3(words, results, "table_3_absolute", ABSOLUTE),
        words.table("figure_5_readings", [printed, *candidates]),
        words.table(
            "arrangements", map(_list_arrangement, results.arrangements), "", trials=trials
        ),
        _list_weights(words, results.draws[0].weights),
        _list_fifty(words, results),
        words.table(
            "forms",
            map(_list_form, forms.rows),
            "",
            errors=ERRORS / MM,
            covariance=forms.covariance,
        ),
        _list_arithmetic(words, results.printed),
    )


def compute_ranks(study: Study, seed: int) -> tuple[GroupRank, ...]:
    """Return the ranks of random groups, with the tolerance 1e-10 of the largest singular value."""
    ranks = []
    for groups, points in RANKS:
        planned = PlaneLineGroups(study.robot, points, MM, AXES)
        rows = planned.linearize(planned.draw(groups, seed))
        rows = rows.reshape(-1, len(planned.free))
        s: FloatArray = np.asarray(np.linalg.svd(rows, compute_uv=False), dtype=np.float64)
        ranks.append(GroupRank(groups, points, len(rows), int((s > 1e-10 * s[0]).sum()), s))
    return tuple(ranks)


def compute_gauge_effects(study: Study) -> FloatArray:
    """Return the effects (9,) of the directions of GAUGE_NAMES on the rows, relative to the largest
    singular value.
    """
    rows = study.optimized.rows.reshape(-1, len(study.robot.parameters))
    largest = np.linalg.svd(rows, compute_uv=False)[0]
    g = list_gauge_directions(study.robot)
    effects = np.linalg.norm(rows @ g.T, axis=0) / np.linalg.norm(g, axis=1) / largest
    return np.asarray(effects, dtype=np.float64)


def compute_pair_rank(study: Study) -> tuple[int, int]:
    """Return the points of the first group and the rank of the equations (14) of all its pairs.

    The points are those commanded.
    """
    nominal = study.robot.parameters.nominal[None]
    points, slopes, _ = study.layout.linearize_points(
        nominal, study.layout.solve_readings(nominal, 0.0, 0)
    )
    group, J = points[0, 0], slopes[0, 0]
    plane = [0, *range(2, len(group))]
    pairs = [(i, j) for i in plane for j in plane if i < j]
    d_1, slope_1 = group[1] - group[0], J[1] - J[0]
    rows = np.array([(group[i] - group[j]) @ slope_1 + d_1 @ (J[i] - J[j]) for i, j in pairs])
    return len(group), int(np.linalg.matrix_rank(rows, rtol=1e-9))


def _list_given(words: Wording, study: Study) -> Table:
    rows = [("robot", f"{ROBOT}, 42 parameters, nominal geometry of Nategh and Agheli 2009")]
    for name, (low, high) in study.robot.assembly.workspace.items():
        scale, unit = (MM, "mm")
        if name in {"roll", "pitch", "yaw"}:
            scale, unit = np.pi / 180.0, "deg"
        rows.append((f"workspace, {name}", f"{low / scale:.4g} to {high / scale:.4g} {unit}"))
    groups, points = study.layout.groups, study.layout.points
    each = f"{groups} planes of equal z, {points // groups} points each with their line"
    rows.append(("points", each))
    history = ", ".join(f"{v:.1f}" for v in study.optimized.history)
    rows.append(("coordinate exchange", f"log det {history} [tolerance 1 mm, noise 1 mm]"))
    assert all(p.dimension is Dimension.LENGTH for p in study.robot.parameters.entries)
    return words.table("given", rows)


def _list_ranks(words: Wording, results: Results) -> Table:
    rows = []
    for r in results.ranks:
        s = r.singular_values
        unused = float(s[r.rank]) if r.rank < len(s) else None
        rows.append((r.groups, r.points, r.rows, r.rank, float(s[r.rank - 1]), unused))
    return words.table("ranks", rows)


def _list_gauge(words: Wording, effects: FloatArray) -> Table:
    table = [(name, MOTIONS[i // 3], float(effects[i])) for i, name in enumerate(GAUGE_NAMES)]
    return words.table("gauge", table)


def _list_form(row: FormRow) -> tuple[Entry, ...]:
    return (row.noise / MM, row.method, f"{row.converged} of {row.machines}", row.iterations,
            ", ".join(map(str, row.ranks)), row.median, row.largest)  # fmt: skip


def _list_table_3(words: Wording, results: Results, name: str, measures: tuple[str, ...]) -> Table:
    places, methods = [MEASURES.index(measure) for measure in measures], (BEFORE, LS, PRIOR)
    rows = []
    for (given, noise), c in results.cells.items():
        medians = [float(c.compute_median(m)[i]) for i in places for m in methods]
        worse = [c.count_worse(m, places[0]) for m in (LS, PRIOR)]
        rows.append((given, noise, *medians, *worse))
    trials = len(next(iter(results.cells.values())).iterations)
    failed = sum(c.failed for c in results.cells.values())
    table = words.table(name, rows, "", trials=trials, failed=failed)
    columns = [f"{measure}, {m}" for measure in measures for m in methods]
    return replace(
        table,
        columns=(*table.columns, *columns, "LS worse than before", "MAP worse than before"),
        formats=(*table.formats, *[".2g"] * len(columns), "d", "d"),
    )


def _list_arrangement(a: Arrangement) -> tuple[Entry, ...]:
    place = MEASURES.index("position, aligned [mm]")
    errors = (float(a.cell.compute_median(m)[place]) for m in (LS, PRIOR))
    return (a.name, a.study.layout.equations, a.drawn, a.optimized, a.gain, *errors)


def _list_weights(words: Wording, weights: Mapping[str, Cell]) -> Table:
    names = ("position, aligned [mm]", "parameters without gauge [mm]")
    places = [MEASURES.index(name) for name in names]
    rows = [
        (WEIGHTS[w], *(float(c.compute_median(m)[i]) for m in (LS, PRIOR) for i in places))
        for w, c in weights.items()
    ]
    return words.table("weights", rows)


def _list_fifty(words: Wording, results: Results) -> Table:
    rows = []
    for fifty in results.fifties:
        plural = "plane, one line" if fifty.groups == 1 else "planes, a line each"
        for method, frame in fifty.statistics:
            median = map(float, fifty.compute_median(method, frame))
            rows.append((f"{fifty.groups} {plural}", frame, method, *median))
    noise, trials = results.printed.accuracy / MM, len(results.fifties[0].iterations)
    failed = sum(int((~c).sum()) for fifty in results.fifties for c in fifty.converged.values())
    return words.table("table_4", rows, "", trials=trials, noise=noise, failed=failed)


def _list_arithmetic(words: Wording, printed: Published) -> Table:
    rows: list[tuple[Entry, ...]] = []
    for name, given in printed.table_4.items():
        low, high = given.possible
        numbers = (given.before, given.after, given.stated, given.factor)
        rows.append((f"Table 4, {name}", *numbers, f"{low:.2f} to {high:.2f}", given.follows))
    for name, given in printed.figure_5.items():
        if given.before:
            follows = abs(given.reduction - float(given.stated)) <= 0.5
            numbers = (given.before, given.after, given.stated, given.reduction)
            rows.append((f"Figure 5, {name} [%]", *numbers, None, follows))
    return words.table("arithmetic", rows)
