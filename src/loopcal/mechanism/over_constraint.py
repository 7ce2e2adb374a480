# SPDX-License-Identifier: Apache-2.0
"""Over-constrained machines: which closure equations repeat others, and what would break them.

With every actuator free, linearized closure reads A y + Q dq = 0. Combinations w of its rows with
w'A = 0 and w'Q = 0 are equations that repeat others. In statics w is a force that the limbs exert
on each other through the platform while the actuators are free (self-stress); limb k exerts the
wrench A_k'w_k. A change of a parameter that changes w'E de opens the loops by this much: no pose
and no reading can close them again. Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from loopcal.engine import State
from loopcal.errors import MechanismError
from loopcal.findings import Finding, report_finding
from loopcal.mechanism import limb_rows
from loopcal.mechanism.assembly import AXES, Assembly
from loopcal.mechanism.kinematics import compute_readings, forward_trials
from loopcal.mechanism.mobility import RANK, check_assembly
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.states import Status, join_states, select_poses
from loopcal.numerics.decomposition import find_null_space
from loopcal.typing import BoolArray, FloatArray, IntArray

# Largest component, relative to the whole, by which a vector may differ from a named direction, or
# from the equations of other limbs, and still count as one of them.
SAME = 1e-6
BREAKS = 1e-7
"""Share of a parameter's effect on the equations above which it opens the loops.

Rounding is below 1e-11.
"""
NEARBY, DISTANCE = 4, 0.03
"""Number of poses near home that are examined with it, and the change of their driven joints: a
share of the robot's size, or this many radians. Home alone may be a special position.
"""


class _Rows(NamedTuple):
    """The closure equations at one pose with the passive joints eliminated.

    A : (c, M) by the freedoms of all nodes, rotations over the robot's size. both : (c, M + J) by
    these, then driven joints. E : (c, p) by parameters. limb : (c,) the limb of each equation.
    absorbed : (j, p) by parameters, the equations that determine the j passive joints.
    """

    A: FloatArray
    both: FloatArray
    E: FloatArray
    limb: IntArray
    absorbed: FloatArray

    def find_repeated(self, limbs: int | None = None) -> FloatArray:
        """Return orthonormal combinations (r, c) of the rows that repeat others, of all limbs or of
        so many first ones.
        """
        own = self.limb < (self.limb.max() + 1 if limbs is None else limbs)
        repeated = find_null_space(self.both[own].T, RANK)
        out = np.zeros((repeated.shape[1], len(own)))
        out[:, own] = repeated.T
        return out

    def constrain(self, limb: int) -> FloatArray:
        """Return an orthonormal basis (r, M) of what a limb constrains with its drives free."""
        own = self.limb == limb
        undriven = find_null_space(self.both[own, self.A.shape[1] :].T, RANK)
        return _find_basis(undriven.T @ self.A[own])


def _find_basis(vectors: FloatArray) -> FloatArray:
    """Return an orthonormal basis (r, m) of vectors (k, m) whose size is about 1 or 0."""
    _, s, V = np.linalg.svd(vectors, full_matrices=False)
    return V[: int((s > SAME * s.max(initial=1.0)).sum())]


def _linearize(robot: Mechanism, state: State) -> list[_Rows]:
    """Return the equations at the poses of a state (1, n), at the nominal values."""
    program, nominal = robot.program, robot.parameters.nominal[None]
    blocks = limb_rows.linearize_state(robot, state, nominal)
    slopes = limb_rows.differentiate_displacements(robot, nominal)
    both, M = limb_rows.stack_scaled_rows(robot, blocks)[0], len(program.unknown_twists)
    _, (E,), limb = limb_rows.stack_limb_rows(program, blocks, slopes)
    _, (absorbed,), _ = limb_rows.stack_limb_rows(program, blocks, slopes, passive=True)
    return [_Rows(own[:, :M], own, E[i], limb, absorbed[i]) for i, own in enumerate(both)]


def report_over_constraint(
    robot: Mechanism, close_at_home: Callable[[Assembly], Mechanism]
) -> Mechanism:
    """Return the robot with a finding of its closure equations that repeat others, if any do, and
    with loops that may stay open where its file asks for the least-squares closure.
    """
    asks = robot.assembly.closure == "least-squares"
    rows = _linearize(robot, robot.home_state)[0]
    count = len(rows.find_repeated())
    if not count:
        without = (report_finding("mechanism.closure-without-effect"),) if asks else ()
        return replace(robot, findings=(*robot.findings, *without))
    finding = report_finding(
        "mechanism.repeated-equations",
        count=count,
        tolerance=RANK,
        closes=asks,
        repeated=_list_repeated(robot, rows),
        freedoms=_find_sufficient_freedoms(robot, close_at_home),
    )
    program = replace(robot.program, may_stay_open=asks or robot.program.may_stay_open)
    return replace(robot, program=program, findings=(*robot.findings, finding))


def _list_repeated(robot: Mechanism, rows: _Rows) -> tuple[dict[str, Any], ...]:
    """Return, for each limb that repeats limbs before it in the file, the directions by limbs."""
    names, out = [limb.name for limb in robot.assembly.limbs], []
    for last in range(len(names)):
        stresses = rows.find_repeated(last + 1)[:, rows.limb == last]
        wrenches = _find_basis(stresses @ rows.A[rows.limb == last])
        by_others: dict[tuple[str, ...], list[dict[str, Any]]] = {}
        for wrench, direction in _name_directions(wrenches, _list_columns(robot, last)):
            others = tuple(names[i] for i in _find_others(rows, last, wrench))
            by_others.setdefault(others, []).append(direction)
        out += [
            {"limb": names[last], "others": others, "directions": tuple(directions)}
            for others, directions in by_others.items()
        ]
    return tuple(out)


def _find_others(rows: _Rows, last: int, wrench: FloatArray) -> list[int]:
    """Return limbs before `last` that together constrain a direction: the first that does alone,
    else a set from which none can be left out.
    """

    def is_constrained(limbs: list[int]) -> bool:
        basis = _find_basis(np.concatenate([rows.constrain(i) for i in limbs]))
        return float(np.linalg.norm(wrench - basis.T @ (basis @ wrench))) < SAME

    for limb in range(last):
        if is_constrained([limb]):
            return [limb]
    needed = list(range(last))
    for limb in range(last):
        rest = [i for i in needed if i != limb]
        if rest and is_constrained(rest):
            needed = rest
    return needed


def _name_directions(
    wrenches: FloatArray, columns: Mapping[int, int]
) -> list[tuple[FloatArray, dict[str, Any]]]:
    """Return a basis of the wrenches (r, M), each (M,) with the direction that it constrains, as
    the catalog words it: a rotation without force, else the translation along the force. Axes of
    the base first.

    columns : freedom -> column, of the body on which the wrenches are named.
    """
    whole = np.zeros((len(wrenches), 6))
    whole[:, list(columns)] = wrenches[:, list(columns.values())]
    _, s, V = np.linalg.svd(whole[:, 3:].T, full_matrices=True)
    whole = np.concatenate([whole, wrenches], axis=1)
    forces = int((s > SAME).sum())
    couples = V[forces:] @ whole
    moving = V[:forces] @ whole
    named = [(couples, slice(0, 3), True), (moving, slice(3, 6), False)]
    out = []
    for basis, part, turns in reversed(named):
        for axis in _choose_axes(basis[:, part]):
            weights = np.linalg.lstsq(basis[:, part].T, axis, rcond=None)[0]
            wrench = weights @ basis
            unit = wrench[6:] / np.linalg.norm(wrench[:6])
            size = np.abs(axis)
            name = "xyz"[int(size.argmax())] if size.max() > 1 - SAME else ""
            vector = () if name else tuple(round(float(v), 3) + 0.0 for v in axis)
            out.append((unit, {"turns": turns, "name": name, "vector": vector}))
    return out


def _list_columns(robot: Mechanism, limb: int) -> dict[int, int]:
    """Return freedom -> column of A, of the body on which a limb ends, or begins where that one has
    more freedoms.
    """
    ((group, k),) = ((g, g.limbs.index(limb)) for g in robot.program.groups if limb in g.limbs)
    twists = list(enumerate(robot.program.unknown_twists))
    bodies = ({f: i for i, (node, f) in twists if node == b} for b in (group.to[k], group.on[k]))
    return max(bodies, key=len)


def _choose_axes(vectors: FloatArray) -> FloatArray:
    """Return orthonormal vectors that span the same space as vectors (r, 3): axes of the base that
    it contains, then others, whose largest component is positive.
    """
    basis = _find_basis(vectors)
    chosen = [axis for axis in np.eye(3) if np.linalg.norm(axis - basis.T @ (basis @ axis)) < SAME]
    known = np.reshape(chosen, (-1, 3))
    chosen += list(_find_basis(basis - basis @ known.T @ known))
    signed = [axis * np.sign(axis[np.abs(axis).argmax()]) for axis in chosen]
    return np.array(signed).reshape(-1, 3)


def _find_sufficient_freedoms(
    robot: Mechanism, close_at_home: Callable[[Assembly], Mechanism]
) -> tuple[str, ...]:
    """Return the most freedoms with which no equation repeats another; none where there are none.
    Those in which the platform moves, home and near it, are among them.
    """
    freedoms = robot.program.freedoms
    used, columns = set[int](), np.array([f for _, f in robot.program.unknown_twists])
    for rows in _linearize(robot, find_nearby_states(robot)):
        motions = find_null_space(rows.both, RANK)[: rows.A.shape[1]]
        largest = np.abs(motions).max(axis=1, initial=0.0)
        used.update(columns[largest > SAME * largest.max(initial=1e-300)].tolist())
    still = [i for i, f in enumerate(freedoms) if f not in used]
    for left_out in range(1, len(still) + 1):
        for dropped in combinations(still, left_out):
            names = tuple(AXES[f] for i, f in enumerate(freedoms) if i not in dropped)
            narrow = replace(robot.assembly, freedoms=names, closure="exact")
            with suppress(MechanismError):
                check_assembly(narrow)
                flat = close_at_home(narrow)
                if not len(_linearize(flat, flat.home_state)[0].find_repeated()):
                    return names
    return ()


def find_self_stress(robot: Mechanism) -> FloatArray:
    """Return wrenches (r, limbs, m) that limbs exert in r self-stresses at home, by the freedoms of
    the body on which they end with rotations over the robot's size.
    """
    rows = _linearize(robot, robot.home_state)[0]
    stresses, own = rows.find_repeated(), []
    for i in range(len(robot.assembly.limbs)):
        columns = list(_list_columns(robot, i).values())
        own.append(stresses[:, rows.limb == i] @ rows.A[rows.limb == i][:, columns])
    return np.stack(own, axis=1)


def find_nearby_states(robot: Mechanism) -> State:
    """Return home and closed poses near it (1, n), at the nominal values."""
    home, rng = robot.home_state, np.random.default_rng(0)
    nominal = robot.parameters.nominal[None]
    q = compute_readings(robot, nominal, home)
    turns = robot.assembly.turning_drives
    unit = np.array([1.0 if a.name in turns else robot.size for a in robot.actuators])
    shifts = DISTANCE * unit * rng.uniform(-1.0, 1.0, (NEARBY, len(unit)))
    near = forward_trials(robot, nominal, q + shifts[None], follow=False)
    return join_states(home, select_poses(near, near.status[0] == Status.CONVERGED.value))


def find_over_constraint(robot: Mechanism) -> Finding | None:
    """Return the finding of closure equations that repeat others, None where none does."""
    code = "mechanism.repeated-equations"
    return next((finding for finding in robot.findings if finding.code == code), None)


def is_over_constrained(robot: Mechanism) -> bool:
    """Return whether closure equations repeat others, so that only exact geometry closes."""
    return find_over_constraint(robot) is not None


def refuse_breaking_parameters(robot: Mechanism, drawn: bool = False) -> None:
    """Refuse free parameters that open the loops of an over-constrained robot; if errors are drawn,
    those with a spread.
    """
    names, finding = find_breaking_parameters(robot), find_over_constraint(robot)
    code = "mechanism.free-parameters-open-loops"
    if drawn:
        code, known = "mechanism.drawn-errors-open-loops", robot.parameters.entries
        names = tuple(p.name for p in known if p.tolerance and p.name in names)
    if names:
        assert finding is not None
        repeated = finding.data["repeated"]
        raise MechanismError.of(code, name=robot.name, names=names, repeated=repeated)


def find_breaking_parameters(robot: Mechanism) -> tuple[str, ...]:
    """Return the free parameters any change of which opens the loops."""
    names, free = robot.parameters.names, robot.parameters.free
    return tuple(names[i] for i in np.flatnonzero(_detect_breaking(robot) & free))


def fix_breaking_parameters(robot: Mechanism) -> Mechanism:
    """Return the robot without the free parameters any change of which opens the loops."""
    breaking = set(find_breaking_parameters(robot))
    if not breaking:
        return robot
    kept = [p.name for p in robot.parameters.entries if p.free and p.name not in breaking]
    return replace(robot, parameters=robot.parameters.with_free(kept))


def _detect_breaking(robot: Mechanism) -> BoolArray:
    """Return which parameters (p,) open the loops: w'E de/dp is not zero beside E de/dp for the
    repeated equations w, at the poses of `find_nearby_states`.
    """
    breaks = np.zeros(len(robot.parameters), bool)
    for stage in robot.stages:
        breaks[stage.parameters] = _detect_breaking(stage.robot)
    if robot.stages or robot.program.may_stay_open or not is_over_constrained(robot):
        return breaks
    for rows in _linearize(robot, find_nearby_states(robot)):
        opened = np.linalg.norm(rows.find_repeated() @ rows.E, axis=0)
        effect = np.linalg.norm(np.concatenate([rows.E, rows.absorbed]), axis=0)
        breaks |= opened > BREAKS * effect
    return breaks
