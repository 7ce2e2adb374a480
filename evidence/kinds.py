# SPDX-License-Identifier: Apache-2.0
# size: one study of all kinds, with its tables
"""What every kind of measurement can do alone: rank, recovery of the machine up to its gauge, and
true error bars.

Cases are the examples of every registered kind on a hexapod, a 3-PRS and a linear delta, so that a
new kind is in at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.apply import validate
from loopcal.diagnose import PoseErrors, find_frame_motions
from loopcal.errors import LoopcalError
from loopcal.estimate import (
    MAP,
    FitOptions,
    Identification,
    LeastSquares,
    identify,
    identify_trials,
)
from loopcal.estimate.identification import IdentifiedTrials
from loopcal.estimate.nuisance.estimate import estimate_nuisance
from loopcal.estimate.problem_construction import problem_of, problem_of_trials
from loopcal.geometry.alignment import align_point_sets, solve_hand_eye
from loopcal.io import load_robot
from loopcal.measure import (
    KINDS,
    Gaussian,
    Instrument,
    JointSensor,
    Kind,
    Measurements,
    Sensor,
    Trials,
    collect_nuisance_parameters,
    sample_truth,
    simulate,
    simulate_trials,
)
from loopcal.mechanism import Mechanism, build, forward, inverse, sample_workspace
from loopcal.numerics.decomposition import RANK_TOLERANCE
from loopcal.typing import IntArray
from loopcal.units import Dimension

Array = NDArray[np.float64]

ROBOTS = ("hexapod-42", "3-prs", "linear-delta")
POSES, HELD_OUT, SEED = 60, 15, 17
PAIRS = (1, 7, 19)
"""How many poses apart those are that one row of a kind with links compares."""

WALK = 6
"""Steps along the gauge; each squares what is left."""

GROUPS = 3
"""Surfaces and locks that share the poses among them."""

TOGETHER = 8
"""Fits whose own unknowns are read from one fold, which must hold all their poses at once."""

FITS, NORMAL_95 = 100, 1.959963984540054
"""Fits of a case, and the 97.5 % point of the normal distribution."""

SIGMA = {Dimension.LENGTH: 5e-6, Dimension.ANGLE: 25e-6}
"""Noise, one standard deviation [m], [rad]."""

REACH = {Dimension.LENGTH: 0.02, Dimension.ANGLE: 0.3}
"""How far true frames, targets, surfaces and offsets are from the stated ones, at most [m], [rad].
"""


class Silent(Gaussian):
    """Noise that is stated but does not come."""

    def draw(self, generator: np.random.Generator, n: int) -> Array:
        """Zeros (n, m)."""
        return np.zeros((n, len(self.sd)))


class Loud(Gaussian):
    """Noise twice as large as stated."""

    def draw(self, generator: np.random.Generator, n: int) -> Array:
        """Noise (n, m)."""
        return 2.0 * super().draw(generator, n)


@dataclass(frozen=True, eq=False)
class Case:
    """A kind in one of its settings, and the robot that it looks at."""

    robot: str
    kind: Kind

    @property
    def setting(self) -> str:
        """The kind, what it sees, and what of it is unknown."""
        seen = (
            getattr(self.kind, "components", ())
            or getattr(self.kind, "orientation", "")
            or getattr(self.kind, "form", "")
        )
        seen = seen if isinstance(seen, str) else " ".join(seen)
        targets = len(getattr(self.kind, "targets", ()))
        words = [seen, f"{targets} targets" if targets > 1 else ""]
        open_ = getattr(self.kind, "unknown", ())
        words.append(f"{' and '.join(open_)} unknown" if open_ else "")
        return ", ".join([self.kind.name, *(word for word in words if word)])

    def __str__(self) -> str:
        return f"{self.robot}: {self.setting}"


def cases(robots: tuple[str, ...] = ROBOTS) -> tuple[Case, ...]:
    """Every example of every kind on every robot."""
    return tuple(
        Case(name, _sensing(name, kind))
        for name in robots
        for cls in KINDS.values()
        for kind in cls.examples()
    )


def _sensing(name: str, kind: Kind) -> Kind:
    """The kind; one that looks at joints sees all passive ones, or the driven ones where there are
    none.
    """
    if not isinstance(kind, JointSensor):
        return kind
    robot = _robot(name, True)
    passive, driven = _passive(robot), tuple(a.name for a in robot.actuators)
    return replace(kind, joints=passive or driven, measures="angle" if passive else "length")


@cache
def _robot(name: str, chains: bool) -> Mechanism:
    robot = load_robot(name)
    if not chains or name != "hexapod-42":
        return robot
    record = replace(robot.record.record, legs="ups")
    return build(record.expand(), record=record)


@cache
def _commanded(name: str, seed: int) -> Array:
    """Coordinates (n, c) all over the workspace, those held out last."""
    return sample_workspace(_robot(name, False), POSES + HELD_OUT, seed).coordinates


def _passive(robot: Mechanism) -> tuple[str, ...]:
    """Names of the passive joints."""
    return inverse(robot, robot.home[None]).passive_names


def machine(case: Case) -> Mechanism:
    """The nominal robot; a hexapod whose joints are looked at has legs with joints."""
    return _robot(case.robot, bool(case.kind.sensed_joints))


def instrument(kind: Kind, poses: int, noise: type[Gaussian]) -> Instrument:
    """The kind looking at all poses; pairs of them where a row compares two, groups where unknowns
    are a group's.
    """
    every = np.arange(poses)
    rows = (
        np.concatenate([np.stack([every, np.roll(every, -k)], axis=1) for k in PAIRS])
        if kind.poses_per_row == 2
        else every
    )
    sigma = np.array([SIGMA[column.dimension] for column in kind.noise_columns])
    grouped = any(p.scope == "group" for p in kind.nuisance_parameters)
    group = np.array([f"g{i % GROUPS}" for i in range(len(rows))]) if grouped else np.array("")
    return Instrument((Sensor(kind, noise(sigma), rows=rows, group=group),))


def own_truth(
    robot: Mechanism, looking: Instrument, poses: int, rng: np.random.Generator
) -> dict[str, float]:
    """True values of the unknowns of an instrument, drawn evenly about the stated ones."""
    sensors = [sensor.assign_rows(poses) for sensor in looking.with_tool(robot).sensors]
    labels = tuple(map(str, range(poses)))
    table = collect_nuisance_parameters(sensors, labels).table
    reach = np.array([REACH[p.dimension] for p in table.entries])
    drawn = rng.uniform(-reach, reach)
    drawn = np.where(
        [name.endswith("offset") for name in table.names], np.abs(drawn), drawn
    )  # no length below zero
    return dict(zip(table.names, (table.nominal + drawn).tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class Recovery:
    """What noise-free rows of a kind told of a machine with errors.

    rank of p parameters, and refused : the sentence instead of a fit. seen : largest error of what
    the kind sees at poses
    held out [m, rad, lengths as a share of the robot's size]. pose : of the poses themselves after
    moving the frames that the kind leaves open; NaN where it leaves more open. before : of `seen`
    before. parameters : see `along_gauge`.
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


def recover(case: Case, seed: int = SEED) -> Recovery:
    """Identify a machine from noise-free rows of one kind, and compare it with the truth at poses
    held out.
    """
    robot, rng = machine(case), np.random.default_rng(seed)
    truth = robot.with_values(sample_truth(robot, 1, seed)[0])
    looking = instrument(case.kind, POSES + HELD_OUT, Silent)
    own = own_truth(robot, looking, POSES + HELD_OUT, rng)
    try:
        data = simulate(truth, _commanded(case.robot, seed), looking, seed, nuisance_values=own)
        some, others = data.take(np.arange(POSES)), data.take(np.arange(POSES, POSES + HELD_OUT))
        fit = identify(robot, some, LeastSquares(), options=FitOptions(allow_fewer_equations=True))
    except LoopcalError as error:
        return Recovery(0, len(robot.parameters), np.nan, np.nan, np.nan, np.nan, (), 0, str(error))
    checked = validate(fit, others)
    motions = find_frame_motions(fit.posterior)
    left = len(fit.names) - fit.rank - motions.count
    return Recovery(
        rank=fit.rank,
        p=len(fit.names),
        seen=_largest(checked.after, robot.size),
        pose=pose_error(fit.robot, truth, others.readings, motions.frames) if not left else np.nan,
        parameters=along_gauge(fit, some, truth.values),
        before=_largest(checked.before, robot.size),
        frames=motions.frames,
        machine=left,
    )


def pose_error(
    found: Mechanism, truth: Mechanism, readings: Array, frames: tuple[str, ...]
) -> float:
    """Largest error [m / size, rad] of predicted poses at readings (n, a), after the best motion of
    the frames named.
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
    """The largest error, lengths as a share of the robot's size."""
    found = np.concatenate([errors.position / size, errors.orientation])
    return float(found[np.isfinite(found)].max())


def along_gauge(fit: Identification, data: Measurements, truth: Array) -> float:
    """Largest difference of the parameters from the truth [m / size, rad] that no motion along the
    gauge explains.

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
    for _ in range(WALK):
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
    """Which 95 % intervals of t fits hold the truth.

    directions : combinations of parameters that the data know better than the tolerances.
        parameters : (t, p).
    own : (t, U) frames, targets, surfaces and offsets. Intervals that are infinite are left out.
    """

    fits: int
    directions: NDArray[np.bool_]
    parameters: NDArray[np.bool_]
    own: NDArray[np.bool_]


def cover(
    case: Case, fits: int = FITS, noise: type[Gaussian] = Gaussian, seed: int = SEED
) -> Coverage:
    """Simulate machines drawn from their tolerances, identify by MAP and compare with the truth."""
    robot, rng = machine(case), np.random.default_rng(seed)
    coordinates = _commanded(case.robot, seed)[:POSES]
    looking = instrument(case.kind, POSES, noise)
    own = own_truth(robot, looking, POSES, rng)
    truth = sample_truth(robot, fits, seed)
    trials = simulate_trials(robot, truth, coordinates, looking, seed, nuisance_values=own)
    found = identify_trials(robot, trials, MAP())
    good = np.flatnonzero(found.converged)
    free, d, penalty = found.free_parameters, found.decomposition.take(good), found.penalty[good]
    off = free.deviation(found.values[good]) - free.deviation(truth[good])
    sd = d.standard_deviations(penalty, 1.0)
    s, along = d.singular_values, np.matmul(d.directions.swapaxes(-1, -2), off[..., None])[..., 0]
    known = np.where(s > 1.0, np.abs(along) * np.sqrt(s * s + penalty), np.nan)
    return Coverage(
        fits=len(good),
        directions=(known <= NORMAL_95)[~np.isnan(known)],
        parameters=np.abs(off) <= NORMAL_95 * sd,
        own=_own_covered(found, trials, good, own),
    )


def _own_covered(
    found: IdentifiedTrials, trials: Trials, good: IntArray, own: dict[str, float]
) -> NDArray[np.bool_]:
    """Whether intervals of the own unknowns hold the truth, those that are finite."""
    problem, free = problem_of_trials(found.free_parameters, trials), found.free_parameters
    if problem.nuisance is None:
        return np.zeros(0, dtype=bool)
    inside = []
    truth = np.array([own[name] for name in problem.nuisance.local.table.names])
    for i in good.tolist():
        one = np.array([i])
        z, alone = free.deviation(found.values[one]), problem.take(one)
        # how starts are found is proved elsewhere
        at = alone.linearize(z, alone.start(z, seek=False).with_nuisance(truth[None]))
        d, penalty = found.decomposition.take(one), found.penalty[one]
        local = estimate_nuisance(problem.nuisance, at, free.robot, d, penalty, 1.0)
        off = local.estimate - truth
        inside.append((np.abs(off) <= NORMAL_95 * local.sd)[np.isfinite(local.sd)])
    return np.concatenate(inside)


def band(fits: int, p: float = 0.95) -> float:
    """Four standard deviations of a share of as many draws as there are fits: intervals of one fit
    are correlated.
    """
    return 4.0 * float(np.sqrt(p * (1.0 - p) / fits))


def with_most_unknowns(robots: tuple[str, ...] = ROBOTS) -> tuple[Case, ...]:
    """The last example of every kind, in which most is unknown."""
    return tuple({(case.robot, case.kind.name): case for case in cases(robots)}.values())


def _recovery_rows() -> list[list[object]]:
    """Return a row for each setting: rank and largest error on each robot, none if refused."""
    rows: dict[int, list[object]] = {}
    each = len(cases(ROBOTS[:1]))
    for i, case in enumerate(cases()):
        found = recover(case)
        row = rows.setdefault(i % each, [case.setting])
        worst = (
            float(np.nanmax([found.seen, found.pose, found.parameters]))
            if not found.refused
            else None
        )
        row += [None if found.refused else f"{found.rank} of {found.p}", worst]
    return list(rows.values())


def _coverage_rows() -> list[list[object]]:
    """One row for each kind and robot, and one that must fail."""
    rows: list[list[object]] = []
    loud = next(case for case in cases() if case.kind.name == "position")
    for case, noise in [*((case, Gaussian) for case in with_most_unknowns()), (loud, Loud)]:
        found = cover(case, noise=noise)
        shares = [
            part.mean() if part.size else None
            for part in (found.directions, found.parameters, found.own)
        ]
        told = ", noise twice as large as stated" if noise is Loud else ""
        rows.append(
            [
                case.robot,
                case.setting + told,
                found.fits,
                *(None if s is None else 100.0 * float(s) for s in shares),
            ]
        )
    return rows


def collect() -> dict:
    """Every setting of every kind on every robot, and coverage of the one with most unknowns."""
    per_robot = [f"{robot}: {what}" for robot in ROBOTS for what in ("rank", "largest error")]
    holds = [
        f"intervals of {what} that hold the truth [%]"
        for what in ("known directions", "parameters", "own unknowns")
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
                "columns": ["kind, alone", *per_robot],
                "formats": ["", *["", ".0e"] * len(ROBOTS)],
                "rows": _recovery_rows(),
            },
            "coverage": {
                "columns": ["robot", "kind, alone", "fits", *holds],
                "formats": ["", "", "d", ".1f", ".1f", ".1f"],
                "rows": _coverage_rows(),
            },
        },
    }
