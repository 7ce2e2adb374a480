# SPDX-License-Identifier: Apache-2.0
"""Each measurement kind alone: rank, recovery of the machine up to its gauge freedom, and coverage
of intervals.

Cases are the examples of every registered kind on a hexapod, a 3-PRS and a linear delta, so that a
new kind is included automatically.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.apply.validation import validate
from loopcal.diagnose.gauge_freedoms import find_gauge_freedoms
from loopcal.diagnose.row_errors import PoseErrors
from loopcal.errors import LoopcalError
from loopcal.estimate.identification import IdentifiedTrials, identify, identify_trials
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.problem import problem_of, problem_of_trials
from loopcal.estimate.result import Identification, estimate_nuisance
from loopcal.geometry import align_point_sets, solve_hand_eye
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.joints import JointSensor
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import collect_nuisance_parameters
from loopcal.measure.simulation import Trials, sample_truth, simulate, simulate_trials
from loopcal.mechanism.compilation import build
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.decomposition import RANK_TOLERANCE
from loopcal.typing import IntArray
from loopcal.units import Dimension

Array = NDArray[np.float64]

ROBOTS = ("hexapod-42", "3-prs", "linear-delta")
POSES, HELD_OUT, SEED = 60, 15, 17
PAIR_STEPS = (1, 7, 19)
"""Distances, in poses, between the two poses that a row of a linking kind compares."""

GAUGE_STEPS = 6
"""Steps along the gauge freedom; the error decreases quadratically."""

GROUPS = 3
"""Groups (surfaces, locks) among which the poses are divided."""

FITS_PER_BATCH = 8
"""Fits whose setup parameters come from one factor, which needs all their poses at once."""

FITS, NORMAL_95 = 100, 1.959963984540054
"""Fits of a case, and the 97.5 % point of the normal distribution."""

SIGMA = {Dimension.LENGTH: 5e-6, Dimension.ANGLE: 25e-6}
"""Noise, one standard deviation [m], [rad]."""

SETUP_RANGE = {Dimension.LENGTH: 0.02, Dimension.ANGLE: 0.3}
"""Largest difference of true and stated setup parameters [m], [rad]."""


class NoNoise(Gaussian):
    """Noise of a stated sigma whose draws are zero."""

    def draw(self, generator: np.random.Generator, n: int) -> Array:
        """Return zeros (n, m)."""
        return np.zeros((n, len(self.sd)))


class DoubledNoise(Gaussian):
    """Noise twice as large as stated."""

    def draw(self, generator: np.random.Generator, n: int) -> Array:
        """Draw noise (n, m)."""
        return 2.0 * super().draw(generator, n)


@dataclass(frozen=True, eq=False)
class Case:
    """A kind in one of its settings, and the measured robot."""

    robot: str
    kind: Kind

    @property
    def setting(self) -> str:
        """Return the kind, its components, and its unknown setup parameters."""
        seen = (
            getattr(self.kind, "components", ())
            or getattr(self.kind, "orientation", "")
            or getattr(self.kind, "form", "")
        )
        seen = seen if isinstance(seen, str) else " ".join(seen)
        targets = len(getattr(self.kind, "targets", ()))
        words = [seen, f"{targets} targets" if targets > 1 else ""]
        unknown = getattr(self.kind, "unknown", ())
        words.append(f"{' and '.join(unknown)} unknown" if unknown else "")
        return ", ".join([self.kind.name, *(word for word in words if word)])

    def __str__(self) -> str:
        return f"{self.robot}: {self.setting}"


def list_cases(robots: tuple[str, ...] = ROBOTS) -> tuple[Case, ...]:
    """Return every example of every kind on every robot."""
    return tuple(
        Case(name, _with_joints(name, kind))
        for name in robots
        for cls in KINDS.values()
        if not cls.label_count  # pictures: evidence/printed_board.py
        for kind in cls.examples()
        if kind.columns  # readings alone are of machines with redundant actuators
    )


def _with_joints(name: str, kind: Kind) -> Kind:
    """Return the kind; a joint sensor measures all passive joints, or else the actuated ones."""
    if not isinstance(kind, JointSensor):
        return kind
    robot = _load_robot(name, True)
    passive, driven = _passive_names(robot), tuple(a.name for a in robot.actuators)
    return replace(kind, joints=passive or driven, measures="angle" if passive else "length")


@cache
def _load_robot(name: str, chains: bool) -> Mechanism:
    robot = load_robot(name)
    if not chains or name != "hexapod-42":
        return robot
    record = replace(robot.record.record, legs="ups")
    return build(record.expand(), record=record)


@cache
def _coordinates(name: str, seed: int) -> Array:
    """Return coordinates (n, c) in the workspace; the last ones are held out."""
    return sample_workspace(_load_robot(name, False), POSES + HELD_OUT, seed).coordinates


def _passive_names(robot: Mechanism) -> tuple[str, ...]:
    """Return the names of the passive joints."""
    return inverse(robot, robot.home[None]).passive_names


def load_machine(case: Case) -> Mechanism:
    """Return the nominal robot; a hexapod with joint sensors has joints in its legs."""
    return _load_robot(case.robot, bool(case.kind.sensed_joints))


def make_instrument(kind: Kind, poses: int, noise: type[Gaussian]) -> Instrument:
    """Return an instrument of the kind at all poses, in pairs or groups if the kind needs them."""
    every = np.arange(poses)
    rows = (
        np.concatenate([np.stack([every, np.roll(every, -k)], axis=1) for k in PAIR_STEPS])
        if kind.poses_per_row == 2
        else every
    )
    sigma = np.array([SIGMA[column.dimension] for column in kind.noise_columns])
    grouped = any(p.scope == "group" for p in kind.nuisance_parameters)
    group = np.array([f"g{i % GROUPS}" for i in range(len(rows))]) if grouped else np.array("")
    return Instrument((Sensor(kind, noise(sigma), rows=rows, group=group),))


def draw_setup_values(
    robot: Mechanism, looking: Instrument, poses: int, rng: np.random.Generator
) -> dict[str, float]:
    """Draw true setup values of an instrument, evenly about the stated ones."""
    sensors = [sensor.assign_rows(poses) for sensor in looking.with_tool(robot).sensors]
    labels = tuple(map(str, range(poses)))
    table = collect_nuisance_parameters(sensors, labels).table
    reach = np.array([SETUP_RANGE[p.dimension] for p in table.entries])
    drawn = rng.uniform(-reach, reach)
    drawn = np.where(
        [name.endswith("offset") for name in table.names], np.abs(drawn), drawn
    )  # no length below zero
    return dict(zip(table.names, (table.nominal + drawn).tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class Recovery:
    """Recovery of a machine with errors from noise-free rows of one kind.

    rank of p parameters, and refused : the sentence instead of a fit. seen : largest error of what
    the kind sees at poses
    held out [m, rad, lengths as a share of the robot's size]. pose : of the poses themselves after
    moving the frames that the kind leaves open; NaN where it leaves more open. before : of `seen`
    before. parameters : see `compare_along_gauge`.
    """

    rank: int
    p: int
    seen: float
    pose: float
    parameters: float
    before: float
    frames: tuple[str, ...]
    machine: int
    refused: str = ""


def recover_machine(case: Case, seed: int = SEED) -> Recovery:
    """Identify a machine from noise-free rows of one kind; compare it with the truth at held-out
    poses.
    """
    robot, rng = load_machine(case), np.random.default_rng(seed)
    truth = robot.with_values(sample_truth(robot, 1, seed)[0])
    looking = make_instrument(case.kind, POSES + HELD_OUT, NoNoise)
    own = draw_setup_values(robot, looking, POSES + HELD_OUT, rng)
    try:
        data = simulate(truth, _coordinates(case.robot, seed), looking, seed, nuisance_values=own)
        some, others = data.take(np.arange(POSES)), data.take(np.arange(POSES, POSES + HELD_OUT))
        fit = identify(robot, some, LeastSquares(), options=FitOptions(allow_fewer_equations=True))
    except LoopcalError as error:
        return Recovery(0, len(robot.parameters), np.nan, np.nan, np.nan, np.nan, (), 0, str(error))
    checked = validate(fit, others)
    known = fit.posterior
    motions = find_gauge_freedoms(known.robot, known.places, known.unit, known.undetermined)
    left = len(fit.names) - fit.rank - motions.count
    return Recovery(
        rank=fit.rank,
        p=len(fit.names),
        seen=_largest(checked.after, robot.size),
        pose=pose_error(fit.robot, truth, others.readings, motions.frames) if not left else np.nan,
        parameters=compare_along_gauge(fit, some, truth.values),
        before=_largest(checked.before, robot.size),
        frames=motions.frames,
        machine=left,
    )


def pose_error(
    found: Mechanism, truth: Mechanism, readings: Array, frames: tuple[str, ...]
) -> float:
    """Return the largest error [m / size, rad] of predicted poses at readings (n, a).

    The best rigid motion of `frames` is removed first.
    """
    T, true = forward(found, readings).T, forward(truth, readings).T
    if (
        not np.ptp(T[:, :3, :3], axis=0).max() > 1e-9
    ):  # a platform that does not turn has no tool frame of its own
        turned = align_point_sets(T[:, :3, 3], true[:, :3, 3]) if frames else np.eye(4)
        return float(np.abs((turned @ T)[:, :3, 3] - true[:, :3, 3]).max() / found.size)
    base, tool = (None if name in frames else np.eye(4) for name in ("base", "platform"))
    F, X = solve_hand_eye(T, true, base, tool) if frames else (np.eye(4), np.eye(4))
    off = geometry.pose_difference(geometry.invert_pose(F) @ T @ X, true)
    return float(np.abs(off / np.array([1.0] * 3 + [found.size] * 3)).max())


def _largest(errors: PoseErrors, size: float) -> float:
    """Return the largest error, lengths as a share of the robot's size."""
    sizes = [
        quantity.size / (size if quantity.dimension is Dimension.LENGTH else 1.0)
        for quantity in errors.quantities.values()
    ]
    return float(np.concatenate(sizes).max())


def compare_along_gauge(fit: Identification, data: Measurements, truth: Array) -> float:
    """Return the largest difference of parameters and truth [m / size, rad] that no motion along
    the gauge freedom explains.

    From the estimate every step goes back to what explains the data by `-A^+ r` and along the null
    directions of A towards the truth, `N N' (z_true - z)`. Where the estimate lies on the orbit of
    the truth it arrives there. What the first step back corrects is an error of the fit, too: the
    larger of the two counts.
    """
    free = fit.free_parameters
    problem, z, goal = (
        problem_of(free, data),
        free.deviation(fit.robot.values[None])[0],
        free.deviation(truth[None])[0],
    )
    unit = free.tolerance / np.array(
        [fit.robot.size if p.dimension is Dimension.LENGTH else 1.0 for p in free.parameters]
    )
    first = None
    start = problem.start(z[None])
    for _ in range(GAUGE_STEPS):
        at = problem.linearize(z[None], start)
        factor, start = at.factor[0], at.next_start
        U, s, vt = np.linalg.svd(factor[:-1, :-1])
        rank = int((s > RANK_TOLERANCE * s[0]).sum())
        back = -vt[:rank].T @ ((U[:, :rank].T @ factor[:-1, -1]) / s[:rank])
        first = np.abs(back * unit).max() if first is None else first
        z = z + back + vt[rank:].T @ (vt[rank:] @ (goal - z))
    return float(max(first or 0.0, np.abs((z - goal) * unit).max()))


@dataclass(frozen=True, eq=False)
class Coverage:
    """Which 95 % intervals of t fits contain the truth.

    directions : combinations of parameters that the data know better than the spreads.
        parameters : (t, p).
    setup : (t, U) frames, targets, surfaces and offsets. Intervals that are infinite are left out.
    """

    fits: int
    directions: NDArray[np.bool_]
    parameters: NDArray[np.bool_]
    setup: NDArray[np.bool_]


def compute_coverage(
    case: Case, fits: int = FITS, noise: type[Gaussian] = Gaussian, seed: int = SEED
) -> Coverage:
    """Simulate machines drawn from their spreads, identify by MAP and compare with the truth."""
    robot, rng = load_machine(case), np.random.default_rng(seed)
    coordinates = _coordinates(case.robot, seed)[:POSES]
    looking = make_instrument(case.kind, POSES, noise)
    own = draw_setup_values(robot, looking, POSES, rng)
    truth = sample_truth(robot, fits, seed)
    trials = simulate_trials(robot, truth, coordinates, looking, seed, nuisance_values=own)
    result = identify_trials(robot, trials, MAP())
    good = np.flatnonzero(result.converged)
    free, d, penalty = result.free_parameters, result.decomposition.take(good), result.penalty[good]
    off = free.deviation(result.values[good]) - free.deviation(truth[good])
    sd = d.standard_deviations(penalty, 1.0)
    s, along = d.singular_values, np.matmul(d.directions.swapaxes(-1, -2), off[..., None])[..., 0]
    known = np.where(s > 1.0, np.abs(along) * np.sqrt(s * s + penalty), np.nan)
    return Coverage(
        fits=len(good),
        directions=(known <= NORMAL_95)[~np.isnan(known)],
        parameters=np.abs(off) <= NORMAL_95 * sd,
        setup=_setup_covered(result, trials, good, own),
    )


def _setup_covered(
    found: IdentifiedTrials, trials: Trials, good: IntArray, own: dict[str, float]
) -> NDArray[np.bool_]:
    """Return whether finite intervals of the setup parameters contain the truth."""
    problem, free = problem_of_trials(found.free_parameters, trials), found.free_parameters
    if problem.nuisance is None:
        return np.zeros(0, dtype=bool)
    inside = []
    truth = np.array([own[name] for name in problem.nuisance.local.table.names])
    for i in good.tolist():
        one = np.array([i])
        z, alone = free.deviation(found.values[one]), problem.take(one)
        # other tests cover the start values
        at = alone.linearize(z, alone.start(z, seek=False).with_nuisance(truth[None]))
        d, penalty = found.decomposition.take(one), found.penalty[one]
        variance = d.variances(penalty)[0]
        local = estimate_nuisance(problem.nuisance, at, free.robot, d, variance, 1.0)
        off = local.estimate - truth
        inside.append((np.abs(off) <= NORMAL_95 * local.sd)[np.isfinite(local.sd)])
    return np.concatenate(inside)


def coverage_band(fits: int, p: float = 0.95) -> float:
    """Return four standard deviations of a share with one draw per fit, as the intervals of one fit
    are correlated.
    """
    return 4.0 * float(np.sqrt(p * (1.0 - p) / fits))


def select_most_unknown(robots: tuple[str, ...] = ROBOTS) -> tuple[Case, ...]:
    """Return the last example of every kind, which has most unknowns."""
    return tuple({(case.robot, case.kind.name): case for case in list_cases(robots)}.values())


def _recovery_rows() -> list[list[object]]:
    """Return a row for each setting: rank and largest error on each robot, none if refused."""
    rows: dict[int, list[object]] = {}
    each = len(list_cases(ROBOTS[:1]))
    for i, case in enumerate(list_cases(ROBOTS)):
        result = recover_machine(case)
        row = rows.setdefault(i % each, [case.setting])
        worst = (
            float(np.nanmax([result.seen, result.pose, result.parameters]))
            if not result.refused
            else None
        )
        row += [None if result.refused else f"{result.rank} of {result.p}", worst]
    return list(rows.values())


def _coverage_rows() -> list[list[object]]:
    """Return one row for each kind and robot, and one that must fail."""
    rows: list[list[object]] = []
    loud = next(case for case in list_cases(ROBOTS) if case.kind.name == "position")
    for case, noise in [
        *((case, Gaussian) for case in select_most_unknown(ROBOTS)),
        (loud, DoubledNoise),
    ]:
        result = compute_coverage(case, FITS, noise)
        shares = [
            part.mean() if part.size else None
            for part in (result.directions, result.parameters, result.setup)
        ]
        suffix = ", noise twice its sigma" if noise is DoubledNoise else ""
        rows.append(
            [
                case.robot,
                case.setting + suffix,
                result.fits,
                *(None if s is None else 100.0 * float(s) for s in shares),
            ]
        )
    return rows


QUICK = {"ROBOTS": ("linear-delta",), "FITS": 8}


def check(tables: dict[str, Any]) -> None:
    """Assert what holds at the quick size."""
    assert all(row[2] is None or row[2] < 1e-6 for row in tables["recovery"]["rows"])
    *true, loud = tables["coverage"]["rows"]
    assert loud[3] < 90.0 < min(row[3] for row in true if row[3] is not None)


def collect() -> dict:
    """Collect the recovery of every setting on every robot, and coverage with most unknowns."""
    per_robot = [f"{robot}: {what}" for robot in ROBOTS for what in ("rank", "largest error")]
    holds = [
        f"coverage of {what} [%]"
        for what in ("determined directions", "parameters", "setup parameters")
    ]
    return {
        "seed": SEED,
        "poses": POSES,
        "noise": {
            "length [um]": 1e6 * SIGMA[Dimension.LENGTH],
            "angle [urad]": 1e6 * SIGMA[Dimension.ANGLE],
        },
        "tables": {
            "recovery": {
                "columns": ["measurement kind", *per_robot],
                "formats": ["", *["", ".0e"] * len(ROBOTS)],
                "rows": _recovery_rows(),
            },
            "coverage": {
                "columns": ["robot", "measurement kind", "fits", *holds],
                "formats": ["", "", "d", ".1f", ".1f", ".1f"],
                "rows": _coverage_rows(),
            },
        },
    }
