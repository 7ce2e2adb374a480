# SPDX-License-Identifier: Apache-2.0
"""The ten steps of the paper's section 5 (docs/papers.md), repeated with other noises,
methods and poses, beside the printed tables, and the judged claims.

Least squares is `identify_per_leg`, one step at a time, every equation of weight one and every
parameter of scale one. Poses are (x, y, z, alpha, beta, gamma) [m, rad] in the paper's order.
Derivation: docs/theory/families.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

import loopcal as lc
from loopcal import geometry
from loopcal.errors import DataError, EstimationError
from loopcal.measure.instrument import make_random_stream
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import Solution, forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.papers import published
from loopcal.papers.paper import PAPERS, StudyCase
from loopcal.papers.published import PaperFile, Row, decide
from loopcal.studies import specification
from loopcal.studies.simulation.block import CalibratedCell, calibrate_cells, find_cells, set_size
from loopcal.studies.simulation.published_steps import (
    MM,
    LegForm,
    identify_per_leg,
    integrate_errors,
    list_raw_units,
)
from loopcal.studies.specification import (
    ErrorsLevel,
    InstrumentLevel,
    MethodLevel,
    PosesLevel,
    Study,
)
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import SI_SYMBOLS, Dimension

TO_PRINTED = np.array([1.0 / MM] * 3 + [1.0] * 3)  # from [m, rad] to the units of Tables 4 and 6
# Our names for the columns of Tables 2, 3 and 5.
PARAMETERS = ("base.x", "base.y", "base.z", "length", "platform.x", "platform.y", "platform.z")
ODD_POSE = "A2"  # the row of Table 4 that belongs to another machine
ORDER = "xyz"  # R = Rz(gamma) Ry(beta) Rx(alpha), with which Table 4 was made; equation (2) differs
ANGLES = geometry.parse_orientation(f"euler-{ORDER}")

STATED, PRESUMED = "stated", "presumed"
"""Noises of sizes.yaml: that of the paper, and that with which its Tables 5 and 6 agree, as the
sweep shows. The paper states none for angles: the same number in the unit that its Table 6 prints,
0.001 mrad.
"""
PER_LEG, TOGETHER, PRIOR = "per leg", "least squares", "MAP"
"""Methods of study.yaml."""
MEASURED = "the measured ones"
NEAR, WIDE, WORKSPACE = "as in the paper", "wide", "in the workspace"
"""Where poses lie."""
DRAWN_POSES = 3  # purpose of a random stream
MOST_DRAWN = 4  # poses that are drawn for each that the machine with errors must reach
MOST_FIRST = 3  # numbers of poses that are tried, from the fewest

PRINTED, SIZES = PaperFile(__file__, "published.yaml"), PaperFile(__file__, "sizes.yaml")


@dataclass(frozen=True, eq=False)
class Setup:
    """Step 1.

    study : the simulation with these poses and errors, and the noises of `list_noises`.
    coordinates : (n, c) of the poses, by which the robot is controlled [m, rad]. epsilon : max
    dQint [mm + rad] at which the steps end. is_printed : whether robot, errors and poses are those
    of the paper's tables.
    """

    study: Study
    robot: Mechanism  # the machine as designed
    truth: Mechanism  # with its errors
    coordinates: FloatArray
    epsilon: float
    is_printed: bool

    @cached_property
    def commanded(self) -> Solution:
        """Nominal poses with the leg readings of the nominal machine."""
        return inverse(self.robot, self.coordinates)

    @cached_property
    def poses(self) -> FloatArray:
        """(n, 6) nominal poses of the tool [m, rad]."""
        return to_coordinates(self.commanded.T @ self.robot.tool)

    @cached_property
    def actual(self) -> FloatArray:
        """(n, 6) true poses at the readings of the nominal machine: step 2."""
        return self.compute_reached(self.truth)

    @cached_property
    def is_length(self) -> BoolArray:
        """(p,) which parameters are free lengths: rms errors are over these."""
        table = self.robot.parameters
        return table.free & np.array([d is Dimension.LENGTH for d in table.dimensions])

    @property
    def fewest(self) -> int:
        """Poses with as many equations, six each, as there are parameters."""
        if self.is_printed:
            return int(PRINTED.find("poses", "least"))
        return -(-int(self.robot.parameters.free.sum()) // 6)

    def compute_reached(self, machine: Mechanism) -> FloatArray:
        """Return the poses (n, 6) [m, rad] of a machine at the readings of the nominal one."""
        solution = forward(machine, self.commanded.q, self.commanded)
        return to_coordinates(solution.T @ self.robot.tool)

    def to_twists(self, errors: FloatArray, poses: FloatArray) -> FloatArray:
        """Return twists (n, 6) of the platform, rotation first, of coordinate errors (n, 6) [m,
        rad] near poses (n, 6) of the tool.
        """
        omega = (ANGLES.rates(poses[:, 3:]) @ errors[:, 3:, None])[..., 0]
        arm = ANGLES.to_matrix(poses[:, 3:]) @ geometry.invert_pose(self.robot.tool)[:3, 3]
        return np.concatenate([omega, errors[:, :3] + np.cross(omega, arm)], axis=1)

    def compute_error(self, values: FloatArray) -> FloatArray:
        """Return the rms errors (..) [mm] of the lengths among parameters (.., p) [SI]."""
        change = (values - self.truth.values)[..., self.is_length] / MM
        return np.asarray(np.sqrt(np.mean(change**2, axis=-1)))

    def calibrate(
        self, seed: int, trials: int, noise: str, method: str, poses: FloatArray | None = None
    ) -> CalibratedCell:
        """Return the calibrations with so many draws of noise; poses : (n, c), in place of its."""
        study = set_size(self.study, seed, trials)
        if poses is not None:
            study = replace(study, poses={MEASURED: make_poses_level(poses)})
        (cell,) = calibrate_cells(study, find_cells(study, instrument=noise, method=method))
        return cell


def make_setup(case: StudyCase | None = None, seed: int = 0) -> Setup:
    """Return the hexapod of Tables 2 and 3 at the nominal poses of Table 4, or another robot with
    drawn errors at drawn poses.

    The printed radians are whole degrees to their last digit.

    Raises DataError: another robot reaches too few poses.
    """
    case = case or StudyCase(PAPERS["hexapod-42"])
    robot, study = case.robot, case.load_study()
    epsilon = case.epsilon or PRINTED.number("threshold", "value")
    if robot is None:
        robot = lc.load_robot("hexapod-42")
        coordinates = PRINTED.table("table_4", "PT").values / TO_PRINTED
        coordinates[:, 3:] = np.deg2rad(np.round(np.rad2deg(coordinates[:, 3:])))
        truth = robot.parameters.nominal.copy()
        truth[find_places(robot)] += PRINTED.table("table_3").values * MM
    else:
        robot, truth = robot.nominal, sample_truth(robot, 1, seed)[0]
        (level,) = study.poses.values()
        coordinates = draw_reached(robot, robot.with_values(truth), level.count, seed)
    table = robot.parameters
    deviations = {
        name: f"{error!r} {SI_SYMBOLS[dimension]}"
        for name, dimension, error in zip(
            table.names, table.dimensions, (truth - table.nominal).tolist(), strict=True
        )
        if error
    }
    rule = MethodLevel(specification.PER_LEG, epsilon=epsilon, steps=SIZES.find("iterations"))
    study = replace(
        study,
        instruments={name: make_instrument(*limits) for name, limits in list_noises().items()},
        poses={MEASURED: make_poses_level(coordinates)},
        errors={"one machine": ErrorsLevel(deviations=deviations)},
        methods={**study.methods, PER_LEG: rule},
    )
    truth = robot.with_values(truth)
    return Setup(study, robot, truth, coordinates, epsilon, case.robot is None)


def make_poses_level(coordinates: FloatArray) -> PosesLevel:
    """Return the level of a study with these poses (n, c) [m, rad]."""
    return PosesLevel(len(coordinates), coordinates=tuple(map(tuple, coordinates.tolist())))


def make_instrument(length: float, angle: float) -> InstrumentLevel:
    """Return an instrument with uniform noise within limits [mm] of lengths and [rad] of angles."""
    position, orientation = (float(x / np.sqrt(3.0)) for x in (length * MM, angle))
    kind = (("pose",), (), f"euler-{ORDER}")
    return InstrumentLevel(*kind, position, orientation, distribution="uniform")


def list_noises() -> dict[str, tuple[float, float]]:
    """Return the limits [mm, rad] of the noises of sizes.yaml, multiples of the printed one."""
    printed = PRINTED.number("noise", "value")
    return {
        name: (float(f"{share * printed:.6g}"), float(f"{share * printed * angle:.6g}"))
        for name, (share, angle) in SIZES.find("noises").items()
    }


def draw_reached(
    robot: Mechanism, truth: Mechanism, n: int, seed: int | np.random.Generator
) -> FloatArray:
    """Return poses (n, c) [m, rad] drawn from the workspace of a robot that the machine with errors
    reaches, too. DataError: it reaches too few.
    """
    drawn = sample_workspace(robot, MOST_DRAWN * n, seed)
    reached = forward(truth, drawn.solution.q, drawn.solution).converged
    if reached.sum() < n:
        raise DataError(
            f"{robot.name} with errors by its spreads reaches {int(reached.sum())} of "
            f"{len(reached)} poses of its workspace. Give a smaller workspace or spreads"
        )
    return drawn.coordinates[reached][:n]


def find_places(robot: Mechanism) -> IntArray:
    """Return the places (6, 7) of the parameters in the paper's layout in the robot's order."""
    index = robot.parameters.index
    return np.array([[index(f"leg{leg}.{name}") for name in PARAMETERS] for leg in range(1, 7)])


def to_coordinates(T: FloatArray) -> FloatArray:
    """Return coordinates (.., 6) [m, rad] of transforms (.., 4, 4)."""
    return np.concatenate([T[..., :3, 3], ANGLES.from_matrix(T[..., :3, :3])], axis=-1)


def subtract_poses(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return differences (.., 6) of coordinates, angles wrapped."""
    change = first - second
    return np.concatenate([change[..., :3], geometry.wrap_angle(change[..., 3:])], axis=-1)


def to_measurements(
    setup: Setup, measured: FloatArray, sigma: FloatArray | float = 1.0
) -> Measurements:
    """Return measured poses (n, 6) [m, rad]; sigma : one for all values, or (n, 6) [m, rad]."""
    kind = Pose(f"euler-{ORDER}").with_tool(setup.robot.tool)
    sd = sigma if isinstance(sigma, float) else np.roll(sigma, 3, axis=1)
    # a kind has its angles first
    rows = Observations.from_sigma(kind, np.arange(len(measured)), np.roll(measured, 3, axis=1), sd)
    labels = tuple(f"A{i + 1}" for i in range(len(measured)))
    return Measurements(setup.robot.name, setup.commanded.q, (rows,), labels=labels)


def compute_rms(values: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


@dataclass(frozen=True, eq=False)
class Iterations:
    """Result of steps 4 to 10. Index k is the state after k iterations, 0 the nominal machine."""

    values: FloatArray  # (k + 1, p) corrected parameters [m]
    pose_errors: FloatArray  # (k + 1, n, 6) measured minus corrected [m, rad]
    integrated: FloatArray  # (k + 1,) max dQint [mm + rad]
    conditions: FloatArray  # (6,) condition number of each leg's matrix in the first iteration

    def count_needed(self, threshold: float) -> int | None:
        """Return the iterations until max dQint is at most the threshold; None if it never is."""
        met = np.flatnonzero(self.integrated[1:] <= threshold)
        return int(met[0]) + 1 if len(met) else None


def draw_measured_poses(
    setup: Setup, limits: tuple[float, float], seed: int = 0, trial: int = 0
) -> FloatArray:
    """Return the true poses (n, 6) [m, rad] with uniform noise within limits [mm, rad]: step 3. The
    drawn numbers are those of `simulate_trials` for the same seed and trial.
    """
    drawn = make_random_stream(seed, trial).uniform(-1.0, 1.0, setup.actual.shape)
    noise = np.array([limits[0] * MM] * 3 + [limits[1]] * 3)
    return setup.actual + np.roll(drawn, 3, axis=1) * noise  # a kind has its angles first


def iterate(
    setup: Setup, measured: FloatArray, limit: int | None = None, is_renewed: bool = True
) -> Iterations:
    """Run steps 4 to 10 on measured poses (n, 6) [m, rad], `limit` times (default: as sizes.yaml
    states), beyond the rule.

    is_renewed : whether the matrix is computed anew at every corrected machine. The paper does not
    say. False keeps the matrix of the nominal machine throughout.
    """
    robot, data = setup.robot, to_measurements(setup, measured)
    limit = int(limit or SIZES.find("iterations"))
    values = list(identify_per_leg(robot, data, limit if is_renewed else 1).estimate_history)
    nominal = LegForm.at(robot, setup.commanded)
    errors = [subtract_poses(measured, setup.poses)]
    for k in range(1, limit + 1):
        if k == len(values):
            values.append(values[-1] + nominal.fit(setup.to_twists(errors[-1], measured)))
        reached = setup.compute_reached(robot.with_values(values[k]))
        errors.append(subtract_poses(measured, reached))
    stacked = np.stack(errors)
    return Iterations(np.stack(values), stacked, integrate_errors(stacked), nominal.conditions)


@dataclass(frozen=True, eq=False)
class Level:
    """Results with one level of noise."""

    limits: tuple[float, float]  # [mm, rad]
    # (t, 4): rms of pose residuals [mm], [rad] and of parameter errors [mm], max dQint [mm + rad];
    # infinite for lost draws
    sizes: FloatArray
    needed: FloatArray  # (t,) iterations, infinite for never

    @property
    def median(self) -> FloatArray:
        """(4,) medians of the sizes."""
        return np.median(self.sizes, axis=0)


def sweep_noise(setup: Setup, seed: int, trials: int) -> dict[str, Level]:
    """Repeat the ten steps at every level of noise, until the rule ends them."""
    results, commanded = {}, setup.commanded
    for name, limits in list_noises().items():
        cell = setup.calibrate(seed, trials, name, PER_LEG)
        is_known = np.isfinite(cell.values).all(axis=1, keepdims=True)
        values = np.where(is_known, cell.values, setup.robot.values)
        T = forward_trials(setup.robot, values, commanded.q[None], commanded.state).T
        measured = np.roll(cell.measured[0], 3, axis=2)  # a kind has its angles first
        residual = subtract_poses(measured, to_coordinates(T @ setup.robot.tool))
        by_dimension = residual[..., :3] / MM, residual[..., 3:]
        rms = [np.sqrt(np.mean(x**2, axis=(1, 2))) for x in by_dimension]
        sizes = np.column_stack([*rms, setup.compute_error(values), integrate_errors(residual)])
        needed = np.where(cell.is_converged, cell.iterations, np.inf)
        results[name] = Level(limits, np.where(is_known, sizes, np.inf), needed)
    return results


@dataclass(frozen=True, eq=False)
class Draws:
    """Results of one method with t draws of noise; NaN for lost ones.

    parameters : (t,) rms errors of the lengths [mm]. places : (t,) rms errors of positions [mm] at
        equal readings, by where the poses lie. smaller, halved : (t,) share of the parameters
        whose error is smaller than before, and at most half as large. largest : (t,) largest error
        [mm, rad] over that before.
    """

    parameters: FloatArray
    places: Mapping[str, FloatArray]
    smaller: FloatArray
    halved: FloatArray
    largest: FloatArray

    @property
    def rms(self) -> Row:
        """The sizes over all draws."""
        sizes = {"parameters": self.parameters, **self.places}
        return {name: compute_rms(size) for name, size in sizes.items()}


def compare_methods(setup: Setup, seed: int, trials: int) -> dict[str, Draws]:
    """Compare the paper's method, all legs weighted together, and MAP on the same stated noise, and
    the machine as designed.
    """
    methods = {"alone": PER_LEG, "together": TOGETHER, "prior": PRIOR}
    values = {"before": setup.robot.values[None]}
    values |= {k: setup.calibrate(seed, trials, STATED, name).values for k, name in methods.items()}
    truth, results, count = setup.truth.values, {}, SIZES.find("unmeasured")
    units = list_raw_units(setup.robot.parameters.dimensions)
    errors = np.abs(setup.robot.values - truth) / units
    drawn = {name: inverse(setup.robot, draw_poses(setup, name, count, seed))
             for name in list_places(setup)}  # fmt: skip

    def locate(machines: FloatArray, poses: Solution) -> FloatArray:
        """Return positions (t, n, 3) of machines (t, p) at the readings of poses."""
        T = forward_trials(setup.robot, machines, poses.q[None], poses.state).T
        return (T @ setup.robot.tool)[..., :3, 3]

    true = {name: locate(truth[None], poses) for name, poses in drawn.items()}
    for key, v in values.items():
        places = {}
        for name, poses in drawn.items():
            squares = np.sum(((locate(v, poses) - true[name]) / MM) ** 2, axis=-1)
            places[name] = np.sqrt(np.mean(squares, axis=1))
        left = (np.abs(v - truth) / units)[:, errors > 0.0]
        ratio = left / errors[errors > 0.0]
        shares = ((ratio < 1.0).mean(axis=1), (ratio <= 0.5).mean(axis=1))
        largest = left.max(axis=1) / errors.max()
        results[key] = Draws(setup.compute_error(v), places, *shares, largest)
    return results


def compare_poses(setup: Setup, seed: int, trials: int) -> list[Row]:
    """Calibrate from other numbers and ranges of poses; None where that is impossible."""
    own, columns = setup.coordinates, ("iterations", "left", "condition", PER_LEG, TOGETHER)
    sets = [("the first ones", own[:n]) for n in range(setup.fewest, len(own))][:MOST_FIRST]
    sets.append((MEASURED, own))
    for place in list_places(setup):
        counts = [share * len(own) for share in SIZES.find("drawn")]
        sets += [(f"drawn, {place}", draw_poses(setup, place, n, seed)) for n in counts]
    rows = []
    for name, poses in sets:
        other = replace(setup, coordinates=poses)
        row: Row = {"poses": name, "number": len(poses), **dict.fromkeys(columns)}
        with suppress(EstimationError):
            exact = iterate(other, other.actual)
            left = float(other.compute_error(exact.values[-1]))
            row |= {"iterations": exact.count_needed(setup.epsilon), "left": left,
                    "condition": float(exact.conditions.max())}  # fmt: skip
            for method in (PER_LEG, TOGETHER):
                cell = setup.calibrate(seed, trials, STATED, method, poses)
                row[method] = compute_rms(other.compute_error(cell.values))
        rows.append(row)
    return rows


def list_places(setup: Setup) -> tuple[str, ...]:
    """Return where poses are drawn."""
    return (NEAR, WIDE) if setup.is_printed else (WORKSPACE,)


def draw_poses(setup: Setup, place: str, n: int, seed: int) -> FloatArray:
    """Return poses (n, c) [m, rad] drawn uniformly in the range of the paper's poses, in the wide
    one, or in the workspace of another robot.
    """
    stream = make_random_stream(seed, n, DRAWN_POSES)
    if place == WORKSPACE:
        return draw_reached(setup.robot, setup.truth, n, stream)
    low, high = setup.coordinates.min(axis=0), setup.coordinates.max(axis=0)
    if place == WIDE:
        low, high = np.array(SIZES.find("wide")) * np.array([MM] * 3 + [np.pi / 180.0] * 3)
    return stream.uniform(low, high, (n, 6))


# The whole study: compute everything, put it beside the printed tables, judge the claims.

TEXT = published.PaperText(__file__)
METHODS = {
    "before": "not calibrated",
    "alone": "leg by leg, unweighted (the paper)",
    "together": "all legs, weighted by the noise",
    "prior": "together, with expected spreads as prior (MAP)",
}
# Titles of the runs without noise, of which the second keeps the matrix of step 5.
RUNS = ("without noise", "without noise, one matrix throughout")
# Limits of decisions; a number between the two of a pair decides nothing.
UNITS = (1.0, 2.0)  # of the last digit: a second one can come from the rounding of other tables
OF_RULE = ("converges", "threshold_noise")  # claims on what the rule of the paper leaves
AS_GOOD = 1.1  # ratio of errors
EXACT = 1e-6  # [mm] parameter error that steps without noise leave


@dataclass(frozen=True, eq=False)
class Results:
    """All computed numbers, before they are judged."""

    setup: Setup  # the machine of Tables 2 and 3, or another one
    # "exact": without noise; "frozen": the same with one matrix; "presumed", "stated": with noise
    runs: Mapping[str, Iterations]
    levels: Mapping[str, Level]  # by noise of sizes.yaml
    methods: Mapping[str, Draws]  # by key of METHODS
    poses: list[published.Row]
    comparisons: Mapping[str, published.Comparison]  # of Tables 3 to 6; none of another robot


def compute(
    seed: int, trials: int, progress: Callable[[str], None], case: StudyCase | None = None
) -> Results:
    """Compute everything; case : another robot or rule.

    Raises EstimationError: the legs of the robot cannot be identified one by one.
    """
    setup = make_setup(case, seed)
    progress("the ten steps")
    runs = {
        "exact": iterate(setup, setup.actual),
        "frozen": iterate(setup, setup.actual, is_renewed=False),
    }
    for name in (PRESUMED, STATED):
        drawn = draw_measured_poses(setup, list_noises()[name], seed)
        runs[name] = iterate(setup, drawn)
    progress("levels of noise")
    levels = sweep_noise(setup, seed, trials)
    progress("methods and numbers of poses")
    methods = compare_methods(setup, seed, trials)
    poses = compare_poses(setup, seed, trials)
    compared = compare_printed(setup, runs) if setup.is_printed else {}
    return Results(setup, runs, levels, methods, poses, compared)


def count_printed() -> int:
    """Return the iterations after which the paper's rule ends them."""
    return int(PRINTED.find("iterations", "value"))


def compare_tables(results: Results) -> tuple[published.Comparison, ...]:
    """Return Tables 3 to 6, printed beside computed."""
    return tuple(results.comparisons.values())


def compare_printed(
    setup: Setup, runs: Mapping[str, Iterations]
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
    is_replaced = {"epsilon": setup.epsilon != printed, "robot": not setup.is_printed}
    return TEXT.list_replaced(
        filter(is_replaced.get, is_replaced), epsilon=setup.epsilon, printed=printed,
        robot=setup.robot.name, noise=PRINTED.number("noise", "value"),
    )  # fmt: skip


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
        (f"position error, rms over draws, poses {name} [mm]", ".2g") for name in list_places(setup)
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
    ends = {name: run.count_needed(setup.epsilon) or -1 for name, run in runs.items()}
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
    length, angle = list_noises()[name]
    return f"noise within +-{length:g} mm, +-{angle:g} rad"


def make_figures(results: Results) -> Iterator[published.Figure]:
    """Yield max dQint by iteration, and the sizes after calibration by noise, with 1e-3 rad of
    angle noise per mm.
    """
    threshold, count = results.setup.epsilon, len(results.setup.poses)
    labels = (*RUNS, _describe_noise(PRESUMED), _describe_noise(STATED))
    lines = [
        published.Series.of(label, range(len(run.integrated)), run.integrated)
        for label, run in zip(labels, results.runs.values(), strict=True)
    ]
    rule = {f"rule {threshold:g}": threshold}
    yield TEXT.figure("figure_4", lines, rule, threshold=threshold, count=count,
                      iterations=count_printed(), tables=results.setup.is_printed)  # fmt: skip

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
    yield TEXT.figure("noise", lines, marks, trials=trials, noise=stated)


def judge_claims(results: Results) -> tuple[published.Verdict, ...]:
    """Return a verdict for each claim; those on the printed tables belong to their machine, and
    `OF_RULE` to the paper's rule.
    """
    is_rule = results.setup.epsilon == PRINTED.number("threshold", "value")
    return tuple(v for v in _judge_all(results) if is_rule or v.name not in OF_RULE)


def _judge_all(results: Results) -> Iterator[published.Verdict]:
    setup, used, stated = results.setup, count_printed(), results.levels[STATED]
    printed = PRINTED.number("threshold", "value")
    rms = {key: draws.rms for key, draws in results.methods.items()}
    judge = partial(TEXT.judge, elsewhere=not setup.is_printed, iterations=used, rms=rms,
                    threshold=printed, noise=stated.limits[0], angle=stated.limits[1],
                    parameters=int(setup.robot.parameters.free.sum()))  # fmt: skip
    if setup.is_printed:  # the actual poses, by the largest difference in units of the last digit
        fourth = results.comparisons["table_4"]
        rows = np.array([not x.endswith("PT") and x.split()[0] != ODD_POSE
                         for x in fourth.published.labels])  # fmt: skip
        off = (abs(fourth.difference) / fourth.step)[rows].max() / (1.0 + published.ROUNDING)
        good = fourth.within[rows]
        yield judge("table_4", decide(off <= UNITS[0], off > UNITS[1]), row=ODD_POSE,
                    agreeing=int(good.sum()), count=good.size)  # fmt: skip

    # convergence and the stopping rule
    exact, frozen = results.runs["exact"], results.runs["frozen"]
    counts = [run.count_needed(printed) for run in (exact, frozen)]
    units = list_raw_units(setup.robot.parameters.dimensions)
    largest = np.abs((setup.truth.values - exact.values) / units).max(axis=1)
    five = (abs(PRINTED.table("table_5", name).values).max() for name in ("before", "after"))
    share = 1e-3 / next(five) * next(five)
    alone, together, before = (results.methods[key] for key in ("alone", "together", "before"))
    yield judge("exact", decide(largest[used] <= share * largest[0], largest[used] >= largest[0]),
                largest=largest[used], more=largest[used + 1], share=100.0 * share)  # fmt: skip
    yield judge("converges", alone.largest <= share, ratio=np.median(alone.largest),
                share=100.0 * share)  # fmt: skip
    yield judge("threshold", decide(counts == [used, used], used not in counts),
                exact=exact.integrated, frozen=frozen.integrated)  # fmt: skip
    yield judge("threshold_noise", stated.needed <= used, median=stated.median[3])

    # what calibration improves, for each draw of noise; a lost draw improves nothing
    yield judge("parameters_improve", alone.halved > 0.5,
                smaller=100.0 * np.median(alone.smaller), halved=100.0 * np.median(alone.halved),
                ratio=rms["alone"]["parameters"] / rms["before"]["parameters"])  # fmt: skip
    at_measured = compute_rms(exact.pose_errors[0][:, :3] / MM)
    residuals = stated.sizes[:, 0]
    yield judge("poses_improve", residuals <= 0.5 * at_measured, before=at_measured,
                after=np.median(residuals))  # fmt: skip
    improved = np.array([alone.places[name] < before.places[name] for name in before.places])
    places = [{"place": name, **{key: of[name] for key, of in rms.items()}}
              for name in before.places]  # fmt: skip
    yield judge("positions_improve", improved.all(axis=0), places=places)
    yield judge("leg_by_leg", alone.parameters <= AS_GOOD * together.parameters,
                ratio=rms["alone"]["parameters"] / rms["together"]["parameters"])  # fmt: skip
    least, left = results.poses[0], results.poses[0]["left"]
    enough = decide(
        left is not None and left < EXACT, left is None or left >= rms["before"]["parameters"]
    )
    own = next(row for row in results.poses if row["poses"] == MEASURED)
    yield judge("fewest_poses", enough, least=least, own=own)
