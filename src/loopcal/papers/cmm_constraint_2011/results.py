# SPDX-License-Identifier: Apache-2.0
"""The whole study: points on planes and perpendicular lines, drawn machines, calibrations by LS and
MAP, and errors at held-out poses; its tables, figures and verdicts.

Robot and workspace are those of a robot file, by default of hexapod-nategh-agheli: the paper's
Tables 1 and 2 are not in our text. A set of 1 mm is one spread of the robot file. Machines are
drawn, held and calibrated by the cells of a study, see `studies/simulation/block.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import groupby
from operator import itemgetter
from time import process_time
from typing import Any

import numpy as np

from loopcal import geometry
from loopcal.diagnose.gauge_freedoms import NO_MOTION, SAME_MOTION, sample_motions, weigh_motions
from loopcal.diagnose.identifiable_parameters import identifiability
from loopcal.estimate.free_parameters import Combination
from loopcal.findings import report_finding
from loopcal.findings.wording import list_names
from loopcal.measure.instrument import Gaussian
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION as POSITION_AXES
from loopcal.mechanism.solutions import Solution
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.decomposition import are_nonzero
from loopcal.papers import published
from loopcal.papers.paper import PAPERS, StudyCase
from loopcal.papers.published import PaperFile, Row, decide, decide_each, decide_share
from loopcal.planning import plane_line_planning
from loopcal.planning.design_space import ObservableSpace, PriorInformation, find_observable_space
from loopcal.planning.exchange import MovedDesign
from loopcal.planning.plane_line_planning import PlaneLineGroups
from loopcal.studies.simulation.block import calibrate_cells, set_size
from loopcal.studies.simulation.machines import build_robot_of, measure_held_points
from loopcal.studies.simulation.published_steps import Layout, linearize_products, map_displacements
from loopcal.studies.specification import FEWEST_POINTS, PosesLevel
from loopcal.studies.specification import Study as GridStudy
from loopcal.typing import BoolArray, FloatArray, IntArray

MM, DEGREE = 1e-3, np.pi / 180.0
PRINTED, SIZES = PaperFile(__file__, "published.yaml"), PaperFile(__file__, "sizes.yaml")
CASE = StudyCase(PAPERS["cmm-constraint-2011"])
BEFORE, LS, PRIOR = "before", "LS", "MAP"
METHODS = (LS, PRIOR)
ABSOLUTE, AT_NOMINAL, ALIGNED = FRAMES = ("absolute", "gauge at nominal", "aligned")
"""Placements of the base and the rotation of the platform, which plane and line do not determine:
as the least deviation leaves them; with poses nearest to the nominal ones, which needs no truth;
with poses nearest to the true ones.
"""
# Error of a pose -> its components of a twist, and its unit.
PARTS: Mapping[str, tuple[slice, float, str]] = {
    "position": (slice(3, None), MM, "mm"), "orientation": (slice(3), DEGREE, "deg"),
}  # fmt: skip
# Of the errors over poses: the root mean square, the mean, the standard deviation.
STATISTICS = ("", ", mean", ", standard deviation")
PARAMETERS, DETERMINED = "parameters", "determined parameters"
"""Norm of the errors of the parameters, and of their part that plane and line can determine."""
# Singular values, relative to the largest, whose squares are rounding: log det cannot use them.
SQUARED_ROUNDING = 1e-7
# Groups that show whether the drawn ones determine all that planes and lines can determine.
MORE_GROUPS = 3
Key = tuple[str, str]
"""A set of errors and a noise, as printed or as numbers in mm."""


def name_planes(groups: int) -> str:
    """Return the number of planes and lines in words."""
    return "one plane, one line" if groups == 1 else f"{groups} planes, a line each"


def take_median(numbers: FloatArray) -> float:
    """Return the median of the finite numbers; NaN without any."""
    kept = numbers[np.isfinite(numbers)]
    return float(np.median(kept)) if len(kept) else np.nan


def name_measure(what: str, frame: str, statistic: str = "") -> str:
    """Return the name of the errors of poses, of PARTS, in a frame."""
    return f"{what}, {frame}{statistic}"


def find_figure_5() -> Key:
    """Return the printed set of errors and noise of figure 5."""
    given = PRINTED.find("figure_5_cell")
    return PRINTED.find("sets").split()[int(given["set"]) - 1], given["noise"]


def load_grid(case: StudyCase, seed: int, trials: int) -> GridStudy:
    """Return study.yaml of the robot with the printed sets, noises and numbers of points.

    Raises EstimationError: the end point of the robot cannot follow planes and lines.
    """
    if case.robot is not None:
        PlaneLineGroups(case.robot, FEWEST_POINTS, MM)
    grid = set_size(case.load_study(), seed, trials)
    (name, poses), points = next(iter(grid.poses.items())), PRINTED.find("points")
    sets, noises = (PRINTED.find(key).split() for key in ("sets", "noises"))
    return replace(
        change_sizes(grid, {x: float(x) for x in sets}, {x: float(x) for x in noises}),
        poses={name: replace(poses, count=int(points["simulated"]))},
        scores=replace(grid.scores, held_out=int(points["compared"])),
    )


def change_sizes(
    grid: GridStudy, errors: Mapping[str, float], noises: Mapping[str, float]
) -> GridStudy:
    """Return a study with these errors [mm, a spread each] and noises [mm], by their names."""
    error, held = (next(iter(levels.values())) for levels in (grid.errors, grid.instruments))
    return replace(
        grid,
        errors={name: replace(error, tolerance_factor=x) for name, x in errors.items()},
        instruments={name: replace(held, sigma_position=x * MM) for name, x in noises.items()},
    )


@dataclass(frozen=True, eq=False)
class Study:
    """The points a robot is sent to, and the poses at which it is judged."""

    grid: GridStudy  # cells of Table 3, which measure these points
    planned: PlaneLineGroups  # how groups are written as designs
    first: FloatArray  # design before coordinate exchange
    optimized: MovedDesign  # design after it

    @property
    def robot(self) -> Mechanism:
        """As designed."""
        return self.planned.robot

    @cached_property
    def layout(self) -> Layout:
        """The measured points."""
        return Layout(self.robot, self.planned.place_points(self.optimized.design))

    @cached_property
    def held_out(self) -> Solution:
        """Random poses with another seed than the points, as the robot is commanded to them."""
        count = self.grid.scores.held_out
        return sample_workspace(self.robot, count, self.grid.seed + 1).solution

    @property
    def parts(self) -> tuple[str, ...]:
        """Errors of poses that the robot can have: of PARTS, orientation if its platform turns."""
        turns = min(self.robot.program.freedoms) < 3
        return tuple(PARTS) if turns else ("position",)

    @cached_property
    def observable(self) -> ObservableSpace:
        """The directions of the free parameters, in spreads, that plane and line determine."""
        return find_directions(self.planned, self.optimized.design)

    @cached_property
    def unit(self) -> tuple[float, str]:
        """A spread of all parameters in mm, if they are lengths of one value; else one."""
        free = self.planned.free
        factor, symbols = free.display()
        is_one = set(symbols) == {"mm"} and np.ptp(free.tolerance) <= 1e-9 * free.tolerance[0]
        return (float((free.tolerance / factor)[0]), "mm") if is_one else (1.0, "spreads")

    def describe_errors(self, size: float | str) -> str:
        """Return the standard deviation of errors of so many spreads in words."""
        number, unit = float(size) * self.unit[0], self.unit[1]
        return f"{number:.3g} {unit.removesuffix('s') if number == 1.0 else unit}"

    def label(self, measure: str) -> str:
        """Return a measure with its unit."""
        _, _, unit = PARTS.get(measure.partition(",")[0], ((), 1.0, self.unit[1]))
        return f"{measure} [{unit}]"

    @cached_property
    def spreads(self) -> tuple[float, float]:
        """Rms standard deviation of the identifiable directions [spreads per mm of noise] before
        and after coordinate exchange.
        """
        both = []
        for rows in (self.planned.linearize(self.first), self.optimized.rows):  # noise of 1 mm
            s = np.linalg.svd(rows.reshape(-1, rows.shape[-1]), compute_uv=False)
            s = s[: len(self.observable)]
            both.append(float(self.unit[0] * np.sqrt(np.mean(1.0 / s**2))))
        return both[0], both[1]

    def solve(self, values: FloatArray) -> FloatArray:
        """Return held-out tool poses (t, n, 4, 4) of machines (t, p) at the nominal readings."""
        T = forward_trials(self.robot, values, self.held_out.q[None], self.held_out.state).T
        return T @ self.robot.tool

    def compute_twists(self, T: FloatArray, true: FloatArray, frame: str) -> FloatArray:
        """Return differences (t, n, 6) [rad, m], rotation first, of poses (t | 1, n, 4, 4) from
        true ones (t, n, 4, 4), in one of FRAMES.
        """
        T = np.broadcast_to(T, true.shape)
        if frame != ABSOLUTE:
            nominal = np.broadcast_to(self.held_out.T @ self.robot.tool, true.shape)
            T = fit_motions(T, true if frame == ALIGNED else nominal)
        return geometry.pose_difference(T, true)

    def remove_unobservable(self, deviation: FloatArray) -> FloatArray:
        """Return deviations (t, p) [SI] without their part that plane and line do not determine."""
        free, basis, kept = self.planned.free, self.observable.machine, np.zeros(deviation.shape)
        kept[:, free.places] = deviation[:, free.places] / free.tolerance @ basis @ basis.T
        kept[:, free.places] *= free.tolerance
        return kept

    def compute_errors(self, values: FloatArray, truth: FloatArray) -> dict[str, FloatArray]:
        """Return the errors (t,) of machines, values (t | 1, p) and truth (t, p) [SI], by measure:
        see `name_measure`, PARAMETERS and DETERMINED, in the units of `label`.
        """
        errors, T, true = dict[str, FloatArray](), self.solve(values), self.solve(truth)
        for frame in FRAMES:
            twists = self.compute_twists(T, true, frame)
            for what in self.parts:
                components, unit, _ = PARTS[what]
                size = np.linalg.norm(twists[..., components], axis=2) / unit
                mean, sd = size.mean(axis=1), size.std(axis=1)
                for statistic, of in zip(STATISTICS, (np.hypot(mean, sd), mean, sd), strict=True):
                    errors[name_measure(what, frame, statistic)] = of
        free, wrong = self.planned.free, values - truth
        for name, error in ((PARAMETERS, wrong), (DETERMINED, self.remove_unobservable(wrong))):
            scaled = error[:, free.places] / free.tolerance
            errors[name] = self.unit[0] * np.linalg.norm(scaled, axis=1)
        return errors


def plan_points(grid: GridStudy, level: PosesLevel | None = None) -> Study:
    """Draw groups at random and improve log det of their information by coordinate exchange.

    grid : study of a robot; what returns measures the planned points. level : number of points,
    planes with a line each, and sweeps (0: as drawn); by default that of the grid.
    """
    ((name, given),), (robot,) = grid.poses.items(), grid.robots.values()
    level = level or given
    points = level.count // level.groups
    planned = PlaneLineGroups(build_robot_of(robot.text).nominal, points, MM, ("z",))
    first = planned.draw(level.groups, grid.seed)
    more = planned.draw(level.groups + MORE_GROUPS, grid.seed)
    known, possible = (
        int(are_nonzero(s, SQUARED_ROUNDING).sum())
        for s in (find_directions(planned, x).singular_values for x in (first, more))
    )
    improved = plane_line_planning.improve_groups(planned, first, level.sweeps, known == possible)
    coordinates = planned.place_points(improved.design).reshape(level.count, -1)
    held = replace(level, coordinates=tuple(map(tuple, coordinates.tolist())))
    return Study(replace(grid, poses={name: held}), planned, first, improved)


def find_directions(planned: PlaneLineGroups, design: FloatArray) -> ObservableSpace:
    """Return the directions of the free parameters that groups determine without spreads."""
    none = PriorInformation.none(len(planned.free))
    return find_observable_space(planned.linearize(design), none)


def fit_motions(T: FloatArray, others: FloatArray) -> FloatArray:
    """Return poses (t, n, 4, 4) after the motion of the base and the turn of the tool that bring
    them nearest to others.

    Positions fix the base's motion (their least squares), then orientations the tool's turn
    (nearest rotations): what plane and line leave open, and nothing else.
    """
    x, y = T[..., :3, 3], others[..., :3, 3]
    middle, center = x.mean(axis=1, keepdims=True), y.mean(axis=1, keepdims=True)
    Q = geometry.project_to_rotations(np.swapaxes(y - center, 1, 2) @ (x - middle))
    R = Q[:, None] @ T[..., :3, :3]
    turn = geometry.project_to_rotations(np.sum(np.swapaxes(R, 2, 3) @ others[..., :3, :3], axis=1))
    return geometry.make_pose(R @ turn[:, None], (x - middle) @ np.swapaxes(Q, 1, 2) + center)


def compute_ranks(study: Study) -> list[Row]:
    """Return the ranks of random groups, and the smallest of all singular values (0 with fewer
    rows than parameters) relative to the largest.
    """
    ranks = []
    for groups, points in SIZES.find("ranks"):
        planned = replace(study.planned, points=points)
        space = find_directions(planned, planned.draw(groups, study.grid.seed))
        rank, s = len(space), space.singular_values / space.singular_values[0]
        last = s[-1] if len(s) == len(planned.free) else 0.0
        ranks.append({"groups": groups, "points": points, "rows": groups * (points - 2),
                      "rank": rank, "used": s[rank - 1], "last": last})  # fmt: skip
    return ranks


def compute_frame_effect(study: Study) -> float:
    """Return the largest relative change of equations (17) of a drawn machine if the measuring
    machine is moved by a meter and turned by a radian about each axis.
    """
    robot, layout = study.robot, study.layout
    q = layout.hold_points(sample_truth(robot, 1, study.grid.seed))[1]
    points, J, _ = layout.linearize_points(robot.parameters.nominal[None], q)
    R = geometry.exp_so3(np.ones(3))
    first, moved = linearize_products(points, J), linearize_products(points @ R.T + 1.0, R @ J)
    pairs = zip(first, moved, strict=True)
    return max(float(np.abs(b - a).max() / np.abs(a).max()) for a, b in pairs)


def compute_pair_rank(study: Study) -> tuple[int, int]:
    """Return the points of the first group, and how many of the equations (14) of all its pairs
    are independent: the rank of their derivatives by the points.
    """
    B = map_displacements(*(lever[:1] for lever in study.layout.levers))[0]
    rows = np.concatenate([np.zeros((1, B.shape[1])), B])  # of p_0, then those of (i, 0)
    i, j = np.triu_indices(len(rows), 1)
    return len(B) + 2, int(np.linalg.matrix_rank(rows[j] - rows[i], rtol=1e-9))


@dataclass(frozen=True, eq=False)
class Cell:
    """t machines with errors of one size, calibrated from points with noise of one size."""

    size: float  # standard deviation of the errors [spreads]
    noise: float  # standard deviation of a held coordinate [mm]
    errors: Mapping[str, Mapping[str, FloatArray]]  # by BEFORE, LS, MAP and measure, (t,)
    iterations: IntArray  # (t,) of LS
    converged: Mapping[str, BoolArray]  # by BEFORE, LS, MAP, (t,)
    truth: FloatArray  # (t, p) true values [SI]
    values: Mapping[str, FloatArray]  # by BEFORE, LS, MAP, (t | 1, p) values [SI]

    @property
    def ratio(self) -> float:
        """Noise over errors. To first order the reductions of cells depend on it only."""
        return float(f"{self.noise / self.size:.6g}")

    def is_within(self, most: int) -> BoolArray:
        """Return on which machines (t,) least squares converges within so many iterations."""
        return (self.iterations <= most) & self.converged[LS]

    def compute_median(self, method: str, measure: str, is_lost: bool = False) -> float:
        """Return the median over machines whose fit converged, or did not; NaN without any."""
        errors = self.errors[method][measure][self.converged[method] != is_lost]
        return float(np.median(errors)) if len(errors) else np.nan

    def compute_left(self, method: str, measure: str) -> FloatArray:
        """Return the part (t,) of the error that is left; NaN where the method did not converge."""
        left = self.errors[method][measure] / self.errors[BEFORE][measure]
        return np.where(self.converged[method], left, np.nan)

    def are_reduced(self, method: str, measures: Iterable[str]) -> list[bool | None]:
        """Return of each machine whether all of these errors fall; None if not converged."""
        left = np.stack([self.compute_left(method, measure) for measure in measures])
        return decide_each(left.max(axis=0) < 1.0, self.converged[method])


def calibrate(study: Study, grid: GridStudy | None = None) -> dict[Key, Cell]:
    """Draw machines, hold their coordinates with noise, calibrate, compare at held-out poses.

    grid : cells to compute, by default those of the study. Returns the cells by the names of errors
    and noise.
    """
    grid, cells = grid or study.grid, dict[Key, Cell]()
    get_key = itemgetter("errors", "instrument")
    for (errors, noise), group in groupby(calibrate_cells(grid), lambda c: get_key(c.levels)):
        made = {cell.levels["method"]: cell for cell in group}
        truth = made[LS].truth
        values = {BEFORE: study.robot.values[None]} | {m: cell.values for m, cell in made.items()}
        converged = {m: cell.is_converged for m, cell in made.items()}
        cells[errors, noise] = Cell(
            grid.errors[errors].tolerance_factor,
            grid.instruments[noise].sigma_position / MM,
            {name: study.compute_errors(v, truth) for name, v in values.items()},
            made[LS].iterations,
            {BEFORE: np.ones(len(truth), dtype=bool)} | converged,
            truth,
            values,
        )
    return cells


def rank_correlations(cells: Iterable[Cell], method: str) -> FloatArray:
    """Return of each machine (t,) the rank correlation over cells of what is left of the errors of
    parameters and positions: of its figure 4. NaN where a fit did not converge.
    """
    first, second = (
        np.stack([cell.compute_left(method, name) for cell in cells])
        for cells in [tuple(cells)]
        for name in (PARAMETERS, name_measure("position", ABSOLUTE))
    )
    ranks = [x.argsort(axis=0).argsort(axis=0) - 0.5 * (len(x) - 1) for x in (first, second)]
    products = (ranks[0] * ranks[1]).sum(axis=0) / (ranks[0] ** 2).sum(axis=0)
    return np.where(np.isfinite(first + second).all(axis=0), products, np.nan)


def place_fifty(grid: GridStudy, groups: int) -> GridStudy:
    """Return the study of the experiment: measured points drawn at random on so many planes, noise
    of the paper's instrument.
    """
    errors = SIZES.find("fifty", "errors")
    noise = PRINTED.find("accuracy", "accuracy")
    grid = change_sizes(grid, {f"{errors:g}": errors}, {noise: float(noise)})
    count = int(PRINTED.find("points", "measured"))
    return replace(grid, poses={"measured": PosesLevel(count, "plane-line", groups, sweeps=0)})


@dataclass(frozen=True, eq=False)
class Draw:
    """One draw of points, machines and noise."""

    cells: Mapping[Key, Cell]  # Table 3, by set and noise as printed
    fifties: Mapping[int, Cell]  # from the points of the experiment, by their planes
    seconds: tuple[float, ...]  # of a processor for a calibration of these, simulation included
    gain: float  # of coordinate exchange, see `Study.spreads`


def compute_draw(study: Study, progress: Callable[[str], None]) -> Draw:
    """Calibrate the machines of one seed from the points of a study."""
    progress("Table 3")
    cells = calibrate(study)
    progress("the points of the experiment")
    fifties, seconds = {}, []
    for groups in SIZES.find("fifty", "planes"):
        began = process_time()
        (fifties[groups],) = calibrate(study, place_fifty(study.grid, groups)).values()
        calibrations = study.grid.replicates * len(METHODS)
        seconds.append((process_time() - began) / calibrations)
    drawn, optimized = study.spreads
    return Draw(cells, fifties, tuple(seconds), drawn / optimized)


def list_undetermined(study: Study) -> list[tuple[str, float]]:
    """Return the directions that the points do not determine, in words, and their effect on the
    rows relative to the largest singular value.
    """
    robot, layout = study.robot, study.layout
    rows = study.optimized.rows.reshape(-1, len(study.planned.free))
    axes, number = plane_line_planning.list_axes(study.optimized.design), np.arange(layout.points)
    instrument = plane_line_planning.make_plane_line_instrument(
        robot, axes, number.reshape(layout.groups, -1), lambda _, n: Gaussian(np.full(n, MM))
    )
    exact = measure_held_points(layout, robot.values[None], instrument, 0, is_exact=True)
    combinations = identifiability(robot, exact.trial(0)).unidentifiable
    taken = list[tuple[str, FloatArray]]()
    others = [(str(c.meaning) or f"Changes of {list_names(c.names)}", c.direction)
              for c in combinations]  # fmt: skip
    for words, direction in [*find_frame_motions(study, combinations), *others]:
        unit = direction / np.linalg.norm(direction)
        basis = np.stack([*(n for _, n in taken), unit])
        if np.linalg.matrix_rank(basis, rtol=SAME_MOTION) == len(basis):
            taken.append((words, unit))
    largest = study.observable.singular_values[0]
    return [(words, float(np.linalg.norm(rows @ n) / largest)) for words, n in taken]


def find_frame_motions(
    study: Study, combinations: tuple[Combination, ...]
) -> list[tuple[str, FloatArray]]:
    """Return shifts along and rotations about the axes of the base and of the platform that lie in
    the span of combinations, in words, and as directions (p,) in spreads.
    """
    if not combinations:
        return []
    robot, free = study.robot, study.planned.free
    null = np.stack([c.direction for c in combinations], axis=1)
    T, D, *_ = sample_motions(robot)
    moved, *frames = weigh_motions(T, robot.size, D[:, :, free.places] * free.tolerance @ null)
    motions = []
    for name, frame in zip(("base", "platform"), frames, strict=True):
        for motion, columns in (("translation", frame[:, 3:]), ("rotation", frame[:, :3])):
            weights = np.linalg.lstsq(moved, columns, rcond=NO_MOTION)[0]
            off = np.linalg.norm(moved @ weights - columns, axis=0)
            for i in np.flatnonzero(off <= SAME_MOTION * np.linalg.norm(columns, axis=0)):
                words = report_finding("identifiability.frame-moves", frame=name, motion=motion,
                                       axis="xyz"[i], through_origin=True)  # fmt: skip
                motions.append((str(words), null @ weights[:, i]))
    return motions


# The whole study: choose points, draw machines, calibrate, and judge the claims.

TEXT = published.PaperText(__file__)
POSITION = name_measure("position", ALIGNED)


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged."""

    case: StudyCase
    study: Study  # the ten groups
    draws: tuple[Draw, ...]  # tables and figures show the first
    ranks: list[Row]  # of random groups
    pair: tuple[int, int]  # points of a group and rank of the equations of all its pairs
    frame_effect: float  # of a motion of the measuring machine on the equations
    undetermined: list[tuple[str, float]]  # directions, and their effect on the rows

    @property
    def cells(self) -> Mapping[Key, Cell]:
        """Table 3 of the first draw."""
        return self.draws[0].cells

    @property
    def figure_5(self) -> Cell:
        """Its cell of the first draw."""
        return self.cells[find_figure_5()]

    @property
    def trials(self) -> int:
        """Machines of each cell."""
        return len(self.figure_5.iterations)

    @property
    def is_elsewhere(self) -> bool:
        """Whether the dimensions are others than those of the paper."""
        return self.case.robot is not None or SIZES.find("dimensions") == "ours"

    def reduce(self, measure: str) -> FloatArray:
        """Return the reductions of an error [%] by least squares, figure 5, all machines."""
        cells = [draw.cells[find_figure_5()] for draw in self.draws]
        return 100.0 * (1.0 - np.concatenate([c.compute_left(LS, measure) for c in cells]))

    def reduce_median(self, measure: str) -> float:
        """Return the median reduction of an error [%] on the machines of the tables."""
        return take_median(100.0 * (1.0 - self.figure_5.compute_left(LS, measure)))

    def word_reduction(self, measure: str) -> str:
        """Return it in words."""
        return word_change(self.reduce_median(measure))

    def pool(self, judge: Callable[[Draw], Sequence[bool | None]]) -> list[bool | None]:
        """Return the decisions on the machines of all draws."""
        return [decision for draw in self.draws for decision in judge(draw)]


def compute(
    seed: int, trials: int, progress: Callable[[str], None], case: StudyCase = CASE,
    draws: int = 0, sweeps: int | None = None,
) -> Results:  # fmt: skip
    """Compute everything.

    draws : of points, machines and noise, by default those of sizes.yaml. sweeps : of the
    coordinate exchange, by default those of study.yaml.

    Raises EstimationError: a robot whose end point cannot be held on planes and lines.
    """
    draws, drawn = draws or SIZES.find("draws"), list[Draw]()
    grid = load_grid(case, seed, trials)
    (level,) = grid.poses.values()
    level = level if sweeps is None else replace(level, sweeps=sweeps)
    progress("coordinate exchange")
    study = plan_points(grid, level)
    for i in range(draws):
        points = replace(grid, seed=seed + SIZES.find("seed_step") * i)
        label = f"draw {i + 1} of {draws}"
        drawn.append(
            compute_draw(
                plan_points(points, level) if i else study,
                lambda step, label=label: progress(f"{label}: {step}"),
            )
        )
    return Results(
        case=case,
        study=study,
        draws=tuple(drawn),
        ranks=compute_ranks(study),
        pair=compute_pair_rank(study),
        frame_effect=compute_frame_effect(study),
        undetermined=list_undetermined(study),
    )


def word_change(reduction: float) -> str:
    """Return the reduction of an error [%] in words, such as "51 % smaller" or "2 % larger"."""
    return f"{abs(reduction):.0f} % {'smaller' if reduction >= -0.5 else 'larger'}"


def list_replaced(results: Results) -> tuple[str, ...]:
    """Return sentences on further sizes that another robot replaces."""
    if results.case.robot is None:
        return ()
    study = results.study
    errors, name = study.describe_errors(find_figure_5()[0]), study.robot.name
    kept = ["errors", *(["fixed"] if len(study.parts) == 1 else [])]
    return TEXT.list_replaced(kept, errors=errors, robot=name, unit=study.unit[1])


def compare_tables(results: Results) -> tuple[published.Comparison, ...]:
    """Return the stated numbers of figure 5 beside computed ones; nothing for other robots."""
    if results.case.robot is not None:
        return ()
    counts = published.Printed.parse({
        "parameters identified": PRINTED.find("parameters"),
        "iterations for the measured points, at most": PRINTED.find("experiment", "iterations"),
    })  # fmt: skip
    rank = max(row["rank"] for row in results.ranks)
    iterations = max(int(cell.iterations.max()) for cell in results.draws[0].fifties.values())
    figure, measures = PRINTED.find("figure_5"), list_printed_measures(results.study)
    stated = published.Printed.parse({name: figure[name]["stated"] for name in measures})
    falls = np.array([[results.reduce_median(measure)] for measure in measures.values()])
    return (
        TEXT.compare("counts", counts, np.array([[float(rank)], [float(iterations)]])),
        TEXT.compare("figure_5", stated, falls),
    )


def make_tables(results: Results) -> tuple[published.Table, ...]:
    """Return all tables of the reproduction."""
    study, first, trials = results.study, results.draws[0], results.trials
    parts = study.parts
    fifty = [
        (name_planes(groups), frame, *row)
        for groups, cell in first.fifties.items() for frame in FRAMES
        for row in list_methods(cell, list_statistics(study, frame))
    ]  # fmt: skip
    cell = next(iter(first.fifties.values()))
    experiment = {"errors": study.describe_errors(cell.size), "noise": cell.noise}
    statistics = [(study.label(name_measure(what, "", s)).replace(", ,", ","), ".3g")
                  for what in parts for s in STATISTICS[1:]]  # fmt: skip
    aligned = tuple(name_measure(what, ALIGNED) for what in parts)
    absolute = tuple(name_measure(what, ABSOLUTE) for what in parts)
    at_nominal = name_measure("position", AT_NOMINAL)
    return (
        _list_given(study),
        TEXT.table("ranks", [tuple(row.values()) for row in results.ranks],
                   parameters=len(study.planned.free)),
        TEXT.table("gauge", results.undetermined, count=len(results.undetermined)),
        _list_table_3(results, "table_3", (*aligned, DETERMINED)),
        _list_table_3(results, "table_3_absolute", (*absolute, at_nominal, PARAMETERS)),
        TEXT.table("table_4", fifty, "", statistics, trials=trials, **experiment),
    )  # fmt: skip


def list_printed_measures(study: Study) -> dict[str, str]:
    """Return which errors of figure 5 the robot has, and their measures in the absolute frame."""
    return {
        name: PARAMETERS if name == PARAMETERS else name_measure(name, ABSOLUTE)
        for name in PRINTED.find("figure_5")
        if name in (PARAMETERS, *study.parts)
    }


def list_statistics(study: Study, frame: str) -> list[str]:
    """Return the means and standard deviations of Table 4 in a frame."""
    return [name_measure(what, frame, s) for what in study.parts for s in STATISTICS[1:]]


def list_methods(cell: Cell, measures: Sequence[str]) -> Iterator[tuple[Any, ...]]:
    """Yield method, number of machines and medians; machines on which a method did not converge
    have a row of their own.
    """
    for method in (BEFORE, *METHODS):
        for is_lost in (False, True):
            count = int((cell.converged[method] != is_lost).sum())
            medians = (cell.compute_median(method, measure, is_lost) for measure in measures)
            if count or not is_lost:
                name = f"{method}, not converged" if is_lost else method
                yield (name, count, *(x if np.isfinite(x) else None for x in medians))


def _list_given(study: Study) -> published.Table:
    robot, scale = study.robot, {"m": (MM, "mm"), "rad": (DEGREE, "deg")}
    rows = [("robot", f"{robot.name}, {len(study.planned.free)} free parameters")]
    for name, (low, high) in robot.assembly.workspace.items():
        unit, symbol = scale["m" if name in POSITION_AXES else "rad"]
        rows.append((f"workspace, {name}", f"{low / unit:.4g} to {high / unit:.4g} {symbol}"))
    groups, points = study.layout.groups, study.layout.points
    each = f"{groups} planes of equal z, {points // groups} points each with their line"
    sets = ", ".join(study.describe_errors(level.tolerance_factor)
                     for level in study.grid.errors.values())  # fmt: skip
    history = ", ".join(f"{v:.1f}" for v in study.optimized.history)
    exchange = f"log det {history} [spreads, noise 1 mm]"
    rows += [("standard deviations of the errors", sets), ("points", each)]
    return TEXT.table("given", [*rows, ("coordinate exchange", exchange)])


def _list_table_3(results: Results, name: str, measures: tuple[str, ...]) -> published.Table:
    rows, study, last = list[tuple[Any, ...]](), results.study, ""
    for (given, noise), cell in sorted(results.cells.items(), key=lambda of: of[1].size):
        errors = study.describe_errors(given)
        for method, *numbers in list_methods(cell, measures):
            if method == BEFORE and given == last:
                continue
            left = cell.compute_left(method, measures[0]) if method in METHODS else None
            worse = None if left is None else int((left > 1.0).sum())
            rows.append((errors, "-" if method == BEFORE else noise, method, *numbers, worse))
        last = given
    more = [(study.label(measure), ".2g") for measure in measures]
    more.append((f"worse than before in {measures[0]}", "d"))
    return TEXT.table(name, rows, "", more, trials=results.trials,
                      poses=study.grid.scores.held_out)  # fmt: skip


def make_figures(results: Results) -> Iterator[published.Figure]:
    """Yield pose error over parameter error, both after / before, so that growth has a place;
    position errors of single poses of the first machine, before and after; and the position error
    by noise, for each set of errors.
    """
    absolute = (PARAMETERS, name_measure("position", ABSOLUTE))
    lines = []
    for frame, measures in {"": absolute, ", aligned": (DETERMINED, POSITION)}.items():
        for method in METHODS:
            both = sorted(
                tuple(take_median(cell.compute_left(method, m)) for m in measures)
                for cell in results.cells.values()
            )
            x, y = zip(*both, strict=True)
            lines.append(published.Series.of(f"{method}{frame}", x, y))
    yield TEXT.figure("figure_4", lines, joined=False, count=len(results.cells))

    study, made, sizes = results.study, results.figure_5, {}
    true = study.solve(made.truth[:1])
    for name, values in made.values.items():
        T = study.solve(values[:1])
        for frame in (ABSOLUTE, ALIGNED):
            twists = study.compute_twists(T, true, frame)[0]
            label = name if frame == ABSOLUTE else f"{name}, {frame}"
            sizes[label] = np.linalg.norm(twists[:, 3:], axis=1) / MM
    order = np.argsort(sizes[BEFORE])
    x = range(1, len(order) + 1)
    lines = [published.Series.of(label, x, size[order]) for label, size in sizes.items()]
    yield TEXT.figure("figure_5", lines, joined=False, errors=study.describe_errors(made.size),
                      noise=made.noise, count=len(order))  # fmt: skip

    lines, levels = [], {}
    for given in study.grid.errors:
        cells = [cell for (of_set, _), cell in results.cells.items() if of_set == given]
        name = f"errors of {study.describe_errors(given)}"
        levels[f"before, {name}"] = cells[0].compute_median(BEFORE, POSITION)
        for method in METHODS:
            y = [cell.compute_median(method, POSITION) for cell in cells]
            lines.append(published.Series.of(f"{method}, {name}", [c.noise for c in cells], y))
    yield TEXT.figure("table_3", lines, levels, trials=results.trials)


def judge_claims(results: Results) -> tuple[published.Verdict, ...]:
    """Return a verdict for each claim."""
    groups = [_judge_equations, _judge_table_3, _judge_experiment, _judge_prior]
    study, cell = results.study, results.figure_5
    judge = partial(TEXT.judge, elsewhere=results.is_elsewhere, count=len(results.cells),
                    parameters=len(study.planned.free), trials=results.trials, noise=cell.noise,
                    errors=study.describe_errors(cell.size))  # fmt: skip
    return tuple(verdict for group in groups for verdict in group(results, judge))


Judge = Callable[..., published.Verdict]
"""`PaperText.judge` with the sizes that several claims show."""


def decide_all(decisions: Iterable[bool | None]) -> bool | None:
    """Return True if all are true, False if all are false, else None."""
    decisions = list(decisions)
    return decide(all(d is True for d in decisions), all(d is False for d in decisions))


def _judge_equations(results: Results, judge: Judge) -> Iterator[published.Verdict]:
    (points, rank), effect = results.pair, results.frame_effect
    yield judge("independent", decide(effect < 1e-9, effect > 1e-6), effect=effect)
    missing = points - rank
    yield judge("counted", decide(missing == 1, missing != 2), points=points, rank=rank,
                missing=missing)  # fmt: skip
    groups, last = zip(*((row["groups"], row["last"]) for row in results.ranks), strict=True)
    yield judge("least_squares", decide_all(decide(x > 1e-8, x < 1e-12) for x in last),
                ranks=sorted({row["rank"] for row in results.ranks}), fewest=min(groups),
                most=max(groups), largest=max(last), count=len(results.undetermined))  # fmt: skip


def _judge_table_3(results: Results, judge: Judge) -> Iterator[published.Verdict]:
    """Judge least squares on the machines of Table 3."""
    from scipy.stats import beta

    study, cells, cell = results.study, results.cells, results.figure_5
    p, left = len(study.planned.free), len(study.planned.free) - len(study.observable)
    stated, falls = PRINTED.number("figure_5", PARAMETERS, "stated"), results.reduce(PARAMETERS)
    best = chance = 1.0
    if left:  # distribution of the share of undetermined directions in the squared norm
        share = beta(left / 2, (p - left) / 2)
        best, chance = 1.0 - np.sqrt(share.median()), share.cdf((1.0 - stated / 100.0) ** 2)
    change = results.word_reduction(PARAMETERS)
    yield judge("three_quarters", decide_each(falls >= stated - 0.5, np.isfinite(falls)),
                stated=stated, left=left, best=100.0 * best, chance=100.0 * chance,
                change=change)  # fmt: skip

    aligned = [name_measure(what, ALIGNED) for what in study.parts]
    better = {
        key: decide_share(results.pool(lambda draw, k=key: draw.cells[k].are_reduced(LS, aligned)))
        for key in cells
    }
    worse = [f"errors {study.describe_errors(s)} with noise {n} mm"
             for (s, n), decision in better.items() if decision is False]  # fmt: skip
    ratio = np.median([c.compute_median(LS, POSITION) / c.noise for c in cells.values()])
    yield judge("better", decide(True in better.values(), set(better.values()) == {False}),
                better=sum(d is True for d in better.values()),
                worse=worse or ["none"], parts=study.parts, ratio=ratio)  # fmt: skip

    figure, absolute = PRINTED.find("figure_5"), {w: name_measure(w, ABSOLUTE) for w in study.parts}
    each = np.min([results.reduce(measure) - float(figure[what]["stated"])
                   for what, measure in absolute.items()], axis=0)  # fmt: skip
    before = {
        "before": {w: cell.compute_median(BEFORE, measure) for w, measure in absolute.items()},
        "printed": {what: float(figure[what]["before"]) for what in study.parts},
    }
    yield judge("figure_5", decide_each(each >= -0.5, np.isfinite(each)),
                stated=[f"{what} {figure[what]['stated']} %" for what in study.parts],
                reductions=[f"{w} {results.word_reduction(m)}" for w, m in absolute.items()],
                **{name: [f"{what} {x:.3g} {PARTS[what][2]}" for what, x in sizes.items()]
                   for name, sizes in before.items()})  # fmt: skip
    gains, (drawn, optimized) = [draw.gain for draw in results.draws], study.spreads
    yield judge("exchange", [gain >= 3.0 for gain in gains], gain=gains[0], least=min(gains),
                unit=study.unit[1], drawn=drawn, optimized=optimized)  # fmt: skip

    good = SIZES.find("good")
    ranks = {m: [rank_correlations(draw.cells.values(), m) for draw in results.draws]
             for m in METHODS}  # fmt: skip
    of_ls = np.concatenate(ranks[LS])
    yield judge("correlation", decide_each(of_ls > good, np.isfinite(of_ls)), good=good,
                ratios=len({c.ratio for c in cells.values()}),
                ranks={m: take_median(of[0]) for m, of in ranks.items()}, parameters=change,
                position=results.word_reduction(name_measure("position", ABSOLUTE)),
                aligned=results.word_reduction(POSITION))  # fmt: skip


def _judge_experiment(results: Results, judge: Judge) -> Iterator[published.Verdict]:
    """Judge iterations, time and full poses of the points of the experiment."""
    fifties, stated = results.draws[0].fifties, PRINTED.find("experiment")
    most, falling, within = int(stated["iterations"]), list[bool | None](), []
    for groups in fifties:
        is_within = results.pool(lambda d, g=groups: d.fifties[g].is_within(most).tolist())
        within.append((name_planes(groups), published.estimate_share(is_within),
                       decide_share(is_within)))  # fmt: skip
        for frame in FRAMES:
            measures = list_statistics(results.study, frame)
            falling.append(decide_share(results.pool(
                lambda d, g=groups, m=measures: d.fifties[g].are_reduced(LS, m))))  # fmt: skip
    places = {"ls": (ABSOLUTE, LS), "nominal": (AT_NOMINAL, LS), "aligned": (ALIGNED, LS),
              "prior": (ALIGNED, PRIOR), "absolute_prior": (ABSOLUTE, PRIOR)}  # fmt: skip
    changes = {
        name: [
            "{:.2g} to {:.2g} mm on {}".format(
                *(cell.compute_median(m, name_measure("position", frame, ", mean"))
                  for m in (BEFORE, method)), name_planes(groups))
            for groups, cell in fifties.items()
        ]
        for name, (frame, method) in places.items()
    }  # fmt: skip
    yield judge("iterations", decide_all(decision for _, _, decision in within),
                points=PRINTED.find("points", "measured"), stated=most, aligned=changes["aligned"],
                shares=[f"{100 * s.value:.0f} % (95 % interval {100 * s.low:.0f} to "
                        f"{100 * s.high:.0f} %) on {name}" for name, s, _ in within])  # fmt: skip
    seconds = [s for draw in results.draws for s in draw.seconds]
    limit, longest = float(stated["seconds"]), max(seconds)
    yield judge("seconds", [s <= limit for s in seconds], stated=limit, longest=longest,
                ratio=limit / longest)  # fmt: skip
    yield judge("full_poses", decide_all(falling), falling=falling.count(True),
                rising=falling.count(False), ways=len(falling), **changes)  # fmt: skip


def _judge_prior(results: Results, judge: Judge) -> Iterator[published.Verdict]:
    """Judge the prior on the machines of Table 3."""
    study, cells = results.study, results.cells

    def judge_prior(cell: Cell) -> list[bool | None]:
        before, ls, prior = (cell.errors[m][POSITION] for m in (BEFORE, LS, PRIOR))
        is_good = (prior <= (1.0 + sure) * ls) & (prior <= before)
        return decide_each(is_good, cell.converged[LS] & cell.converged[PRIOR])

    sure, hardest = SIZES.find("sure"), max(cells, key=lambda k: cells[k].ratio)
    priors = [decide_share(results.pool(lambda draw, k=k: judge_prior(draw.cells[k])))
              for k in cells]  # fmt: skip
    lost = published.estimate_share(results.pool(
        lambda draw: [x > 1.0 for x in draw.cells[hardest].compute_left(PRIOR, POSITION)]
    ))  # fmt: skip
    yield judge("prior", decide(all(d is True for d in priors), False in priors), sure=100 * sure,
                better=priors.count(True), worse=priors.count(False), share=100.0 * lost.value,
                errors=study.describe_errors(hardest[0]), noise=hardest[1],
                left={m: cells[hardest].compute_median(m, POSITION)
                      for m in (BEFORE, LS, PRIOR)})  # fmt: skip
