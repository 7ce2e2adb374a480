# SPDX-License-Identifier: Apache-2.0
"""The whole study: compute everything, put it beside the printed tables, judge the claims."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.findings.wording import fill_template
from loopcal.papers import published
from loopcal.papers.hexapod_42 import steps
from loopcal.papers.hexapod_42.steps import (
    MM,
    ODD_POSE,
    PRESUMED,
    PRINTED,
    SIZES,
    STATED,
    TO_PRINTED,
    Draws,
    Setup,
    compute_rms,
    find_places,
)
from loopcal.papers.paper import StudyCase
from loopcal.papers.published import decide
from loopcal.studies.simulation.published_steps import list_raw_units
from loopcal.typing import BoolArray

TEXT = published.PaperText(__file__)

METHODS = {
    "before": "not calibrated",
    "alone": "leg by leg, unweighted (the paper)",
    "together": "all legs, weighted by the noise",
    "prior": "the same with tolerances as prior (MAP)",
}
RUNS = ("without noise", "without noise, one matrix throughout")
"""Titles of the runs without noise, of which the second keeps the matrix of step 5."""

# Limits of decisions; a number between the two of a pair decides nothing.
UNITS = (1.0, 2.0)  # of the last digit: a second one can come from the rounding of other tables
OF_RULE = ("converges", "threshold_noise")
"""Claims on what the rule of the paper leaves."""
AS_GOOD = 1.1  # ratio of errors
EXACT = 1e-6  # [mm] parameter error that steps without noise leave


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged."""

    setup: Setup  # the machine of Tables 2 and 3, or another one
    # "exact": without noise; "frozen": the same with one matrix; "presumed", "stated": with noise
    runs: Mapping[str, steps.Iterations]
    levels: Mapping[str, steps.Level]  # by noise of sizes.yaml
    methods: Mapping[str, Draws]  # by key of METHODS
    poses: list[published.Row]
    comparisons: Mapping[str, published.Comparison]  # of Tables 3 to 6; none of another robot


def compute(
    seed: int, trials: int, progress: Callable[[str], None], case: StudyCase | None = None
) -> Results:
    """Compute everything; case : another robot or rule.

    Raises EstimationError: the legs of the robot cannot be identified one by one.
    """
    setup = steps.make_setup(case, seed)
    progress("the ten steps")
    runs = {
        "exact": steps.iterate(setup, setup.actual),
        "frozen": steps.iterate(setup, setup.actual, is_renewed=False),
    }
    for name in (PRESUMED, STATED):
        drawn = steps.draw_measured_poses(setup, steps.list_noises()[name], seed)
        runs[name] = steps.iterate(setup, drawn)
    progress("levels of noise")
    levels = steps.sweep_noise(setup, seed, trials)
    progress("methods and numbers of poses")
    methods = steps.compare_methods(setup, seed, trials)
    poses = steps.compare_poses(setup, seed, trials)
    compared = compare_printed(setup, runs) if setup.is_printed else {}
    return Results(setup, runs, levels, methods, poses, compared)


def count_printed() -> int:
    """Return the iterations after which the paper's rule ends them."""
    return int(PRINTED.find("iterations", "value"))


def compare_tables(results: Results) -> tuple[published.Comparison, ...]:
    """Return Tables 3 to 6, printed beside computed."""
    return tuple(results.comparisons.values())


def compare_printed(
    setup: Setup, runs: Mapping[str, steps.Iterations]
) -> dict[str, published.Comparison]:
    """Return Tables 3 to 6 beside the computed numbers, by name."""
    used, robot, exact, noisy = count_printed(), setup.robot, runs["exact"], runs[PRESUMED]
    errors, places = setup.truth.values - noisy.values, find_places(robot)
    before, after = errors[0][places] / MM, errors[used][places] / (1e-3 * MM)
    identified = (exact.values[used + 1] - robot.values)[places] / MM
    noise, six = _describe_noise(PRESUMED), PRINTED.table("table_6", "before")
    first, unit = (setup.actual - setup.poses) * TO_PRINTED, PRINTED.table("table_4", "PP").unit
    compare, printed = TEXT.compare, PRINTED.table
    compared = (
        compare("table_3", printed("table_3"), identified, iterations=used + 1),
        _compare_table_4(setup),
        compare("table_5_before", printed("table_5", "before"), before),
        compare("table_5_after", printed("table_5", "after"), after, noise=noise),
        compare("table_6_before", six, first, np.maximum(six.unit, unit)),
        compare("table_6_after", printed("table_6", "after"), noisy.pose_errors[used] * TO_PRINTED,
                noise=noise),
    )  # fmt: skip
    return {comparison.name: comparison for comparison in compared}


def _compare_table_4(setup: Setup) -> published.Comparison:
    """Return nominal poses, actual poses and their differences beside the computed ones. A
    difference is no finer than the poses it was taken from.
    """
    printed = {name: PRINTED.table("table_4", name) for name in ("PT", "PP", "E1")}
    computed = {"PT": setup.poses, "PP": setup.actual, "E1": setup.actual - setup.poses}
    units = {name: block.unit for name, block in printed.items()}
    units["E1"] = np.maximum(units["E1"], units["PP"])
    order = [(i, row, name) for i, row in enumerate(printed["PT"].labels) for name in printed]
    texts = {f"{row} {name}": printed[name].rows[row] for _, row, name in order}
    numbers = np.array([computed[name][i] for i, _, name in order]) * TO_PRINTED
    unit = np.array([units[name][i] for i, _, name in order])
    return TEXT.compare("table_4", published.Printed(texts), numbers, unit, row=ODD_POSE)


def list_replaced(results: Results) -> tuple[str, ...]:
    """Return sentences on a rule that is replaced, and on what belongs to the paper's robot."""
    setup, printed = results.setup, PRINTED.number("threshold", "value")
    data = {"epsilon": setup.epsilon, "printed": printed, "robot": setup.robot.name,
            "noise": PRINTED.number("noise", "value")}  # fmt: skip
    is_replaced = {"epsilon": setup.epsilon != printed, "robot": not setup.is_printed}
    texts = published.PaperFile(__file__, "text.yaml").find("replaced")
    return tuple(fill_template(texts[key], **data) for key, yes in is_replaced.items() if yes)


def make_tables(results: Results) -> tuple[published.Table, ...]:
    """Return the tables beyond those of the paper."""
    setup, levels = results.setup, results.levels
    runs, trials, count = results.runs.values(), len(levels[STATED].needed), len(setup.poses)
    rule = {"threshold": setup.epsilon, "limit": SIZES.find("iterations"), "count": count}
    states = zip(*(run.integrated for run in runs), strict=True)
    figure_4 = [(str(k), *sizes) for k, sizes in enumerate(states)]
    figure_4.append(("iterations needed", *(run.count_needed(setup.epsilon) for run in runs)))
    conditions = [(f"leg {i}", x) for i, x in enumerate(results.runs["exact"].conditions, 1)]
    noise = [
        (*level.limits, *level.median, f"{np.isfinite(level.needed).sum()} of {len(level.needed)}")
        for level in levels.values()
    ]
    places = [
        (f"position error, rms over draws, poses {name} [mm]", ".2g")
        for name in steps.list_places(setup)
    ]
    methods = [(METHODS[key], *draws.rms.values()) for key, draws in results.methods.items()]
    before = results.methods["before"].rms["parameters"]
    return (
        TEXT.table("figure_4", figure_4, "", (), presumed=_describe_noise(PRESUMED),
                   stated=_describe_noise(STATED), **rule),
        TEXT.table("conditions", conditions, count=count),
        *(() if setup.is_printed else _make_own_tables(results)),
        TEXT.table("noise", noise, **rule),
        TEXT.table("methods", methods, "", places, limits=levels[STATED].limits, trials=trials,
                   unmeasured=SIZES.find("unmeasured"), count=count),
        TEXT.table("poses", results.poses, trials=trials, before=before, wide=SIZES.find("wide"),
                   printed=setup.is_printed and (setup.poses.max(axis=0) * TO_PRINTED).tolist(),
                   tilt=np.rad2deg(setup.poses[:, 3:].max())),
    )  # fmt: skip


def _make_own_tables(results: Results) -> tuple[published.Table, ...]:
    """Return the parameters and poses of another robot, as Tables 2 to 6 have those of the paper's:
    errors that are left by the rule.
    """
    setup, runs = results.setup, results.runs
    ends = {name: run.find_end(setup.epsilon) for name, run in runs.items()}
    robot, truth = setup.robot, setup.truth.values
    left = [truth - runs[name].values[ends[name]] for name in ("exact", PRESUMED, STATED)]
    columns = list(map(robot.list_shown, (robot.values, truth - robot.values, *left)))
    parameters = [
        (p.name, robot.units[p.dimension], *(column[i] for column in columns))
        for i, p in enumerate(robot.parameters.entries)
        if p.free
    ]
    blocks = {"PT": setup.poses, "PP": setup.actual, "before": setup.actual - setup.poses,
              "after": runs[STATED].pose_errors[ends[STATED]]}  # fmt: skip
    poses = [
        (f"A{i + 1} {name}", *(block[i] * TO_PRINTED))
        for i in range(len(setup.poses)) for name, block in blocks.items()
    ]  # fmt: skip
    noises = {"presumed": _describe_noise(PRESUMED), "stated": _describe_noise(STATED)}
    return (
        TEXT.table("parameters", parameters, threshold=setup.epsilon, **noises),
        TEXT.table("pose_errors", poses, **noises),
    )


def _describe_noise(name: str) -> str:
    length, angle = steps.list_noises()[name]
    return f"noise within +-{length:g} mm, +-{angle:g} rad"


def make_figures(results: Results) -> tuple[published.Figure, ...]:
    """Return all figures."""
    return _draw_figure_4(results), _draw_noise(results)


def _draw_figure_4(results: Results) -> published.Figure:
    """Return max dQint by iteration."""
    threshold, count = results.setup.epsilon, len(results.setup.poses)
    labels = (*RUNS, _describe_noise(PRESUMED), _describe_noise(STATED))
    lines = [
        published.Series.of(label, range(len(run.integrated)), run.integrated)
        for label, run in zip(labels, results.runs.values(), strict=True)
    ]
    levels = {f"rule {threshold:g}": threshold}
    return TEXT.figure("figure_4", lines, levels, threshold=threshold, count=count,
                       iterations=count_printed(), tables=results.setup.is_printed)  # fmt: skip


def _draw_noise(results: Results) -> published.Figure:
    """Return the sizes after calibration by noise, with 1e-3 rad of angle noise per mm."""
    levels = [
        level
        for level in sorted(results.levels.values(), key=lambda level: level.limits)
        if np.isclose(level.limits[1], 1e-3 * level.limits[0], atol=0.0)
    ]
    x = [level.limits[0] for level in levels]
    places = {"parameter error": 2, "position residual": 0}
    lines = [
        published.Series.of(label, x, [level.median[i] for level in levels])
        for label, i in places.items()
    ]
    marks = {"parameter error before calibration": results.methods["before"].rms["parameters"]}
    stated, trials = results.levels[STATED].limits[0], len(levels[0].needed)
    return TEXT.figure("noise", lines, marks, trials=trials, noise=stated)


def judge_claims(results: Results) -> tuple[published.Verdict, ...]:
    """Return a verdict for each claim; those on the printed tables belong to their machine, and
    `OF_RULE` to the paper's rule.
    """
    verdicts = (
        *((_judge_table_4(results),) if results.setup.is_printed else ()),
        *_judge_steps(results),
        *_judge_methods(results),
    )
    is_rule = results.setup.epsilon == PRINTED.number("threshold", "value")
    return tuple(verdict for verdict in verdicts if is_rule or verdict.name not in OF_RULE)


def _count(values: BoolArray) -> int:
    return int(values.sum())


def _judge_table_4(results: Results) -> published.Verdict:
    """Judge the actual poses of Table 4, by the largest difference in units of the last digit."""
    fourth = results.comparisons["table_4"]
    rows = np.array([not x.endswith("PT") and x.split()[0] != ODD_POSE
                     for x in fourth.published.labels])  # fmt: skip
    units = (abs(fourth.difference) / fourth.step)[rows].max() / (1.0 + published.ROUNDING)
    good = fourth.within[rows]
    return TEXT.judge("table_4", decide(units <= UNITS[0], units > UNITS[1]), row=ODD_POSE,
                      agreeing=_count(good), count=good.size)  # fmt: skip


def _judge_steps(results: Results) -> tuple[published.Verdict, ...]:
    """Judge convergence and the stopping rule."""
    setup, used, judge = results.setup, count_printed(), TEXT.judge
    printed, elsewhere = PRINTED.number("threshold", "value"), not setup.is_printed
    exact, frozen = results.runs["exact"], results.runs["frozen"]
    counts = [run.count_needed(printed) for run in (exact, frozen)]
    units = list_raw_units(setup.robot.parameters.dimensions)
    largest = np.abs((setup.truth.values - exact.values) / units).max(axis=1)
    five = (abs(PRINTED.table("table_5", name).values).max() for name in ("before", "after"))
    share = 1e-3 / next(five) * next(five)
    stated, noise = results.levels[STATED], PRINTED.number("noise", "value")
    alone = results.methods["alone"]
    return (
        judge("exact", decide(largest[used] <= share * largest[0], largest[used] >= largest[0]),
              iterations=used, largest=largest[used], more=largest[used + 1], share=100.0 * share),
        judge("converges", alone.largest <= share, elsewhere=elsewhere,
              parameters=_count(setup.robot.parameters.free), iterations=used, noise=noise,
              ratio=np.median(alone.largest), share=100.0 * share),
        judge("threshold", decide(counts == [used, used], used not in counts), elsewhere=elsewhere,
              threshold=printed, iterations=used, exact=exact.integrated, frozen=frozen.integrated),
        judge("threshold_noise", stated.needed <= used, elsewhere=elsewhere, noise=noise,
              median=stated.median[3], angle=stated.limits[1]),
    )  # fmt: skip


def _judge_methods(results: Results) -> tuple[published.Verdict, ...]:
    """Judge what calibration improves, for each draw of noise; a lost draw improves nothing."""
    setup, elsewhere = results.setup, not results.setup.is_printed
    alone, together, before = (results.methods[key] for key in ("alone", "together", "before"))
    rms = {key: draws.rms for key, draws in results.methods.items()}
    at_measured = compute_rms(results.runs["exact"].pose_errors[0][:, :3] / MM)
    residuals = results.levels[STATED].sizes[:, 0]
    improved = np.array([alone.places[name] < before.places[name] for name in before.places])
    places = [
        {"place": name, **{key: draws.rms[name] for key, draws in results.methods.items()}}
        for name in before.places
    ]
    ratio = rms["alone"]["parameters"] / rms["together"]["parameters"]
    least = results.poses[0]
    own = next(row for row in results.poses if row["poses"] == steps.MEASURED)
    left = least["left"]
    enough = decide(
        left is not None and left < EXACT, left is None or left >= rms["before"]["parameters"]
    )
    return (
        TEXT.judge("parameters_improve", alone.halved > 0.5, elsewhere=elsewhere,
                   noise=results.levels[STATED].limits[0],
                   smaller=100.0 * np.median(alone.smaller), halved=100.0 * np.median(alone.halved),
                   ratio=rms["alone"]["parameters"] / rms["before"]["parameters"], rms=rms),
        TEXT.judge("poses_improve", residuals <= 0.5 * at_measured, elsewhere=elsewhere,
                   before=at_measured, after=np.median(residuals)),
        TEXT.judge("positions_improve", improved.all(axis=0), elsewhere=elsewhere, places=places),
        TEXT.judge("leg_by_leg", alone.parameters <= AS_GOOD * together.parameters, ratio=ratio,
                   rms=rms),
        TEXT.judge("fewest_poses", enough, elsewhere=elsewhere, least=least, own=own,
                   parameters=_count(setup.robot.parameters.free)),
    )  # fmt: skip
