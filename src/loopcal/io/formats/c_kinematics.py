# SPDX-License-Identifier: Apache-2.0
"""C99 kinematics of an identified robot, for a controller that computes with the complete model.

The tables are the engine's `Program` with links, rods and transmissions at the robot's values; the
algorithm in `kinematics.c` beside this file is the same for every robot. It closes all loops at
once by Newton's method, without allocation and with a bounded number of steps, from the last state.
Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from loopcal.engine.numpy_engine.closure import place_links
from loopcal.engine.program import BASE, LENGTH, PITCH
from loopcal.errors import DataError, MechanismError
from loopcal.findings import Finding, report_finding
from loopcal.io.formats.program_format import Exported, ExportSource, Format
from loopcal.mechanism.actuation import measure_sums
from loopcal.mechanism.chains import list_carrying_stages
from loopcal.mechanism.inverse import determine_platform, measure_spans, moves_by_drives
from loopcal.mechanism.model import Mechanism, Stage
from loopcal.mechanism.platform_coordinates import EULER, POSITION, TILT, read_coordinates
from loopcal.mechanism.solutions import Solution, inverse, jacobian
from loopcal.mechanism.transmission import (
    FIXED,
    HARMONICS,
    REFERENCE,
    SOURCE,
    TERMS,
    Transmissions,
    describe_triangle,
    make_spline,
)
from loopcal.mechanism.workspace import sample_workspace
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import SI_SYMBOLS
from loopcal.version import __version__

COORDINATES = (*POSITION, *TILT, *EULER)  # platform coordinates in the order of the C file
# Terms of a transmission in the order of the C file.
SHAPES = ("offset", "gain", "curve", *HARMONICS)
LINK = "LINK"
# Tables that are not constant in a file with parameters.
MOVABLE = ("double LINK", "struct limb", "double PITCH", "struct transmission")
TESTS, SEED = 50, 0
"""Poses of the test table, and the seed that draws them from the workspace."""
# Largest distance from home of poses of a robot without a workspace: of its size, and [rad].
NEAR = 0.02
# Largest difference of poses [m, 1] that the test in the file accepts, for a robot of a meter or
# less: it is the rounding of some hundred operations, times the amplification of the mechanism.
AGREEMENT = 1e-12
# Largest distance [m, rad] at which loopcal's iteration ends before coordinates, rounded up.
CLOSE = 1e-8


class _Joint(NamedTuple):
    """A joint of a limb: its drive, -1 for none, and its value at home [m, rad]."""

    drive: int
    is_passive: bool
    turns: bool
    pitch: float
    home: float


class _Limb(NamedTuple):
    """`struct limb` of the C file."""

    ending: str
    on: int
    to: int
    joints: int
    link: int
    joint: int
    rows: int
    row: list[int]
    driven: int
    is_alone: bool
    is_exact: bool
    length: float
    sigma: float


class _Transmission(NamedTuple):
    """`struct transmission` of the C file."""

    term: list[float]
    frequency: float
    fixed: float
    begin: float
    triangle: list[float]
    reading: int
    piece: int
    pieces: int


class _Tables(NamedTuple):
    """Tables of all stages, one after the other. weights : of the drives of a stage, and the first
    of these. slots : what each slot of the robot moves, by the number of the stage and the slot:
    table, index and axis; None for what the C file cannot change.
    """

    links: list[list[float]]
    joints: list[_Joint]
    limbs: list[_Limb]
    bodies: list[list[float]]
    moves: list[list[bool]]
    sums: list[_Transmission]
    weights: list[tuple[int, FloatArray]]
    pieces: list[list[float]]
    stages: list[list[Any]]
    nominal: list[list[float]]
    displacements: list[FloatArray]
    slots: list[list[tuple[str, int, int] | None]]


def write(source: ExportSource, into: Path | None) -> Exported:
    """Return the C file of a robot at its present conditions.

    DataError : the robot has more drives than freedoms, in limbs with passive joints.
    """
    return Exported(fill_template(source.robot, ()), note_lost_terms(source.robot, FORMAT.name))


def fill_template(robot: Mechanism, parameters: Sequence[int]) -> str:
    """Return the C file of a robot, in which some parameters, by their places, can change."""
    commanded = robot.is_commanded
    head, body = _write_tables(robot, commanded, parameters)
    text = files("loopcal.io.formats").joinpath("kinematics.c").read_text("utf-8")
    for mark, part in (("HEAD", head), ("TABLES", body), ("TESTS", _write_tests(robot, commanded))):
        text = text.replace(f"/* {mark} */", part)
    return text


def note_lost_terms(robot: Mechanism, name: str) -> tuple[Finding, ...]:
    """Return a finding about terms of drives that a C file has no inputs for: backlash depends on
    the direction of approach, compliance on the load.
    """
    lost = []
    for stage in robot.blocks:
        _, drives = stage.robot.slots(robot.values[None, stage.parameters])
        names = [actuator.name for actuator in robot.actuators[stage.actuators]]
        for row, terms in zip(drives.constants, drives.tau[0], strict=True):
            own = (term for term, value in zip(TERMS, terms, strict=False) if value)
            if row[SOURCE] >= 0:
                lost += [f"{names[int(row[SOURCE])]}.{t}" for t in own if t not in SHAPES]
    return (report_finding("files.not-expressed", format=name, names=tuple(lost)),) if lost else ()


def list_movable(robot: Mechanism) -> list[int]:
    """Return the places of the parameters that a C file can change: they move links, lengths and
    terms of transmissions, each by a fixed factor.
    """
    tables = _collect_tables(robot, np.ones(len(robot.actuators), bool))
    return [p for p in range(len(robot.values)) if _list_effects(robot, tables, p)]


def _list_effects(
    robot: Mechanism, tables: _Tables, parameter: int
) -> list[tuple[str, int, int, float]]:
    """Return what a parameter moves, with factors; nothing where a part cannot be changed."""
    effects = []
    for stage, moved in zip(robot.blocks, tables.slots, strict=True):
        column = parameter - stage.parameters.start
        slots = stage.robot.slots
        if not 0 <= column < slots.matrix.shape[1]:
            continue
        if any(column in inputs for _, inputs, _ in slots.shared):
            return []
        for row in np.flatnonzero(slots.matrix[:, column]).tolist():
            if (what := moved[row]) is None:
                return []
            effects.append((*what, float(slots.matrix[row, column])))
    return effects


def _write_parameters(robot: Mechanism, tables: _Tables, parameters: Sequence[int]) -> list[str]:
    """Return the tables of the parameters that can change."""
    effects = [
        (i, *effect) for i, p in enumerate(parameters) for effect in _list_effects(robot, tables, p)
    ]
    links = sorted({index for _, what, index, *_ in effects if what == LINK})
    numbers = sorted({effect[1:4] for effect in effects if effect[1] != LINK})
    identified = {
        "PITCH_OF_JOINT": lambda i, _: tables.joints[i].pitch,
        "LENGTH_OF_LIMB": lambda i, _: tables.limbs[i].length,
        "TERM_OF_SUM": lambda i, term: tables.sums[i].term[term],
    }
    rows = [
        [i, links.index(index), axis, factor]
        if what == LINK
        else [i, numbers.index((what, index, axis)), -1, factor]
        for i, what, index, axis, factor in effects
    ]
    moved = [[i, tables.nominal[i], tables.displacements[i].tolist()] for i in links]
    own = [[*number, identified[number[0]](*number[1:])] for number in numbers]
    none = [[0] * 4]  # C has no empty tables
    return [
        f"#define LINKS {len(tables.links)}",
        f"#define MOVED_LINKS {len(links)}",
        f"#define MOVED_NUMBERS {len(numbers)}",
        f"#define EFFECTS {len(rows)}",
        _table("double IDENTIFIED[KINEMATICS_PARAMETERS]", robot.values[list(parameters)].tolist()),
        _table("struct moved_link MOVED_LINK[]", moved or [[0, [0.0] * 12, [0.0] * 6]]),
        _table("struct moved_number MOVED_NUMBER[]", own or [["TERM_OF_SUM", 0, 0, 0.0]]),
        _table("struct effect EFFECT[]", rows or none),
    ]


def _collect_tables(robot: Mechanism, commanded: BoolArray) -> _Tables:
    """Return the tables of all stages."""
    tables, drives, carrying = _Tables(*([] for _ in _Tables._fields)), 0, set[int]()
    carrying.update(list_carrying_stages(robot))
    reading = np.where(commanded, np.cumsum(commanded) - 1, -1)
    for i, stage in enumerate(robot.blocks):
        mount = _flatten(stage.mount)
        tables.stages.append([stage.parent, len(tables.bodies), i in carrying, mount])
        e, transmissions = stage.robot.slots(robot.values[None, stage.parameters])
        _add_limbs(tables, stage.robot, e, drives)
        _add_transmissions(tables, stage, transmissions, reading[stage.actuators].tolist(), drives)
        drives += stage.robot.program.n_joints
    return tables


def _write_tables(
    robot: Mechanism, commanded: BoolArray, parameters: Sequence[int]
) -> tuple[str, str]:
    """Return the public constants and the tables."""
    tables = _collect_tables(robot, commanded)
    drives = sum(stage.robot.program.n_joints for stage in robot.blocks)
    weights = np.zeros((len(tables.sums), drives))
    for row, (first, own) in zip(weights, tables.weights, strict=True):
        row[first : first + len(own)] = own
    joints = tables.joints
    of_drive = [next(i for i, j in enumerate(joints) if j.drive == d) for d in range(drives)]
    names = robot.controlled
    robots = [stage.robot for stage in robot.blocks]
    programs = [own.program for own in robots]
    stays_open = any(own.program.may_stay_open and not own.has_redundant_sums for own in robots)
    trust, ends = np.ones(len(weights)), np.cumsum([len(own.assembly.rows) for own in robots])
    for own, end, last in zip(robots, ends, np.cumsum([p.n_joints for p in programs]), strict=True):
        if own.has_redundant_sums:
            rows = slice(end - len(own.assembly.rows), end)
            columns = slice(last - own.program.n_joints, last)
            trust[rows] = measure_sums(own, weights[None, rows, columns])
    is_given = len(robot.blocks) == 1 and determine_platform(robot) and not moves_by_drives(robot)
    is_given &= not stays_open
    closure, fixed = (
        sum(limb.rows for limb in tables.limbs),
        sum(s.reading < 0 for s in tables.sums),
    )
    unknown = np.sum(tables.moves) + sum(joint.is_passive for joint in joints) + drives
    has_spare = not is_given and closure + fixed + len(names) < unknown
    spans = np.ones(drives)
    if has_spare:
        spans = measure_spans(robot, np.array([joints[i].turns for i in of_drive]))
    head = {
        "READINGS": commanded.sum(),
        "COORDINATES": len(names),
        "BODIES": len(tables.bodies),
        "JOINTS": len(joints),
        "PARAMETERS": len(parameters),
    }
    constants = {
        "STAGES": len(tables.stages),
        "LIMBS": len(tables.limbs),
        "DRIVES": drives,
        "SUMS": len(tables.sums),
        "CLOSURE_ROWS": closure,
        "COLUMNS": unknown,
        "MOST_JOINTS": max(limb.joints for limb in tables.limbs),
        "PIECES": len(tables.pieces),
        "TRIANGLES": any(any(s.triangle) for s in tables.sums),
        "HAS_SUMS": any(stage.robot.has_sums for stage in robot.blocks),
        "HAS_SPARE_DRIVES": has_spare,
        "STAYS_OPEN": stays_open,
        "MAY_STAY_OPEN": any(p.may_stay_open or p.sigma is not None for p in programs),
        "PLATFORM_IS_GIVEN": is_given,
        "PLACE_OF_PHI": names.index("phi") if "phi" in names else 0,
        "PLACE_OF_THETA": names.index("theta") if "theta" in names else 0,
        "SIZE": robot.size,
    }
    home = [tables.bodies, [joint.home for joint in joints], 0, 0]
    parts = [
        *(f"#define {name} {_write(value)}" for name, value in constants.items()),
        _table("int COORDINATE[KINEMATICS_COORDINATES]", map(COORDINATES.index, names)),
        _table(f"double LINK[{len(tables.links)}][12]", tables.links),
        _table("struct limb LIMB[LIMBS]", tables.limbs),
        _table("int MOVES[BODIES][6]", tables.moves),
        _table("int DRIVE[JOINTS]", (joint.drive for joint in joints)),
        _table("int PASSIVE[JOINTS]", (joint.is_passive for joint in joints)),
        _table("int TURNS[JOINTS]", (joint.turns for joint in joints)),
        _table("double PITCH[JOINTS]", (joint.pitch for joint in joints)),
        _table("int JOINT_OF_DRIVE[DRIVES]", of_drive),
        _table("double SPAN[DRIVES]", spans),
        _table("double WEIGHT[SUMS][DRIVES]", weights),
        _table("double TRUST[SUMS]", trust),
        _table("struct transmission TRANSMISSION[SUMS]", tables.sums),
        _table("struct stage STAGE[STAGES]", tables.stages),
        _table("kinematics_state HOME", home),
    ]
    if parameters:
        parts += _write_parameters(robot, tables, parameters)
    if tables.pieces:
        parts.append(_table("double PIECE[PIECES][6]", tables.pieces))
    lines = [*_describe(robot, commanded), ""]
    lines += [f"#define KINEMATICS_{name} {_write(value)}" for name, value in head.items()]
    return "\n".join(lines), "\n".join(parts)


def _describe(robot: Mechanism, commanded: BoolArray) -> list[str]:
    """Return the comment at the head of the file."""
    units = [SI_SYMBOLS[actuator.dimension] for actuator in robot.actuators]
    names = [f"{a.name} [{unit}]" for a, unit in zip(robot.actuators, units, strict=True)]
    at = [
        f"{a.name} = {a.reference:g} {unit}"
        for a, unit in zip(robot.actuators, units, strict=True)
        if a.reference is not None
    ]
    read = [name for name, is_read in zip(names, commanded, strict=True) if is_read]
    lines = [
        f"Kinematics of {robot.name}, written by loopcal {__version__}.",
        f"Readings: {', '.join(read)}.",
        f"Coordinates: {', '.join(robot.controlled)}.",
        *([f"It holds at {', '.join(at)}."] if at else []),
    ]
    safe = [line.replace("*/", "* /").replace("/*", "/ *") for line in lines]
    return ["/* " + "\n * ".join(safe) + " */"]


def _write(value: Any) -> str:
    """Return a value as a C initializer; numbers read back as the same doubles."""
    if isinstance(value, str):
        return value
    if isinstance(value, (bool, np.bool_, int, np.integer)):
        return str(int(value))
    if isinstance(value, (float, np.floating)):
        text = repr(float(value) + 0.0)  # without a negative zero
        return text if "." in text or "e" in text else f"{text}.0"
    return "{" + ", ".join(map(_write, value)) + "}"


def _table(declaration: str, rows: Iterable[Any]) -> str:
    """Return a constant table, a line for each row of more than one number."""
    rows = list(rows)
    storage = "TABLE" if declaration.startswith(MOVABLE) else "static const"
    if not rows or isinstance(rows[0], (bool, int, float, np.number, np.bool_)):
        return f"{storage} {declaration} = {_write(rows)};"
    lines = "".join(f"    {_write(row)},\n" for row in rows)
    return f"{storage} {declaration} = {{\n{lines}}};"


def _flatten(T: FloatArray) -> list[float]:
    """Return a pose (4, 4) as its rotation by rows, then its position."""
    return [*T[:3, :3].ravel().tolist(), *T[:3, 3].tolist()]


def _add_limbs(tables: _Tables, robot: Mechanism, e: FloatArray, drives: int) -> None:
    """Add bodies and limbs of a stage with displacements e (1, d); `drives` are those before."""
    program, home, first = robot.program, robot.home_state, len(tables.bodies)
    moved: list[tuple[str, int, int] | None] = [None] * len(robot.slots.matrix)
    tables.slots.append(moved)
    tables.bodies.extend(_flatten(T[0, 0]) for T in (home.T, *home.others))
    tables.moves.extend([f in freedoms for f in range(6)] for freedoms in program.nodes)
    for group, joints in zip(program.groups, home.joints, strict=True):
        placed, count = place_links(group, e), len(group.joints)
        passive, driven = group.unknown_joints(free=False), group.driven_joints
        if program.sigma is not None and (passive or len(group.rows) > 1 or len(driven) != 1):
            raise DataError.of("files.c-redundant", robot=robot.name)
        # a ball has positions only
        row = [r + (3 if group.ending == "ball" else 0) for r in group.rows]
        for k in range(len(group.limbs)):
            link, joint = len(tables.links), len(tables.joints)
            for j in range(count + 2):
                rotation = placed.rotation[j][..., min(k, placed.rotation.shape[3] - 1), 0]
                tables.links.append([*rotation.ravel().tolist(), *placed.origin[j, :, k, 0]])
                tables.nominal.append(_flatten(group.links[k, j]))
                tables.displacements.append(np.zeros(6))
            for i, slot in enumerate(group.slots):
                place = group.columns.start + k * len(group.slots) + i
                if slot.axis == PITCH:
                    moved[place] = ("PITCH_OF_JOINT", joint + slot.element, 0)
                elif slot.axis == LENGTH:
                    moved[place] = ("LENGTH_OF_LIMB", len(tables.limbs), 0)
                else:
                    moved[place] = (LINK, link + slot.element, slot.axis)
                    tables.displacements[link + slot.element][slot.axis] += e[0, place]
            for j, letter in enumerate(f"{group.joints}P"):
                actuator = int(group.actuator[j, k])
                drive = -1 if actuator < 0 else drives + actuator
                pitch = float(placed.pitch[j, k, 0]) if j < count else 0.0
                value = float(joints[0, 0, k, j])
                tables.joints.append(_Joint(drive, j in passive, letter == "R", pitch, value))
            on, to = (i if i == BASE else first + i for i in (group.on[k], group.to[k]))
            sigma = 0.0 if program.sigma is None else program.sigma[group.actuator[driven[0], k]]
            head = (group.ending.upper(), on, to, count, link, joint, len(row))
            rows, length = [*row, *[0] * (6 - len(row))], float(placed.length[k, 0])
            is_exact = not program.may_stay_open and program.sigma is None
            last = (driven[0] if driven else 0, robot.is_serial, is_exact, length, sigma)
            tables.limbs.append(_Limb(*head, rows, *last))


def _add_transmissions(
    tables: _Tables, stage: Stage, own: Transmissions, readings: list[int], drives: int
) -> None:
    """Add the rows of a stage, and where its readings are, -1 for those never commanded."""
    tau, references, weights = own.tau, own.evaluate_references()[0, 0], own.weights
    for a, row in enumerate(own.constants):
        source, points = int(row[SOURCE]), row[FIXED:][np.isfinite(row[FIXED:])]
        is_fixed = source < 0 or bool(np.isfinite(row[REFERENCE]))
        for i, name in enumerate(() if is_fixed else SHAPES):
            place = stage.robot.slots.n_displacements + a * tau.shape[2] + TERMS.index(name)
            tables.slots[-1][place] = ("TERM_OF_SUM", len(tables.sums), i)
        pieces: list[list[float]] = []
        if len(points):
            values = own.table[0, a, : len(points)]
            c = make_spline(points.tobytes(), bool(row[1])).c @ values  # (powers, pieces)
            c = np.concatenate([np.zeros((4 - len(c), c.shape[1])), c])
            ends = zip(points[:-1].tolist(), points[1:].tolist(), c.T.tolist(), strict=True)
            pieces = [[low, high, *powers] for low, high, powers in ends]
        triangle = [0.0] * 5
        if a in own.triangles:
            terms = own.list_triangle_terms(a)[0, 0]
            triangle = [*map(float, describe_triangle(terms)), *terms[-2:].tolist()]
        tables.sums.append(
            _Transmission(
                [float(tau[0, a, TERMS.index(name)]) for name in SHAPES],
                float(row[0]),
                float(references[a]) if is_fixed else 0.0,
                float(points.mean()) if len(points) else 0.0,
                triangle,
                -1 if is_fixed else readings[source],
                len(tables.pieces),
                len(pieces),
            )
        )
        tables.pieces.extend(pieces)
        of_joints = np.eye(len(own.constants))[a] if weights is None else weights[0, a]
        tables.weights.append((drives, of_joints))


def _draw_poses(robot: Mechanism) -> tuple[FloatArray, Solution]:
    """Return coordinates (n, c) of the workspace, and their solution; where it is not stated or not
    reached those of home and of what is reached around it.

    MechanismError : not even home is reached.
    """
    try:
        sample = sample_workspace(robot, TESTS, SEED)
        return sample.coordinates, sample.solution
    except MechanismError as error:
        is_length = np.isin(robot.controlled, POSITION)
        span = np.where(is_length, NEAR * robot.size, NEAR)
        home = read_coordinates(robot.home_state.T[0, :1], robot.controlled)
        shares = np.random.default_rng(SEED).uniform(-1.0, 1.0, (TESTS, home.shape[1]))
        shares[0] = 0.0
        near = home + span * shares
        solution = inverse(robot, near)
        if not solution.converged.any():
            raise error
        return near[solution.converged], solution.take(solution.converged)


def _choose_agreement(robot: Mechanism) -> float:
    """Return the largest accepted difference of derivatives, of the largest one: rounding; where
    loops stay open that of differences; with open sums loopcal neglects gaps over the size.
    """
    stages = [own for s in robot.blocks for own in [s.robot] if not own.has_redundant_sums]
    if any(stage.program.may_stay_open and stage.has_open_sums for stage in stages):
        return 1e-2
    return 1e-6 if any(stage.program.may_stay_open for stage in stages) else 1e-9


def _write_tests(robot: Mechanism, commanded: BoolArray) -> str:
    """Return poses with their coordinates, readings and derivatives."""
    coordinates, solution = _draw_poses(robot)
    slopes = jacobian(robot, solution.q, solution)
    poses = slopes.solution.T
    gap = read_coordinates(poses, robot.controlled) - coordinates
    coordinates += np.where(np.abs(gap) < CLOSE, gap, 0.0)  # those of the readings, to rounding
    parts = [
        f"#define TESTS {len(poses)}",
        f"#define AGREEMENT {_write(AGREEMENT * max(1.0, robot.size))}",
        f"#define AGREEMENT_OF_SLOPES {_choose_agreement(robot)!r}",
        _table("double TEST_COORDINATES[TESTS][KINEMATICS_COORDINATES]", coordinates),
        _table("double TEST_READINGS[TESTS][KINEMATICS_READINGS]", solution.q[:, commanded]),
        _table("double TEST_POSES[TESTS][12]", map(_flatten, poses)),
        _table(
            "double TEST_SLOPES[TESTS][6][KINEMATICS_READINGS]", slopes.readings[..., commanded]
        ),
    ]
    return "\n".join(parts)


FORMAT = Format("c", "kinematics of the identified robot in C99", (".c",), None, write, False)
