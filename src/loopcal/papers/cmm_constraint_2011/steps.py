# SPDX-License-Identifier: Apache-2.0
"""What the paper does: points on planes and perpendicular lines, drawn machines, calibrations by LS
and MAP, and errors at held-out poses; and the questions that it leaves open.

Robot and workspace are ours, those of the robot file hexapod-nategh-agheli: the paper's Tables 1
and 2 are not in our text.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import hypot

import numpy as np

import loopcal as lc
from loopcal import geometry
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.information import collect_information
from loopcal.estimate.penalties import Method
from loopcal.measure.instrument import Gaussian, make_random_stream
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION
from loopcal.mechanism.solutions import Solution
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.papers.paper import PAPERS
from loopcal.papers.published import PaperFile, Row, last_digit
from loopcal.planning.exchange import MovedDesign
from loopcal.planning.plane_line_planning import (
    PlaneLineGroups,
    improve_groups,
    make_plane_line_instrument,
)
from loopcal.studies.simulation.block import calibrate_cells, find_cells, set_size
from loopcal.studies.simulation.published_steps import (
    WEIGHTS,
    Layout,
    PaperRows,
    Weights,
    identify_from_rows,
)
from loopcal.studies.specification.study import Study as GridStudy
from loopcal.typing import BoolArray, FloatArray, IntArray

MM = 1e-3
PRINTED, SIZES = PaperFile(__file__, "published.yaml"), PaperFile(__file__, "sizes.yaml")
ROBOT = "hexapod-nategh-agheli"
TRUTH = 1  # purpose of a random stream
BEFORE, LS, PRIOR = "before", "LS", "MAP"
METHODS: Mapping[str, Method] = {LS: lc.LeastSquares(), PRIOR: lc.MAP()}
ABSOLUTE, AT_NOMINAL, ALIGNED = FRAMES = ("absolute", "gauge at nominal", "aligned")
"""Placements of the base and the rotation of the platform, which plane and line do not determine:
as the least deviation leaves them; with poses nearest to the nominal ones, which needs no truth;
with poses nearest to the true ones.
"""
STATISTICS = ("position, mean [mm]", "position, standard deviation [mm]", "orientation, mean [deg]",
              "orientation, standard deviation [deg]")  # fmt: skip
POSITION_ALIGNED = "position, aligned [mm]"
NO_GAUGE = "parameters without gauge [mm]"
MEASURES = (
    "position [mm]",
    "orientation [deg]",
    POSITION_ALIGNED,
    "orientation, aligned [deg]",
    "parameters [mm]",
    NO_GAUGE,
    "position, gauge at nominal [mm]",
    *(f"{name}, {frame}" for frame in FRAMES for name in STATISTICS),
)
"""Root mean squares over the held-out poses, the 2-norm of the errors of the 42 parameters, and
means and standard deviations over the poses.
"""
SD, VARIANCE = "standard deviation", "variance"
"""Interpretations of a printed "variance of 0.01mm"."""
TEN, ONE, ANY = (
    "ten planes, a line each",
    "one plane, one line",
    "ten planes of any axis, a line each",
)
GAUGE_NAMES = tuple(
    f"{what} {axis}"
    for what in ("base shifted along", "base rotated about", "platform rotated about")
    for axis in POSITION
)
"""The nine directions of the 42 parameters that plane and line cannot determine, k = x, y, z:

    base shifted along k      db_i = k             the end point moves along k everywhere
    base rotated about k      db_i = k x b_i       it rotates about the base's origin everywhere
    platform rotated about k  dp_i = k x p_i       it does not move at all

The first six move all points as one body, which changes no distance and no angle between them.
"""


@dataclass(frozen=True, eq=False)
class Study:
    """The robot, the points it is sent to, and the poses at which it is judged."""

    robot: Mechanism
    planned: PlaneLineGroups  # how groups are written as designs
    first: FloatArray  # design before coordinate exchange
    optimized: MovedDesign  # design after it
    seed: int  # of both

    @cached_property
    def layout(self) -> Layout:
        """The measured points."""
        return Layout(self.robot, self.planned.place_points(self.optimized.design))

    @cached_property
    def held_out(self) -> Solution:
        """Random poses with another seed than the points, as the robot is commanded to them."""
        count = load_study().scores.held_out
        return sample_workspace(self.robot, count, self.seed + 1).solution

    @cached_property
    def spreads(self) -> tuple[float, float]:
        """Rms standard deviation of the identifiable directions [mm per mm of noise] before and
        after coordinate exchange.
        """
        both = []
        for rows in (self.planned.linearize(self.first), self.optimized.rows):  # noise of 1 mm
            s = np.linalg.svd(rows.reshape(-1, rows.shape[-1]), compute_uv=False)
            both.append(float(np.sqrt(np.mean(1.0 / s[s > 1e-10 * s[0]] ** 2))))
        return both[0], both[1]

    def solve(self, values: FloatArray) -> FloatArray:
        """Return the held-out poses (t, n, 4, 4) of machines (t, p) at the nominal readings."""
        return forward_trials(self.robot, values, self.held_out.q[None], self.held_out.state).T

    def compute_twists(self, T: FloatArray, true: FloatArray, frame: str) -> FloatArray:
        """Return differences (t, n, 6) [rad, m], rotation first, of poses (t | 1, n, 4, 4) from
        true ones (t, n, 4, 4), in one of FRAMES.
        """
        T = np.broadcast_to(T, true.shape)
        if frame != ABSOLUTE:
            nominal = np.broadcast_to(self.held_out.T, true.shape)
            T = fit_motions(T, true if frame == ALIGNED else nominal)
        return geometry.pose_difference(T, true)

    def compute_errors(self, values: FloatArray, truth: FloatArray, true: FloatArray) -> FloatArray:
        """Return errors (t, m), see MEASURES; values (t | 1, p) and truth (t, p) [m], true (t, n,
        4, 4) the poses of the truth.
        """
        sizes, statistics, T = {}, [], self.solve(values)
        for frame in FRAMES:
            twists = self.compute_twists(T, true, frame)
            squares = np.mean(twists**2, axis=1)
            position, rotation = (np.sqrt(squares[:, p].sum(axis=1)) for p in np.s_[3:, :3])
            sizes[frame] = [position / MM, np.rad2deg(rotation)]
            position, rotation = (np.linalg.norm(twists[..., p], axis=2) for p in np.s_[3:, :3])
            of_poses = (position / MM, np.rad2deg(rotation))
            statistics += [part(e, axis=1) for e in of_poses for part in (np.mean, np.std)]
        wrong = values - truth
        lengths = (np.linalg.norm(e, axis=1) / MM for e in (wrong, remove_gauge(self.robot, wrong)))
        columns = (*sizes[ABSOLUTE], *sizes[ALIGNED], *lengths, sizes[AT_NOMINAL][0])
        return np.stack([*columns, *statistics], axis=1)


def load_study() -> GridStudy:
    """Return study.yaml."""
    return PAPERS["cmm-constraint-2011"].load_study()


def plan_points(
    groups: int = 0, points: int = 0, axes: tuple[str, ...] = ("z",), *, seed: int,
    sweeps: int | None = None,
) -> Study:  # fmt: skip
    """Draw groups at random and improve log det of their information by coordinate exchange.

    groups, points, sweeps : planes with a line each, points of each, and sweeps of the exchange (0:
    as drawn); by default those of study.yaml. axes : of the lines; z means planes of equal z.
    """
    (level,) = load_study().poses.values()
    groups = groups or level.groups
    robot = lc.load_robot(ROBOT)
    planned = PlaneLineGroups(robot, points or level.count // groups, MM, axes)
    first = planned.draw(groups, seed)
    improved = improve_groups(planned, first, level.sweeps if sweeps is None else sweeps)
    return Study(robot, planned, first, improved, seed)


def draw_true_machines(
    robot: Mechanism, sd: float, trials: int, seed: int, is_gauge_free: bool = False
) -> FloatArray:
    """Return nominal values (t, p) [m] with Gaussian errors.

    Machine i has the same errors, scaled, for any sd and number of trials.
    """
    streams = (make_random_stream(seed, trial, TRUTH) for trial in range(trials))
    drawn = np.stack([stream.standard_normal(len(robot.parameters)) for stream in streams])
    return robot.parameters.nominal + sd * (remove_gauge(robot, drawn) if is_gauge_free else drawn)


def fit_motions(T: FloatArray, others: FloatArray) -> FloatArray:
    """Return poses (t, n, 4, 4) after the motion of the base and the turn of the platform that
    bring them nearest to others.

    Positions fix the base's motion (their least squares), then orientations the platform's turn
    (nearest rotations): what plane and line leave open, and nothing else.
    """
    x, y = T[..., :3, 3], others[..., :3, 3]
    middle, center = x.mean(axis=1, keepdims=True), y.mean(axis=1, keepdims=True)
    Q = geometry.project_to_rotations(np.swapaxes(y - center, 1, 2) @ (x - middle))
    R = Q[:, None] @ T[..., :3, :3]
    turn = geometry.project_to_rotations(np.sum(np.swapaxes(R, 2, 3) @ others[..., :3, :3], axis=1))
    return geometry.make_pose(R @ turn[:, None], (x - middle) @ np.swapaxes(Q, 1, 2) + center)


def list_gauge_directions(robot: Mechanism) -> FloatArray:
    """Return changes (9, p) of the parameters, see GAUGE_NAMES, [m per m] and [m per rad]."""
    changes = np.zeros((9, len(robot.parameters)))
    for leg in robot.assembly.limbs:
        base, platform = (
            [robot.parameters.index(f"{leg.name}.{end}.{axis}") for axis in POSITION]
            for end in ("base", "platform")
        )
        changes[0:3, base] = np.eye(3)
        changes[3:6, base] = np.cross(np.eye(3), robot.values[base])
        changes[6:9, platform] = np.cross(np.eye(3), robot.values[platform])
    return changes


def remove_gauge(robot: Mechanism, deviation: FloatArray) -> FloatArray:
    """Return deviations (.., p) [m] without their part along the nine directions."""
    basis = np.linalg.qr(list_gauge_directions(robot).T)[0]
    return deviation - (deviation @ basis) @ basis.T


def compute_ranks(study: Study, seed: int) -> list[Row]:
    """Return the ranks of random groups, with the tolerance 1e-10 of the largest singular value."""
    ranks = []
    for groups, points in SIZES.find("ranks"):
        planned = PlaneLineGroups(study.robot, points, MM, ("z",))
        rows = planned.linearize(planned.draw(groups, seed)).reshape(-1, len(planned.free))
        s = np.linalg.svd(rows, compute_uv=False)
        rank = int((s > 1e-10 * s[0]).sum())
        unused = float(s[rank]) if rank < len(s) else None
        ranks.append(
            {"groups": groups, "points": points, "rows": len(rows), "rank": rank,
             "smallest": float(s[rank - 1]), "unused": unused, "largest": float(s[0])}
        )  # fmt: skip
    return ranks


def compute_gauge_effects(study: Study) -> FloatArray:
    """Return the effects (9,) of the directions of GAUGE_NAMES on the rows, relative to the largest
    singular value.
    """
    rows = study.optimized.rows.reshape(-1, len(study.robot.parameters))
    g, largest = list_gauge_directions(study.robot), np.linalg.svd(rows, compute_uv=False)[0]
    return np.linalg.norm(rows @ g.T, axis=0) / np.linalg.norm(g, axis=1) / largest


def compute_pair_rank(study: Study) -> tuple[int, int]:
    """Return the points of the first group and the rank of the equations (14) of all its pairs.

    The points are those commanded.
    """
    nominal, layout = study.robot.parameters.nominal[None], study.layout
    points, slopes, _ = layout.linearize_points(nominal, layout.solve_readings(nominal, 0.0, 0))
    group, J = points[0, 0], slopes[0, 0]
    plane = [0, *range(2, len(group))]
    d_1, slope_1 = group[1] - group[0], J[1] - J[0]
    rows = np.array([
        (group[i] - group[j]) @ slope_1 + d_1 @ (J[i] - J[j])
        for i in plane for j in plane if i < j
    ])  # fmt: skip
    return len(group), int(np.linalg.matrix_rank(rows, rtol=1e-9))


@dataclass(frozen=True, eq=False)
class Cell:
    """t machines with errors of one size, calibrated from points with noise of one size."""

    sd: float  # of the parameters [m]
    noise: float  # standard deviation of a held coordinate [m]
    errors: Mapping[str, FloatArray]  # by BEFORE, LS, MAP, (t, m) see MEASURES
    iterations: IntArray  # (t,) of LS
    converged: Mapping[str, BoolArray]  # by LS, MAP, (t,)
    truth: FloatArray  # (t, p) true values [m]
    values: Mapping[str, FloatArray]  # by LS, MAP, (t, p) identified values [m]

    @property
    def failed(self) -> int:
        """Number of descents that did not converge."""
        return sum(int((~converged).sum()) for converged in self.converged.values())

    @property
    def ratio(self) -> float:
        """Noise over errors. To first order the reductions of cells depend on it only."""
        return float(f"{self.noise / self.sd:.6g}")

    @property
    def within_five(self) -> float:
        """Percentage of the machines on which least squares converges within 5 iterations."""
        return 100.0 * float(np.mean((self.iterations <= 5) & self.converged[LS]))

    def compute_median(self, method: str, measure: str) -> float:
        """Return the median over the machines on which the method converged; NaN without any."""
        errors = self.errors[method][:, MEASURES.index(measure)]
        errors = errors[self.converged.get(method, np.s_[:])]
        return float(np.median(errors)) if len(errors) else np.nan

    def compute_reduction(self, method: str, measure: str) -> float:
        """Return the percentage by which a median falls."""
        after, before = (self.compute_median(m, measure) for m in (method, BEFORE))
        return 100.0 * (1.0 - after / before)

    def count_worse(self, method: str, measure: str) -> int:
        """Return how many machines a method makes worse, of those on which it converged."""
        place = MEASURES.index(measure)
        is_worse = self.errors[method][:, place] > self.errors[BEFORE][:, place]
        return int((is_worse & self.converged[method]).sum())


def calibrate_cell(
    study: Study, sd: float, noise: float, seed: int, trials: int, gauge_free: bool = False,
    weights: Weights = "full", layout: Layout | None = None,
) -> Cell:  # fmt: skip
    """Draw machines, hold their coordinates with noise, identify, compare at held-out poses.

    sd, noise : standard deviations [m], of a parameter and of a coordinate of a point. The prior of
    MAP has this sd. layout : measured points, by default those of the study.
    """
    layout = layout or study.layout
    truth = draw_true_machines(study.robot, sd, trials, seed, gauge_free)
    rows = PaperRows(layout, layout.solve_readings(truth, noise, seed), sd, noise, weights)
    descents = {name: identify_from_rows(rows, method) for name, method in METHODS.items()}
    values = {name: rows.values(descent.deviation) for name, descent in descents.items()}
    converged = {name: d.status == DescentStatus.CONVERGED for name, d in descents.items()}
    return judge_cell(study, sd, noise, truth, values, descents[LS].iterations, converged)


def judge_cell(
    study: Study, sd: float, noise: float, truth: FloatArray, values: Mapping[str, FloatArray],
    iterations: IntArray, converged: Mapping[str, BoolArray],
) -> Cell:  # fmt: skip
    """Return identified machines with their errors at the held-out poses."""
    true, nominal = study.solve(truth), study.robot.parameters.nominal[None]
    errors = {
        name: study.compute_errors(v, truth, true)
        for name, v in {BEFORE: nominal, **values}.items()
    }
    return Cell(sd, noise, errors, iterations, converged, truth, values)


def calibrate_grid(
    study: Study, seed: int, trials: int, progress: Callable[[str], None]
) -> dict[tuple[str, str], Cell]:
    """Return the 3 x 4 cells by (set, noise) as printed, taken as standard deviations: those of
    study.yaml at the points of this study.
    """
    grid = set_size(load_study(), seed, trials)
    (level,) = grid.poses.values()
    points = replace(level, coordinates=tuple(map(tuple, study.layout.flat.tolist())))
    grid = replace(grid, poses={"points": points})
    cells = {}
    for given in PRINTED.find("sets").split():
        progress(f"Table 3, set {given} mm")
        for noise in PRINTED.find("noises").split():
            numbers = find_cells(grid, errors=f"set {given}", instrument=f"{noise} mm")
            made = {cell.levels["method"]: cell for cell in calibrate_cells(grid, numbers)}
            cells[given, noise] = judge_cell(
                study, float(given) * MM, float(noise) * MM, made[LS].truth,
                {name: cell.values for name, cell in made.items()}, made[LS].iterations,
                {name: cell.is_converged for name, cell in made.items()},
            )  # fmt: skip
    return cells


def compute_rank_correlation(cells: Iterable[Cell], method: str) -> float:
    """Return the rank correlation over cells of the reductions of parameters and positions."""
    cells = tuple(cells)
    first, second = (
        np.argsort(np.argsort([c.compute_reduction(method, name) for c in cells])).astype(float)
        for name in ("parameters [mm]", "position [mm]")
    )
    return float(np.corrcoef(first, second)[0, 1])


def calibrate_fifty(study: Study, groups: int, seed: int, trials: int) -> Cell:
    """Calibrate machines from fifty random points with the noise of the paper's instrument."""
    points = int(PRINTED.find("points", "measured")) // groups
    layout = plan_points(groups, points, seed=seed + 2, sweeps=0).layout
    sizes = SIZES.find("fifty", "errors") * MM, PRINTED.number("accuracy", "accuracy") * MM
    return calibrate_cell(study, *sizes, seed, trials, layout=layout)


def calibrate_figure_5(
    study: Study, seed: int, trials: int, gauge_free: bool = False, weights: Weights = "full",
    reading: str = SD,
) -> Cell:  # fmt: skip
    """Calibrate machines with the errors and the noise of figure 5, read as SD or VARIANCE."""
    given = [SIZES.find("figure_5", name) for name in ("errors", "noise")]
    sd, noise = (size * MM if reading == SD else float(np.sqrt(size)) * MM for size in given)
    return calibrate_cell(study, sd, noise, seed, trials, gauge_free, weights)


def describe_points(name: str, study: Study, cell: Cell) -> Row:
    """Return the accuracy of one way to place 100 points; cell : of figure 5."""
    drawn, optimized = study.spreads
    medians = {m: cell.compute_median(m, POSITION_ALIGNED) for m in METHODS}
    row = {"name": name, "rows": study.layout.equations, "drawn": drawn, "optimized": optimized}
    return row | {"gain": drawn / optimized} | medians


@dataclass(frozen=True, eq=False)
class Draw:
    """One draw of points, machines and noise."""

    cells: Mapping[tuple[str, str], Cell]  # Table 3, by (set, noise) as printed
    weights: Mapping[str, Cell]  # the cell of figure 5 by weights of the rows
    fifties: Mapping[int, Cell]  # from fifty points, by their planes
    points: Row  # see `describe_points`


def compute_draw(study: Study, seed: int, trials: int, progress: Callable[[str], None]) -> Draw:
    """Calibrate the machines of one seed from the points of a study."""
    cells = calibrate_grid(study, seed, trials, progress)
    progress("weights of the rows, and fifty points")
    fifties = {
        groups: calibrate_fifty(study, groups, seed, trials)
        for groups in SIZES.find("fifty", "planes")
    }
    weights = {w: calibrate_figure_5(study, seed, trials, weights=w) for w in WEIGHTS}
    return Draw(cells, weights, fifties, describe_points(TEN, study, weights["full"]))


def list_printed() -> FloatArray:
    """Return the printed reductions (3,) of parameters, position and orientation [%]."""
    position, orientation = (Stated(**PRINTED.find("figure_5", name)).reduction
                             for name in ("position", "orientation"))  # fmt: skip
    return np.array([PRINTED.number("figure_5", "estimation", "stated"), position, orientation])


def rank_candidates(studies: Mapping[str, Study], seed: int, trials: int) -> list[Row]:
    """Return the reductions of figure 5 [%] by least squares under every interpretation of the
    paper, the nearest to its printed ones first; distance : largest difference from them.
    """
    frames = {
        "absolute": ("parameters [mm]", "position [mm]", "orientation [deg]"),
        "aligned": (NO_GAUGE, POSITION_ALIGNED,
                    "orientation, aligned [deg]"),
    }  # fmt: skip
    rows, printed = [], list_printed()
    for name, study in studies.items():
        for reading in (SD, VARIANCE):
            for truth in ("all 42", "gauge-free"):
                is_free = truth == "gauge-free"
                cell = calibrate_figure_5(study, seed, trials, is_free, reading=reading)
                for frame, measures in frames.items():
                    of = [cell.compute_reduction(LS, measure) for measure in measures]
                    row: Row = {"name": name, "reading": reading, "truth": truth, "frame": frame}
                    row |= zip(("parameters", "position", "orientation"), of, strict=True)
                    rows.append(row | {"distance": float(np.abs(of - printed).max())})
    return sorted(rows, key=lambda row: row["distance"])


@dataclass(frozen=True)
class Stated:
    """A number before and after, and its stated improvement."""

    stated: str  # percentage or factor, as printed
    before: str = ""  # as printed
    after: str = ""
    unit: str = ""  # of before and after

    @property
    def reduction(self) -> float:
        """Percentage by which it falls."""
        return 100.0 * (1.0 - float(self.after) / float(self.before))

    @property
    def factor(self) -> float:
        """Before over after."""
        return float(self.before) / float(self.after)

    @property
    def possible(self) -> tuple[float, float]:
        """Least and largest factor of numbers that round to the printed ones."""
        return bound_factor((self.before,), (self.after,))

    @property
    def excess(self) -> float:
        """By how much the stated factor is outside of the possible ones."""
        return compute_excess(self.stated, self.possible)


def bound_factor(before: Sequence[str], after: Sequence[str]) -> tuple[float, float]:
    """Return the least and the largest quotient of roots of sums of squares of rounded numbers."""
    (least, most), (last, first) = (
        [
            hypot(*(float(text) + sign * 0.5 * last_digit(text) for text in rounded))
            for sign in (-1, 1)
        ]
        for rounded in (before, after)
    )
    return least / first, most / last


def compute_excess(stated: str, possible: tuple[float, float]) -> float:
    """Return by how much a stated number, itself rounded, is outside of what is possible."""
    half, (low, high) = 0.5 * last_digit(stated), possible
    return max(low - half - float(stated), float(stated) - high - half, 0.0)


def build_measurements(layout: Layout, q: FloatArray, sigma: float) -> Measurements:
    """Return points on planes and lines with readings (n, a) [SI] as measurements; sigma : of a
    held coordinate [m].

    Kinds `plane` and `line` that name the same surface share the unknowns of that name (direction,
    height, shifts), so that the line is perpendicular to the plane by construction. Measured gaps
    are zero: the coordinates were held.
    """
    number = np.arange(layout.points).reshape(layout.groups, -1)
    axis = np.abs(layout.levers[0]).argmax(axis=1)
    instrument = make_plane_line_instrument(
        layout.robot, axis, number, lambda _, gaps: Gaussian(np.full(gaps, sigma))
    )
    observations = tuple(
        Observations.from_sigma(
            s.kind, s.assigned_rows, np.zeros((len(s.assigned_rows), len(s.noise.sigma))), sigma,
            group=s.group,
        )
        for s in instrument.sensors
    )  # fmt: skip
    return Measurements(layout.robot.name, q, observations)


def compare_forms(study: Study, seed: int, trials: int) -> list[Row]:
    """Identify machines in both forms, at several noises and by both methods, the hardest first:
    all machines, and a part of them with the others.
    """
    forms = SIZES.find("forms")
    truth = draw_true_machines(study.robot, forms["errors"] * MM, trials, seed)
    hardest, rows = (max(forms["noises"]), LS), []
    for noise in forms["noises"]:
        q = study.layout.solve_readings(truth, noise * MM, seed)
        for name in METHODS:
            is_hardest = (noise, name) == hardest
            count = trials if is_hardest else max(trials // forms["share"], 2)
            row = compare_estimates(study.layout, q[:count], noise * MM, name)
            rows.insert(0 if is_hardest else len(rows), row)
    return rows


def compare_estimates(layout: Layout, q: FloatArray, noise: float, name: str) -> Row:
    """Identify machines with readings (t, n, a) in both forms by one method.

    Return the noise [mm], on how many machines both forms converged, iterations and ranks with
    surfaces as unknowns, and over the converged machines the largest difference of the estimates
    along an identifiable direction [sd].
    """
    sd = select_free_parameters(layout.robot).tolerance[0]
    problem = PaperRows(layout, q, sd, noise)
    paper = identify_from_rows(problem, METHODS[name], 1e-6)
    values = problem.values(paper.deviation)
    iterations, ranks, unlike = 0, set(), []
    for i, readings in enumerate(q):
        fit = lc.identify(layout.robot, build_measurements(layout, readings, noise), METHODS[name])
        iterations, ranks = max(iterations, fit.history.iterations), ranks | {fit.rank}
        if fit.history.status == paper.status[i] == DescentStatus.CONVERGED:
            s, vt = _decompose_rows(problem.take(np.array([i])))
            change = s * (vt @ (fit.robot.values - values[i])) / sd  # in standard deviations
            unlike.append(float(np.abs(change).max()))
    return {
        "noise": noise / MM, "method": name, "machines": len(q), "converged": len(unlike),
        "iterations": iterations, "ranks": sorted(ranks), "largest": max(unlike, default=np.nan),
        "median": float(np.median(unlike)) if unlike else np.nan,
    }  # fmt: skip


def compare_covariances(layout: Layout, noise: float) -> float:
    """Return the largest relative difference of the variances that both forms give any direction,
    on surfaces reached exactly.
    """
    q = layout.solve_readings(layout.robot.parameters.nominal[None], 0.0, 0)
    free = select_free_parameters(layout.robot)
    factor = collect_information(free, build_measurements(layout, q[0], noise))[0]
    s, vt = _decompose_rows(PaperRows(layout, q, free.tolerance[0], noise))
    ratio = np.linalg.svd(factor[0, : len(free), : len(free)] @ (vt.T / s), compute_uv=False)
    return float(np.abs(ratio**2 - 1.0).max())


def _decompose_rows(problem: PaperRows) -> tuple[FloatArray, FloatArray]:
    """Return singular values and directions of the paper's rows that count, of the first machine as
    designed.
    """
    A = problem.whiten(np.zeros((1, problem.parameters)))[0][0, :, :-1]
    _, s, vt = np.linalg.svd(A, full_matrices=False)
    kept = s > 1e-10 * s[0]
    return s[kept], vt[kept]
