# SPDX-License-Identifier: Apache-2.0
"""The whole study: compute everything, put it beside the printed tables, judge the claims."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from loopcal import geometry
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import inverse
from loopcal.papers.hexapod_42 import noise_study, table_4_study
from loopcal.papers.hexapod_42.noise_study import PRESUMED, STATED, Level, MethodResult, to_si
from loopcal.papers.hexapod_42.published import (
    MM,
    ODD_POSE,
    PARAMETERS,
    TO_PRINTED,
    Published,
    load_nominal_machine,
    make_true_machine,
    read_published,
    to_table,
)
from loopcal.papers.hexapod_42.steps import (
    ORDER,
    Iterations,
    Study,
    compute_actual_poses,
    draw_measured_poses,
    iterate,
)
from loopcal.papers.hexapod_42.table_4_study import Order, Outliers, write_rotation
from loopcal.papers.hexapod_42.verdicts import judge_claims
from loopcal.papers.printed import Cell, Comparison, Printed, Table
from loopcal.papers.reproduction import Content, Figure, Series
from loopcal.papers.wording import read_wording
from loopcal.typing import FloatArray

ITERATIONS = 5
"""Shown in figure 4."""


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged.

    Attributes
    ----------
    study, odd : the machine of Tables 2 and 3, and the same without errors of the leg lengths.
    exact, frozen, presumed, stated : the ten steps without noise, the same with one matrix
        throughout, and with two levels of noise.
    levels, methods, poses : see noise_study.py. orders, outliers, rounding : see table_4_study.py.
    comparisons : by name of the table. explained : (6,) and noise : (n, 6) [m, rad], what Tables 5
        and 6 imply, see noise_study.py.
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
    poses: list[tuple[Cell, ...]]
    orders: tuple[Order, ...]
    outliers: Outliers
    rounding: list[tuple[Cell, ...]]
    comparisons: Mapping[str, Comparison]
    explained: FloatArray
    noise: FloatArray


def present(results: Results, seed: int) -> Content:
    """Return the results as tables, verdicts and figures; `seed` is that of `compute`."""
    del seed
    return (
        tuple(results.comparisons.values()),
        make_tables(results),
        judge_claims(results),
        (_draw_figure_4(results), _draw_noise(results)),
    )


def compute(seed: int, trials: int, progress: Callable[[str], None]) -> Results:
    """Compute everything."""
    printed, robot = read_published(), load_nominal_machine()
    errors = printed.errors.values * MM
    truth, without = (
        make_true_machine(robot, errors, with_lengths) for with_lengths in (True, False)
    )
    poses = round_to_degrees(printed.nominal_poses)
    measured = printed.measured_poses.values / TO_PRINTED
    study, odd = Study(robot, truth, poses), Study(robot, without, poses)
    progress("the ten steps")
    actual = compute_actual_poses(study)
    exact, frozen = (iterate(study, actual, ITERATIONS, renewed) for renewed in (True, False))
    presumed, stated = (
        iterate(study, draw_measured_poses(study, to_si(limits), seed), ITERATIONS)
        for limits in (PRESUMED, STATED)
    )
    progress("Euler orders and outliers of Table 4")
    good = np.array([label != ODD_POSE for label in printed.measured_poses.labels])
    orders = table_4_study.rank_euler_orders(robot, truth, poses[good], measured[good])
    outliers = table_4_study.search_outliers(study, printed, measured)
    rounding = table_4_study.calibrate_from_print(study, printed, measured)
    progress("levels of noise")
    threshold = printed.threshold
    levels = noise_study.sweep_noise(study, printed.iterations, threshold, seed, trials)
    progress("methods and numbers of poses")
    return Results(
        printed=printed,
        study=study,
        odd=odd,
        exact=exact,
        frozen=frozen,
        presumed=presumed,
        stated=stated,
        levels=levels,
        methods=noise_study.compare_methods(study, seed, trials),
        poses=noise_study.compare_poses(study, threshold, seed, trials),
        orders=orders,
        outliers=outliers,
        rounding=rounding,
        comparisons={c.name: c for c in compare_tables(printed, study, odd, exact, presumed)},
        explained=noise_study.compute_explained_share(study, printed),
        noise=noise_study.recover_noise(study, printed),
    )


def round_to_degrees(poses: Printed) -> FloatArray:
    """Return nominal poses (n, 6) [m, rad]; the printed radians are whole degrees to their last
    digit.
    """
    values = poses.values / TO_PRINTED
    return np.concatenate([values[:, :3], np.deg2rad(np.round(np.rad2deg(values[:, 3:])))], axis=1)


def compare_tables(
    printed: Published, study: Study, odd: Study, exact: Iterations, noisy: Iterations
) -> tuple[Comparison, ...]:
    """Return Tables 2 to 6, printed beside computed."""
    words, robot, k = read_wording(__file__), study.robot, printed.iterations
    errors = noisy.compute_parameter_errors(study.truth)
    actual = compute_actual_poses(study)
    first = (actual - study.poses) * TO_PRINTED
    identified = to_table(robot, exact.machines[k + 1].values - robot.values) / MM
    noise = _describe_noise(PRESUMED)
    row = printed.measured_poses.labels.index(ODD_POSE)
    odd_row = compute_actual_poses(odd)[row : row + 1] * TO_PRINTED
    before, after = to_table(robot, errors[0]) / MM, to_table(robot, errors[k]) / (1e-3 * MM)
    return (
        words.compare("table_2", printed.nominal, make_symmetric(robot, printed)),
        words.compare("table_3", printed.errors, identified, iterations=k + 1),
        _compare_table_4(printed, study),
        words.compare("table_4_a2", printed.measured_poses.only(ODD_POSE), odd_row),
        words.compare("table_5_before", printed.parameter_errors_before, before),
        words.compare("table_5_after", printed.parameter_errors_after, after, noise=noise),
        words.compare("table_6_before", printed.pose_errors_before, first,
                      _find_coarsest(printed, printed.pose_errors_before)),
        words.compare("table_6_after", printed.pose_errors_after,
                      noisy.pose_errors[k] * TO_PRINTED, noise=noise),
    )  # fmt: skip


def make_symmetric(robot: Mechanism, printed: Published) -> FloatArray:
    """Return Table 2 (6, 7) [mm] of a hexapod with threefold symmetry, from its first two legs."""
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


def make_tables(results: Results) -> tuple[Table, ...]:
    """Return the tables beyond those of the paper."""
    words, printed = read_wording(__file__), results.printed
    trials = len(results.levels[0].needed)
    runs = (results.exact, results.frozen, results.presumed, results.stated)
    figure_4: list[tuple[Cell, ...]] = [
        (str(k), *(float(run.integrated[k]) for run in runs)) for k in range(ITERATIONS + 1)
    ]
    needed = [run.count_needed(printed.threshold) for run in runs]
    figure_4.append(("iterations needed", *needed))
    stated = write_rotation(printed.order)
    low, high = noise_study.RANGES[noise_study.WIDE]
    sizes = noise_study.compute_published_sizes(printed)
    return (
        words.table("figure_4", figure_4, threshold=printed.threshold,
                    iterations=printed.iterations, presumed=_describe_noise(PRESUMED),
                    stated=_describe_noise(STATED)),
        words.table("conditions", [(f"leg {i + 1}", float(value))
                                   for i, value in enumerate(results.exact.conditions)]),
        words.table("euler_orders", [(o.formula, i + 1, o.position, o.rotation, o.formula == stated)
                                     for i, o in enumerate(results.orders)]),
        words.table("outliers", table_4_study.list_outliers(results.outliers),
                    largest=max(fit.drop for fit in results.outliers.last)),
        words.table("rounding", results.rounding, rotation=write_rotation(ORDER)),
        words.table("noise", noise_study.list_levels(results.levels, sizes),
                    iterations=printed.iterations),
        words.table("methods", [(m.method, m.parameters, m.narrow, m.wide)
                                for m in results.methods],
                    limits=STATED, trials=trials, unmeasured=noise_study.UNMEASURED),
        words.table("poses", results.poses, trials=trials, low=low, high=high,
                    before=noise_study.compute_initial_error(results.study)),
    )  # fmt: skip


def _compare_table_4(printed: Published, study: Study) -> Comparison:
    """Return nominal poses, actual poses and their differences beside the computed ones."""
    actual = compute_actual_poses(study)
    blocks = {
        "PT": (printed.nominal_poses, study.poses, printed.nominal_poses.unit),
        "PP": (printed.measured_poses, actual, printed.measured_poses.unit),
        "E1": (
            printed.pose_errors,
            actual - study.poses,
            _find_coarsest(printed, printed.pose_errors),
        ),
    }
    labels = printed.nominal_poses.labels
    order = [(i, name) for i in range(len(actual)) for name in blocks]
    texts = {f"{labels[i]} {name}": blocks[name][0].rows[labels[i]] for i, name in order}
    computed = np.array([blocks[name][1][i] for i, name in order]) * TO_PRINTED
    yardstick = np.array([blocks[name][2][i] for i, name in order])
    words = read_wording(__file__)
    return words.compare("table_4", Printed(texts), computed, yardstick, row=ODD_POSE)


def _find_coarsest(printed: Published, errors: Printed) -> FloatArray:
    """Return the units of differences, which are no finer than the poses they were taken from."""
    return np.maximum(errors.unit, printed.measured_poses.unit)


def _describe_noise(limits: tuple[float, float]) -> str:
    return f"noise within +-{limits[0]:g} mm, +-{limits[1]:g} rad"


def _draw_figure_4(results: Results) -> Figure:
    """Return max dQint by iteration."""
    printed = results.printed
    runs = {
        "without noise": results.exact,
        "without noise, one matrix throughout": results.frozen,
        _describe_noise(PRESUMED): results.presumed,
        _describe_noise(STATED): results.stated,
    }
    k = tuple(float(i) for i in range(ITERATIONS + 1))
    lines = [Series(label, k, tuple(map(float, run.integrated))) for label, run in runs.items()]
    levels = {f"published rule {printed.threshold:g}": printed.threshold}
    data = {"threshold": printed.threshold, "iterations": printed.iterations}
    return read_wording(__file__).figure("figure_4", lines, levels, **data)


def _draw_noise(results: Results) -> Figure:
    """Return the sizes after calibration by noise, with 1e-3 rad of angle noise per mm."""
    levels = sorted(
        (x for x in results.levels if np.isclose(x.limits[1], 1e-3 * x.limits[0], atol=0.0)),
        key=lambda level: level.limits[0],
    )
    x = tuple(level.limits[0] for level in levels)
    sizes = noise_study.compute_published_sizes(results.printed)
    places = {"parameter error rms [mm]": (2, 5), "pose residual rms [mm]": (0, 6)}
    lines = [
        Series(label, x, tuple(float(level.median[i]) for level in levels))
        for label, (i, _) in places.items()
    ]
    marks = {f"published, Table {number}": float(sizes[i]) for i, number in places.values()}
    marks["before calibration"] = noise_study.compute_initial_error(results.study)
    data = {"trials": len(levels[0].needed), "iterations": results.printed.iterations}
    noise = results.printed.noise / MM
    return read_wording(__file__).figure("noise", lines, marks, noise=noise, **data)
