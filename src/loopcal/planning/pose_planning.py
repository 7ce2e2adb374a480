# SPDX-License-Identifier: Apache-2.0
"""Which poses to measure with a stated instrument, so that the tool is predicted best everywhere in
the workspace.

Candidates that keep to every constraint, the convex relaxation for the bound, Fedorov exchange for
the poses, poses drawn evenly to judge by, and an order to visit them all in. Theory:
docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import EstimationError
from loopcal.measure import Instrument, Measurements
from loopcal.mechanism import Mechanism
from loopcal.planning.certified import certified_design
from loopcal.planning.constraints import Constraints
from loopcal.planning.criteria import A, Criterion, E, I, evaluate
from loopcal.planning.design import Start, allowed, design_factor
from loopcal.planning.needed import counted, pose_curve, poses_needed
from loopcal.planning.order import Visit, visiting_order
from loopcal.planning.problem import Accuracy, Problem, Target, problem
from loopcal.planning.result import Plan
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension, find_unit

SHAKES = 10
"""Times that a design is shaken out of local optima: more gain some tenths of a per cent."""
GAP = 5e-3
"""Of the efficiency, up to which the bound is computed."""
DRAWS = 20
"""Sets of evenly drawn poses that a plan is compared with."""
DIGITS = 8
"""Decimal places of the robot's size, in its unit, or of a radian, to which readings are stated."""
MORE = 12
"""Times that poses are added where those found do not reach a goal when some are held out."""
HELD_OUT = 4
"""One pose is held out for so many that are fitted, where nothing else is asked for."""


def plan(
    robot: Mechanism,
    instrument: Instrument,
    n_poses: int = 40,
    criterion: str = "I",
    *,
    hold_out: int | None = None,
    constraints: Constraints | None = None,
    poses: ArrayLike | None = None,
    measured: Measurements | None = None,
    target: Target = "pose",
    curve: bool = False,
    candidates: int = 1000,
    seed: int = 1,
) -> Plan:
    """Plan the poses to measure.

    Parameters
    ----------
    robot : at the values that are believed now. instrument : what will measure there, with its
        noise.
    n_poses : number of poses for the fit. criterion : "I", the mean predicted variance of `target`
        over the workspace, or "D", the volume of uncertainty of the parameters.
    hold_out : number of further poses to judge by, drawn evenly; default a quarter of n_poses.
    constraints : margin from singularities, tilt, line of sight; strokes, joint limits and cones
        are always kept to.
    poses : (n, c) controlled coordinates that are allowed [m, rad]; default: about `candidates`
        from the workspace.
    measured : measurements made already, which count as known.
    target : what is to be predicted: "pose" (turns times the robot's size), "position" or
        "orientation".
    curve : also expected errors by the number of poses. seed : of all random choices.

    Returns
    -------
    Plan

    Raises
    ------
    EstimationError
        Fewer equations than unknowns, an unknown criterion, or a number that cannot be.
    MechanismError
        The constraints leave nothing of the workspace.
    """
    given = None if poses is None else np.atleast_2d(np.asarray(poses, dtype=float))
    made = problem(robot, instrument, constraints, given, measured, candidates, seed)
    return planned(
        made, n_poses, criterion, hold_out=hold_out, target=target, curve=curve, seed=seed
    )


def planned_for(
    made: Problem,
    goal: float,
    target: Target,
    criterion: str = "I",
    *,
    hold_out: int | None = None,
    seed: int = 1,
) -> Plan:
    """Plan the fewest poses found whose expected error reaches a goal.

    Parameters
    ----------
    made : of `problem`. goal : root mean square of `target` over the workspace [m, rad]; a pose's
        turns times the size.

    Raises
    ------
    EstimationError
        No number of poses reaches it; or as `plan`.
    """
    needed = poses_needed(made, goal, target, seed)
    assert needed.enough is not None  # a goal was given
    n, k = needed.enough, made.poses_in_unit
    # poses to judge by are taken from the candidates, and D is not what the goal counts: both can
    # cost some more poses
    for _ in range(MORE):
        found = planned(made, n * k, criterion, hold_out=hold_out, target=target, seed=seed)
        if found.expected.of(target, made.wanted.size) <= goal:
            return replace(found, curve=replace(needed, enough=n))
        n += max(n // 20, 1)
    raise EstimationError(
        f"{n} {counted(k)} chosen by criterion {criterion} do not reach the error that "
        f"{needed.enough} could; hold out fewer, "
        "or use criterion I"
    )


def planned(
    made: Problem,
    n_poses: int,
    criterion: str = "I",
    *,
    hold_out: int | None = None,
    target: Target = "pose",
    curve: bool = False,
    seed: int = 1,
) -> Plan:
    """Plan the poses of a problem that is ready; see `plan`."""
    k, held = made.poses_in_unit, _held_out(made, n_poses, hold_out)
    n = n_poses // k
    made.require_equations(n)
    wanted = made.criterion(criterion, target)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    kept_back = _drawn_to_judge(made, held // k, rng)
    rows = np.array(made.units.rows)
    rows[np.isin(made.units.members, made.units.members[kept_back]).any(axis=1)] = np.nan
    _require_candidates(rows, n, k)
    best = certified_design(rows, n, wanted, made.start, seed, SHAKES, gap=GAP)
    chosen = best.design.chosen
    expected = made.accuracy(chosen)
    assert expected is not None  # the exchange leaves no direction open
    visited, visit, units = _visited(made, np.concatenate([chosen, kept_back]))
    return Plan(
        robot=made.free.robot,
        instrument=made.instrument,
        coordinates=made.candidates.coordinates[visited],
        readings=_typed(made.free.robot, made.candidates.solution.q[visited]),
        held_out=np.isin(visited, made.units.members[kept_back]),
        via_home=visit.via_home,
        labels=_names(made, len(visited)),
        units=units,
        criterion=criterion,
        figures=_figures(made, rows[chosen], made.start, target),
        efficiency=min(best.efficiency, 1.0),
        expected=expected,
        before=made.accuracy(np.zeros(0, dtype=np.int64)),
        even=_even(made, n, wanted, target, rng),
        length=visit.length,
        seed=seed,
        notes=_notes(made),
        curve=pose_curve(made, n_poses, target, seed) if curve else None,
        target=target,
        considered=int(allowed(rows).sum()),
    )


def _held_out(made: Problem, n_poses: int, hold_out: int | None) -> int:
    """Return how many poses to hold out, after a look at both numbers."""
    k = made.poses_in_unit
    held = n_poses // HELD_OUT // k * k if hold_out is None else hold_out
    for words, number, least in (("to measure", n_poses, 1), ("to hold out", held, 0)):
        if number < least or number % k:
            compared = (
                f", in multiples of {k} because the instrument compares {k} poses" if k > 1 else ""
            )
            raise EstimationError(
                f"{number} poses {words} were asked for; ask for {least} or more{compared}"
            )
    return held


def _drawn_to_judge(made: Problem, count: int, rng: np.random.Generator) -> IntArray:
    """Return units (count,) to judge by: of poses drawn evenly, no pose in two of them."""
    even = np.flatnonzero(
        made.candidates.even[made.units.members].all(axis=1)
        & np.isfinite(made.units.rows).all(axis=(1, 2))
    )
    found: list[int] = []
    used: set[int] = set()
    for u in rng.permutation(even).tolist():
        if len(found) == count:
            break
        poses = made.units.members[u].tolist()
        if not used & set(poses):
            found.append(u)
            used.update(poses)
    if len(found) < count:
        raise EstimationError(
            f"{count} measurements to judge by were asked for, but the {len(made.candidates)} "
            f"allowed poses give {len(found)}; "
            "hold out fewer, or relax a constraint"
        )
    return np.array(found, dtype=np.int64)


def _require_candidates(rows: FloatArray, n: int, k: int) -> None:
    """Refuse more units of k poses than there are to choose from."""
    left = int(np.isfinite(rows).all(axis=(1, 2)).sum())
    if left < n:
        raise EstimationError(
            f"{n} {counted(k)} were asked for, but only {left} are left to choose from; ask for "
            "fewer, hold out fewer, or "
            "relax a constraint"
        )


def _visited(made: Problem, units: IntArray) -> tuple[IntArray, Visit, IntArray]:
    """Return the poses (m,) of units in the order of visiting, the visit, and the units (u, k) as
    rows of it.
    """
    members = made.units.members[units]
    poses = np.unique(members)
    visit = visiting_order(made.candidates.rules, made.candidates.coordinates[poses])
    visited = poses[visit.order]
    place = np.empty(len(made.candidates), dtype=np.int64)
    place[visited] = np.arange(len(visited))
    return visited, visit, place[members]


def _typed(robot: Mechanism, readings: FloatArray) -> FloatArray:
    """Round readings (m, a) to DIGITS in the robot's units, which a person can type and no
    instrument tells apart.
    """
    factors = np.array(
        [find_unit(robot.units[actuator.dimension]).factor_to_si for actuator in robot.actuators]
    )
    scale = np.array(
        [
            robot.size if actuator.dimension is Dimension.LENGTH else 1.0
            for actuator in robot.actuators
        ]
    )
    steps = 10.0 ** (np.floor(np.log10(scale / factors)) - DIGITS)
    # + 0: no reading is -0
    return np.round(readings / factors / steps) * steps * factors + 0.0


def _names(made: Problem, count: int) -> tuple[str, ...]:
    """Return names of poses: numbers, which go on behind the largest that was measured already."""
    numbers = [int(name) for name in made.taken if name.isdecimal()]
    return tuple(str(max(numbers, default=0) + i) for i in range(1, count + 1))


def _figures(made: Problem, rows: FloatArray, start: Start, target: Target) -> dict[str, float]:
    """Return D, I, A and E of a design."""
    factor, machine = design_factor(rows, start, made.space), made.space.machine
    criteria: tuple[Criterion, ...] = (made.criterion("D"), made.criterion("I", target), A(), E())
    return {c.name: evaluate(c, factor, machine) for c in criteria}


def _even(
    made: Problem, n: int, wanted: Criterion, target: Target, rng: np.random.Generator
) -> Accuracy | None:
    """Return the errors of the median, by I, of some sets of n units of evenly drawn poses; None
    where there are too few.
    """
    even = np.flatnonzero(
        made.candidates.even[made.units.members].all(axis=1)
        & np.isfinite(made.units.rows).all(axis=(1, 2))
    )
    if len(even) < n:
        return None
    by = wanted if isinstance(wanted, I) else made.criterion("I", target)
    sets = [rng.choice(even, n, replace=False) for _ in range(DRAWS)]
    values = [
        evaluate(
            by, design_factor(made.units.rows[chosen], made.start, made.space), made.space.machine
        )
        for chosen in sets
    ]
    return made.accuracy(sets[int(np.argsort(values)[DRAWS // 2])])


def _notes(made: Problem) -> tuple[str, ...]:
    """Say what was assumed and left out."""
    p, rank = len(made.free), int(made.seen.rank[0])
    notes = [made.candidates.sentence()]
    assumed = made.free.note()
    if assumed is not None:
        notes.append(f"{assumed}; in a plan these are not taken as known")
    if made.wanted.frames:
        one = len(made.wanted.frames) == 1
        lies = f"frame {made.wanted.frames[0]} lies" if one else "frames base and platform lie"
        notes.append(
            f"this instrument cannot tell how the {lies} as a whole; expected errors are in the "
            "frame that the calibration "
            "defines"
        )
    if rank < p:
        notes.append(
            f"{p - rank} of {p} parameter combinations cannot be told by this instrument at any "
            "pose; "
            f"`loopcal identifiability` names them"
        )
    return tuple(notes)
