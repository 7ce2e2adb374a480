# SPDX-License-Identifier: Apache-2.0
"""The paper repeated: every table beside the printed one, and what was found where they differ."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from loopcal import geometry
from loopcal.mechanism import Mechanism, inverse
from loopcal.papers import PAPERS, Paper
from loopcal.papers.hexapod_42 import study_noise, study_table_4
from loopcal.papers.hexapod_42.published import (
    MM,
    ODD_POSE,
    PARAMETER_COLUMNS,
    PARAMETERS,
    POSE_COLUMNS,
    Published,
    nominal_machine,
    published,
    to_table,
    true_machine,
)
from loopcal.papers.hexapod_42.steps import Iterations, Study, actual_poses, iterate, measured_poses
from loopcal.papers.hexapod_42.study_noise import PRESUMED, STATED, Level, MethodResult, limits_si
from loopcal.papers.hexapod_42.study_table_4 import Order, Outliers
from loopcal.papers.printed import Comparison, Printed, Table
from loopcal.papers.reproduction import Figure, Reproduction, Series
from loopcal.typing import FloatArray

NAME = "hexapod-42"
ITERATIONS = 5
"""Shown in figure 4."""
TO_PRINTED = np.array([1.0 / MM] * 3 + [1.0] * 3)
"""From [m, rad] to the units of Tables 4 and 6."""


@dataclass(frozen=True, eq=False)
class Results:
    """All that was computed, before it is judged.

    Attributes
    ----------
    study, odd : the machine of Tables 2 and 3, and the same without errors of leg lengths.
    exact, frozen, presumed, stated : the ten steps without noise, the same with one matrix
        throughout, and with noise.
    levels, methods, orders, outliers : see study_noise.py and study_table_4.py. tables : of the
        studies.
    """

    printed: Published
    study: Study
    odd: Study
    exact: Iterations
    frozen: Iterations
    presumed: Iterations
    stated: Iterations
    levels: tuple[Level, ...]
    methods: tuple[MethodResult, ...]
    orders: tuple[Order, ...]
    outliers: Outliers
    tables: tuple[Table, ...]
    comparisons: dict[str, Comparison]


def reproduce(seed: int, trials: int, progress: Callable[[str], None]) -> Reproduction:
    """Repeat the paper; see `loopcal.papers.Paper.run`."""
    from loopcal.papers.hexapod_42.verdicts import verdicts

    paper = PAPERS[NAME]
    found = compute(seed, trials, progress)
    return Reproduction(
        paper=paper.name,
        title=paper.title,
        source=paper.source,
        about=_about(paper),
        settings={"seed": seed, "trials": trials},
        comparisons=tuple(found.comparisons.values()),
        tables=found.tables,
        verdicts=verdicts(found),
        figures=(_figure_4(found), _figure_noise(found)),
    )


def compute(seed: int, trials: int, progress: Callable[[str], None]) -> Results:
    """Compute everything."""
    printed, robot = published(), nominal_machine()
    errors = printed.errors.values * MM
    truth, without = true_machine(robot, errors), true_machine(robot, errors, leg_lengths=False)
    poses, measured = (
        whole_degrees(printed.nominal_poses),
        printed.measured_poses.values / TO_PRINTED,
    )
    study, odd = Study(robot, truth, poses), Study(robot, without, poses)
    progress("the ten steps")
    exact, frozen = (
        iterate(study, actual_poses(study), ITERATIONS, renewed) for renewed in (True, False)
    )
    noisy = [
        iterate(study, measured_poses(study, limits_si(x), seed), ITERATIONS)
        for x in (PRESUMED, STATED)
    ]
    progress("Euler orders and outliers of Table 4")
    good = np.array([label != ODD_POSE for label in printed.measured_poses.labels])
    orders = study_table_4.orders(robot, truth, poses[good], measured[good])
    odd_ones = study_table_4.outliers(study, printed, measured)
    progress("noise varied")
    levels = study_noise.noise_sweep(study, printed.iterations, printed.threshold, seed, trials)
    progress("methods and numbers of poses varied")
    methods = study_noise.methods(study, seed, trials)
    tables = (
        iterations_table(
            printed, {"without noise": exact, "the same, one matrix": frozen, **_named(noisy)}
        ),
        _conditions_table(exact),
        study_table_4.orders_table(orders, study_table_4.rotation_formula(printed.order)),
        study_table_4.outliers_table(odd_ones),
        study_table_4.rounding(study, printed, measured),
        study_noise.noise_table(levels, study_noise.published_sizes(printed), printed.iterations),
        study_noise.methods_table(methods, trials),
        study_noise.poses_table(study, printed.threshold, seed, trials),
    )
    compared = {c.name: c for c in comparisons(printed, study, odd, exact, noisy[0])}
    return Results(
        printed,
        study,
        odd,
        exact,
        frozen,
        noisy[0],
        noisy[1],
        levels,
        methods,
        orders,
        odd_ones,
        tables,
        compared,
    )


def whole_degrees(poses: Printed) -> FloatArray:
    """(n, 6) nominal poses [m, rad]: the angles printed in radians are whole degrees to the last
    digit.
    """
    values = poses.values / TO_PRINTED
    return np.concatenate([values[:, :3], np.deg2rad(np.round(np.rad2deg(values[:, 3:])))], axis=1)


def comparisons(
    printed: Published, study: Study, odd: Study, exact: Iterations, noisy: Iterations
) -> tuple[Comparison, ...]:
    """Tables 2 to 6, printed beside computed."""
    robot, k = study.robot, printed.iterations
    lengths = tuple(f"{name} [mm]" for name in PARAMETER_COLUMNS)
    small = tuple(f"{name} [1e-3 mm]" for name in PARAMETER_COLUMNS)
    identified = exact.machines[k + 1].values - robot.values
    left = noisy.parameter_errors(study.truth)[k]
    before = noisy.parameter_errors(study.truth)[0]
    drawn = "Depends on the noise drawn, which is not printed: sizes can agree, digits cannot."
    first = (actual_poses(study) - study.poses) * TO_PRINTED
    return (
        Comparison("table_2", "Table 2, nominal parameters", lengths, printed.nominal, symmetric(robot, printed),
                   "Legs 1 and 2 as printed, the others turned by 120 and 240 degrees; l by "
                   "inverse kinematics at Z = 200 mm."),
        Comparison("table_3", "Table 3, parameter errors", lengths, printed.errors, to_table(robot, identified) / MM,
                   f"Given in the paper; computed: identified from exact poses in {k + 1} "
                   "iterations."),
        _table_4(printed, study),
        _odd_row(printed, odd),
        Comparison("table_5_before", "Table 5, parameters before calibration", lengths, printed.parameter_errors_before,
                   to_table(robot, before) / MM),
        Comparison("table_5_after", "Table 5, parameters after calibration", small, printed.parameter_errors_after,
                   to_table(robot, left) / (1e-3 * MM), f"{drawn} Computed with "
                                                        f"{noise_words(PRESUMED)}."),
        Comparison("table_6_before", "Table 6, poses before calibration", POSE_COLUMNS, printed.pose_errors_before, first,
                   "Angles are headed mrad in print, and are rad.", _coarsest(printed, printed.pose_errors_before)),
        Comparison("table_6_after", "Table 6, poses after calibration", POSE_COLUMNS, printed.pose_errors_after,
                   noisy.pose_errors[k] * TO_PRINTED, f"{drawn} Computed with "
                                                      f"{noise_words(PRESUMED)}."),
    )  # fmt: skip


def symmetric(robot: Mechanism, printed: Published) -> FloatArray:
    """(6, 7) Table 2 [mm] of a hexapod with threefold symmetry, from its first two legs."""
    table = printed.nominal.values.copy()
    base, top = slice(0, 3), slice(4, 7)
    for leg, (source, angle) in enumerate(((0, 0), (1, 0), (0, 120), (1, 120), (0, 240), (1, 240))):
        turn = geometry.rotation_about_axis(np.deg2rad(angle), 2)
        for part in (base, top):
            table[leg, part] = turn @ printed.nominal.values[source, part]
    place = PARAMETERS.index("length")
    length = to_table(robot, robot.values)[:, place] + inverse(robot, robot.home[None]).q[0]
    table[:, place] = length / MM
    return table


def iterations_table(printed: Published, runs: dict[str, Iterations]) -> Table:
    """max dQint over iterations: figure 4 as numbers."""
    rows = [
        (str(k), *(float(run.integrated[k]) for run in runs.values()))
        for k in range(ITERATIONS + 1)
    ]
    needed = ("iterations needed", *(run.needed(printed.threshold) for run in runs.values()))
    columns = ("iteration", *(f"{name} [mm + rad]" for name in runs))
    note = (
        f"max dQint over the ten poses. Published: at most {printed.threshold:g} after "
        f"{printed.iterations} iterations;"
        " the curve itself is not in our text. A dash: never. One matrix: that of the nominal "
        "machine in all iterations."
    )
    return Table(
        "figure_4",
        "Figure 4 as numbers",
        columns,
        (*rows, needed),
        ("", *(".3g",) * len(runs)),
        note,
    )


def _conditions_table(exact: Iterations) -> Table:
    """Condition of each leg's matrix at the nominal machine."""
    rows = tuple((f"leg {i + 1}", float(value)) for i, value in enumerate(exact.conditions))
    note = "Largest over smallest singular value of the 10 x 7 matrix of a leg at the nominal machine; all columns are lengths."
    return Table(
        "conditions", "Condition of the legs", ("leg", "condition"), rows, ("", ".0f"), note
    )


def noise_words(limits: tuple[float, float]) -> str:
    """Name a noise."""
    return f"noise within +-{limits[0]:g} mm, +-{limits[1]:g} rad"


def _table_4(printed: Published, study: Study) -> Comparison:
    """Nominal poses, actual poses and their differences."""
    actual = actual_poses(study)
    blocks = (
        ("PT", printed.nominal_poses, study.poses, printed.nominal_poses.unit),
        ("PP", printed.measured_poses, actual, printed.measured_poses.unit),
        ("E1", printed.pose_errors, actual - study.poses, _coarsest(printed, printed.pose_errors)),
    )
    order = [(pose, block) for pose in range(len(actual)) for block in range(len(blocks))]
    labels = printed.nominal_poses.labels
    texts = {f"{labels[i]} {blocks[b][0]}": blocks[b][1].rows[labels[i]] for i, b in order}
    computed = np.array([blocks[b][2][i] for i, b in order]) * TO_PRINTED
    return Comparison(
        "table_4", "Table 4, poses", POSE_COLUMNS, Printed(texts), computed,
        "PT nominal (computed: whole millimetres and degrees), PP actual without noise, E1 = PP - "
        "PT (unit: the coarser one"
        f" of E1 and PP). Row {ODD_POSE} is of another machine, see below.", np.array([blocks[b][3][i] for i, b in order]),
    )  # fmt: skip


def _odd_row(printed: Published, odd: Study) -> Comparison:
    """Row A2 from the machine without errors of leg lengths."""
    i = printed.measured_poses.labels.index(ODD_POSE)
    title = f"Table 4, row {ODD_POSE}, with the errors of leg lengths left out"
    computed = actual_poses(odd)[i : i + 1] * TO_PRINTED
    return Comparison(
        "table_4_a2", title, POSE_COLUMNS, printed.measured_poses.only(ODD_POSE), computed
    )


def _coarsest(printed: Published, errors: Printed) -> FloatArray:
    """Units of the differences E1, which are no finer than the printed poses that they were taken
    from.
    """
    return np.maximum(errors.unit, printed.measured_poses.unit)


def _named(noisy: list[Iterations]) -> dict[str, Iterations]:
    return {noise_words(limits): run for limits, run in zip((PRESUMED, STATED), noisy, strict=True)}


def _figure_4(found: Results) -> Figure:
    """max dQint over iterations."""
    runs = {"without noise": found.exact, "without noise, one matrix throughout": found.frozen}
    runs |= _named([found.presumed, found.stated])
    k = tuple(float(i) for i in range(ITERATIONS + 1))
    threshold = found.printed.threshold
    return Figure(
        "figure_4", "Figure 4: largest integrated error over iterations", "iteration [1]", "max dQint [mm + rad]",
        "Largest dQint of 10 poses, one drawing of noise each, beside the published rule max "
        f"dQint <= {threshold:g},"
        f" said to be met after {found.printed.iterations} iterations. The published curve is not "
        "in our text. dQint adds"
        " mm and rad as they are.",
        tuple(Series(label, k, tuple(map(float, run.integrated))) for label, run in runs.items()),
        {f"published rule {threshold:g}": threshold},
    )  # fmt: skip


def _figure_noise(found: Results) -> Figure:
    """Sizes after calibration over the noise, where angles go with lengths as 1e-3 rad / mm."""
    line = sorted(
        (x for x in found.levels if np.isclose(x.limits[1], 1e-3 * x.limits[0], atol=0.0)),
        key=lambda x: x.limits[0],
    )
    x = tuple(level.limits[0] for level in line)
    published = study_noise.published_sizes(found.printed)
    labels = {"parameter error rms [mm]": 2, "pose residual rms [mm]": 0}
    series = [
        Series(label, x, tuple(float(level.median[i]) for level in line))
        for label, i in labels.items()
    ]
    levels = {
        f"published, Table {table}": float(published[i])
        for table, i in zip((5, 6), labels.values(), strict=True)
    }
    before = float(np.sqrt(np.mean(found.exact.parameter_errors(found.study.truth)[0] ** 2)) / MM)
    return Figure(
        "noise", "What is left after calibration, over the noise", "noise +- [mm], with 1e-3 rad / "
                                                                   "mm", "rms [mm]",
        f"Medians of {len(line[0].needed)} drawings, leg by leg, after {found.printed.iterations} "
        "iterations. Published"
        f" levels are met near +-1e-6 mm; the stated noise is +-{found.printed.noise / MM:g} mm.",
        tuple(series), {**levels, "before calibration": before}, "xy",
    )  # fmt: skip


def _about(paper: Paper) -> tuple[str, ...]:
    done = (
        f"What the paper does, done again by `loopcal reproduce {paper.name}`: errors are assumed "
        "in the 42 parameters of a"
        " hexapod, ten poses are simulated with them, and the parameters are identified from the "
        "poses by least squares, leg by"
        " leg, every equation of weight one, until the largest pose error max dQint is at most "
        "1e-6."
    )
    return (
        done,
        (
            f"{published().source} What the missing equations must say follows from equations (6) "
            "and "
            "(9)."
        ),
    )
