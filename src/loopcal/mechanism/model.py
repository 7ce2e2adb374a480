# SPDX-License-Identifier: Apache-2.0
"""The compiled mechanism: its structure, its parameters and their maps onto displacements."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from loopcal.engine import MapPattern, ParameterMap, Program, State
from loopcal.errors import MechanismError, suggest_names
from loopcal.findings import Finding, Quantity
from loopcal.mechanism.assembly import FORCES, Actuator, Assembly, SharedMap, is_serial
from loopcal.mechanism.transmission import (
    LOAD,
    LOADED,
    REFERENCE,
    SOURCE,
    Transmissions,
    invert_weights,
)
from loopcal.parameters import ParameterTable
from loopcal.results.description import Field, label_axes
from loopcal.results.result import DrawnResult
from loopcal.results.tables import to_quantity
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension, Unit, find_unit


class MovedSlots(NamedTuple):
    """Slots (z,) of a mechanism that some parameters move, and by which of them (columns).

    A term of a summed drive is there once for each joint. terms : numbers of the transmission terms
    among them. pattern : the same as the engine knows it; displacements are the first slots.
    """

    slots: IntArray
    columns: IntArray
    terms: tuple[int, ...]
    pattern: MapPattern


@dataclass(frozen=True, eq=False)
class ParameterUnits:
    """Parameters at places (p,) of a table, each with the unit (p,) [SI] of its column."""

    slots: SlotMap
    places: IntArray
    units: FloatArray

    def linearize(self, values: FloatArray, drives: Transmissions, q: FloatArray) -> ParameterMap:
        """Return how these parameters and the readings move displacements and joint values.

        values : (t | 1, all). drives : theirs. q : (t | 1, n, a) readings.
        """
        slots, pattern = self.slots, self.slots.moved_by(self.places).pattern
        cut = len(pattern.displacements)
        slopes = self._constant
        if slots.shared:
            of_slots, of_columns, units = self._entries
            slopes = slots.jacobian(values)[:, of_slots, of_columns] * units
        # with summed drives one for each joint, so that derivatives by readings are those by joints
        by_readings = (
            drives.differentiate(q)
            if (weights := drives.weights) is None
            else np.ones((1, 1, weights.shape[-1]))
        )
        return ParameterMap(
            pattern, slopes[:, :cut], slopes[:, cut:], self._evaluate_terms(q, drives), by_readings
        )

    def _evaluate_terms(self, q: FloatArray, drives: Transmissions) -> FloatArray:
        """Return what the moved transmission terms contribute, (t | 1, n | 1, a, terms)."""
        terms = self.slots.moved_by(self.places).terms
        if (weights := drives.weights) is not None:
            actuators, numbers = np.divmod(np.array(terms, np.int64), drives.tau.shape[-1])
            slopes = drives.differentiate_sums(q, drives.find_joints(q))
            inverse = invert_weights(weights)[:, None][..., actuators]
            return inverse * slopes[:, :, None, actuators, numbers]
        has_offsets_only = not any(terms) and not len(drives.triangles)
        if not terms or has_offsets_only:
            # offsets are the same for all poses
            return np.ones((1, 1, len(drives.constants), len(terms)))
        return np.stack(drives.differentiate_terms(q, terms), axis=-1)

    def select(self, by_all: FloatArray) -> FloatArray:
        """Return derivatives (.., p + a) by these parameters and what follows, of those by all
        parameters in SI.
        """
        rest = by_all[..., len(self.slots.nominal) :]
        return np.concatenate([by_all[..., self.places] * self.units, rest], axis=-1)

    @cached_property
    def _entries(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Slots that may move, by which column of all parameters, and its unit, (z,) each."""
        moved = self.slots.moved_by(self.places)
        return moved.slots, self.places[moved.columns], self.units[moved.columns]

    @cached_property
    def _constant(self) -> FloatArray:
        """Derivatives (1, z) of slots without shared maps."""
        slot, column, unit = self._entries
        return (self.slots.matrix[slot, column] * unit)[None]


SHOWN_ACTUATORS = 8  # actuators that `repr` names before it counts the others


@dataclass(frozen=True, eq=False)
class SlotMap:
    """Map of parameter values onto displacements e and transmissions.

    slots(v) = M (v - nominal) + sum over shared maps of [g(v) - g(nominal)]. The first
    `n_displacements` slots are e, the others the terms of the actuators, (a, k) row by row, with
    k = 19 where one is a triangle drive, 19 + K + J with tables of K points and sums of J joints, 9
    elsewhere.

    matrix : (s, p) M. shared : the shared maps, each with the positions of its inputs and of its
        outputs, which differ.
    nominal : (p,). n_displacements : length of e.
    terms : (a, k) nominal transmission terms. constants : (a, 5 + K) of `list_constants`.
    """

    matrix: FloatArray
    shared: tuple[tuple[SharedMap, tuple[int, ...], tuple[int, ...]], ...]
    nominal: FloatArray
    n_displacements: int
    terms: FloatArray
    constants: FloatArray

    def __call__(self, values: FloatArray) -> tuple[FloatArray, Transmissions]:
        """Return e (t, n_displacements) and the transmissions of values (t, p)."""
        slots = np.zeros((len(values), len(self.matrix)))
        change = values - self.nominal
        # element by element, so that a trial's result does not depend on its neighbors
        for places, columns, coefficients in self._layers:
            slots[:, places] += change[:, columns] * coefficients
        for shared, inputs, outputs, nominal in self._together:
            slots[:, outputs] += shared.value(values[:, inputs]) - nominal
        e, tau = slots[:, : self.n_displacements], slots[:, self.n_displacements :]
        return e, Transmissions(self.terms + tau.reshape(-1, *self.terms.shape), self.constants)

    @cached_property
    def _layers(self) -> list[tuple[IntArray, IntArray, FloatArray]]:
        """Return the matrix as (slots, parameters, coefficients), each slot once in a layer."""
        rows, columns = np.nonzero(self.matrix)
        nth = np.arange(len(rows)) - np.searchsorted(rows, rows)
        layers = (nth == i for i in range(nth.max(initial=-1) + 1))
        return [
            (rows[layer], columns[layer], self.matrix[rows[layer], columns[layer]])
            for layer in layers
        ]

    @cached_property
    def _together(self) -> list[tuple[SharedMap, IntArray, IntArray, FloatArray]]:
        """Shared maps, those that differ in names alone as one, with the positions (m, i) of the
        inputs and (m, o) of the outputs of its m maps, each output once, and nominal values.
        """
        listed = [place for *_, outputs in self.shared for place in outputs]
        is_apart, groups = len(set(listed)) == len(listed), defaultdict(list)
        for each in self.shared:
            is_plain = is_apart and len(vars(each[0])) == len(fields(SharedMap))
            groups[type(each[0]) if is_plain else id(each[0])].append(each)
        together = []
        for group in groups.values():
            of, inputs, outputs = group[0][0], *(np.array([g[i] for g in group]) for i in (1, 2))
            together.append((of, inputs, outputs, of.value(self.nominal[None, inputs])))
        return together

    @cached_property
    def touches(self) -> BoolArray:
        """Return which parameters may move which slots, (s, p)."""
        touches = self.matrix != 0
        for _, inputs, outputs in self.shared:
            touches[np.ix_(outputs, inputs)] = True
        return touches

    def moved_by(self, places: IntArray) -> MovedSlots:
        """Return the slots that parameters at places (p,) move; found once for each selection, so
        that every fit of a robot shares them, and what an engine derives from their pattern.
        """
        key = places.tobytes()
        if key not in self._moved:
            self._moved[key] = self._find_moved(self.touches[:, places])
        return self._moved[key]

    def _find_moved(self, touches: BoolArray) -> MovedSlots:
        """Return the slots that p parameters move, which may touch slots (s, p)."""
        slot, column = np.nonzero(touches)
        cut = int(np.searchsorted(slot, self.n_displacements))
        joint, term = np.divmod(slot[cut:] - self.n_displacements, self.terms.shape[1])
        weights = Transmissions(self.terms, self.constants).weights
        if weights is not None:  # once for each joint in sums
            n = weights.shape[-1]
            term = np.tile(slot[cut:] - self.n_displacements, n)
            joint = np.repeat(np.arange(n), len(slot) - cut)
            slot, column = (
                np.concatenate([part[:cut], np.tile(part[cut:], n)]) for part in (slot, column)
            )
        terms, function = np.unique(term, return_inverse=True)
        pattern = MapPattern(
            touches.shape[1],
            np.column_stack([slot[:cut], column[:cut]]),
            np.column_stack([joint, function, column[cut:]]),
        )
        return MovedSlots(slot, column, tuple(terms.tolist()), pattern)

    @cached_property
    def _moved(self) -> dict[bytes, MovedSlots]:
        """Results of `moved_by`, by the bytes of the places."""
        return {}

    def jacobian(self, values: FloatArray) -> FloatArray:
        """Return d slots / d values, (t, s, p)."""
        J = np.repeat(self.matrix[None], len(values), axis=0)
        for shared, inputs, outputs, _ in self._together:
            J[:, outputs[:, :, None], inputs[:, None]] += shared.jacobian(values[:, inputs])
        return J


@dataclass(frozen=True, eq=False)
class Stage:
    """A stage of a chain: a mechanism whose base is attached to the platform of another stage.

    name : of the stage. parent : the stage that it is attached to, -1 for the base of the chain.
    mount : (4, 4) T_platform_base, from the base of this stage to the platform of its parent [m].
    robot : this stage alone; its values are the nominal ones.
    parameters, actuators, groups : places of its own among those of the chain.
    """

    name: str
    parent: int
    mount: FloatArray
    robot: Mechanism
    parameters: slice
    actuators: slice
    groups: slice


def describe_gap(gap: float, scale: float) -> Quantity:
    """Return a gap of loops [m], with a `Mechanism.gap_scale` above 0 as an angle."""
    return Quantity(gap / scale, "rad") if scale else Quantity(gap * 1e3, "mm")


@dataclass(frozen=True, eq=False, repr=False)
class Mechanism(DrawnResult):
    """A robot with closed loops, ready to compute.

    Attributes
    ----------
    assembly : the generic description that it was compiled from. record : the family record; None
        if it was built in Python.
    parameters : the unknowns. values : (p,) their present values [SI], read-only.
    program, slots : structure and parameter maps for the engine.
    size : characteristic length [m]; an angle times the size compares with a length.
    home_state : engine state of the home pose.
    units : symbol of the display unit of every dimension.
    findings : remarks about the structure, such as locked joints or redundant constraints.
    stages : of a chain, each behind its parent; the last one carries the end platform. The program
        and the slots of a chain are those of all stages, one after the other; an engine computes
        the stages one by one.
    independent : places of readings that determine the others, all without redundant ones; None of
        chains, serial limbs, and a machine whose home is not known.
    """

    assembly: Assembly
    parameters: ParameterTable
    values: FloatArray
    program: Program
    slots: SlotMap
    size: float
    home_state: State
    units: Mapping[Dimension, str]
    findings: tuple[Finding, ...] = ()
    record: Any = None
    stages: tuple[Stage, ...] = ()
    independent: IntArray | None = None

    FIELDS: ClassVar[tuple[Field, ...]] = (
        Field("value", lambda robot: robot.list_shown(robot.values), "parameter"),
        Field("nominal", lambda robot: robot.list_shown(robot.parameters.nominal), "parameter"),
        Field("tolerance", lambda robot: robot.list_shown(robot.parameters.tolerance), "parameter"),
        Field("unit", lambda r: [r.units[d] for d in r.parameters.dimensions], "parameter"),
        Field("free", "parameters.free", "parameter"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="parameters.names")

    def list_shown(self, values: FloatArray) -> FloatArray:
        """Return values (p,) [SI] in the units of the robot's file."""
        return values / [self.get_unit(d).factor_to_si for d in self.parameters.dimensions]

    def __repr__(self) -> str:
        """Return name, family, actuators, freedoms and counts, on a few lines."""
        # a loaded robot keeps its family record inside the record of its file
        record = getattr(self.record, "record", self.record)
        family = getattr(record, "family", None)
        names = [a.name for a in self.actuators]
        if len(names) > SHOWN_ACTUATORS:
            names = [*names[:SHOWN_ACTUATORS], f"and {len(names) - SHOWN_ACTUATORS} more"]
        label = "nominal" if np.array_equal(self.values, self.parameters.nominal) else "changed"
        free = int(self.parameters.free.sum())
        return "\n".join(
            (
                f"<Mechanism {self.name}{f', family {family}' if family else ''}",
                f"  actuators: {', '.join(names)}",
                f"  platform freedoms: {', '.join(self.freedoms)}",
                f"  commanded in: {', '.join(self.controlled)}",
                f"  parameters: {len(self.parameters)} ({free} free), at {label} values>",
            )
        )

    __str__ = __repr__

    @property
    def name(self) -> str:
        """Name of the robot."""
        return self.assembly.name

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """Actuators in the order of the readings."""
        return self.assembly.actuators

    @cached_property
    def twist_scale(self) -> FloatArray:
        """Factors (6,) that turn a twist into lengths: rotations times the size, translations."""
        return np.repeat([self.size, 1.0], 3)

    def get_unit(self, dimension: Dimension) -> Unit:
        """Return the unit in which values are shown: that of the robot file, or the usual one."""
        return find_unit(self.units[dimension])

    @property
    def shown_units(self) -> dict[Dimension, Unit]:
        """The units in which values are shown, by dimension."""
        return {dimension: find_unit(symbol) for dimension, symbol in self.units.items()}

    def to_quantity(self, value: float, dimension: Dimension) -> Quantity:
        """Return a value [SI] in the unit in which it is shown."""
        return to_quantity(value, self.get_unit(dimension))

    @property
    def gap_scale(self) -> float:
        """The size [m] by which gaps of loops are angles, of bodies that only rotate; else 0."""
        only_rotates = all(freedom < 3 for own in self.program.nodes for freedom in own)
        return self.size if only_rotates else 0.0

    def describe_gap(self, gap: float) -> Quantity:
        """Return the gap [m] of loops as a length or an angle."""
        return describe_gap(gap, self.gap_scale)

    @property
    def is_commanded(self) -> BoolArray:
        """Which readings (a,) are commanded, not measured as those of conditions."""
        return np.array([actuator.reference is None for actuator in self.actuators], dtype=bool)

    @property
    def stated_sigma(self) -> FloatArray:
        """Standard deviations (a,) of the readings [SI]; 0 where the robot states none."""
        return np.array([actuator.sigma or 0.0 for actuator in self.actuators])

    @property
    def freedoms(self) -> tuple[str, ...]:
        """Freedoms of the platform."""
        return self.assembly.freedoms

    @property
    def can_rotate(self) -> bool:
        """Whether the platform can rotate."""
        return not {0, 1, 2}.isdisjoint(self.program.freedoms)

    @property
    def controlled(self) -> tuple[str, ...]:
        """Coordinates in which the machine is commanded."""
        return self.assembly.controlled

    @property
    def tool(self) -> FloatArray:
        """T_platform_tool (4, 4)."""
        return self.assembly.tool

    @property
    def home(self) -> FloatArray:
        """T_base_platform (4, 4) of the home pose."""
        return self.home_state.T[0, 0]

    @cached_property
    def blocks(self) -> tuple[Stage, ...]:
        """The stages of a chain; any other robot is the only stage of its own."""
        counts = len(self.parameters), len(self.actuators), len(self.program.groups)
        whole = (slice(0, count) for count in counts)
        return self.stages or (Stage(self.name, -1, np.eye(4), self, *whole),)

    @property
    def determining_readings(self) -> IntArray | None:
        """Places of the readings that determine redundant others; None where there are none."""
        chosen = self.independent
        return None if chosen is None or len(chosen) == len(self.actuators) else chosen

    @cached_property
    def present(self) -> tuple[FloatArray, Transmissions]:
        """Displacements and transmissions at the present values."""
        return self.slots(self.values[None])

    @cached_property
    def present_stages(self) -> tuple[Mechanism, ...]:
        """The stages of a chain, each alone at its present values."""
        return tuple(s.robot.with_values(self.values[s.parameters]) for s in self.stages)

    @cached_property
    def derived(self) -> dict[str, Any]:
        """What functions have derived from this robot alone, for their next calls, by name."""
        return {}

    @cached_property
    def exact(self) -> Mechanism:
        """The same robot with loops that close exactly and redundant readings that follow them."""
        if self.stages:
            stages = tuple(replace(stage, robot=stage.robot.exact) for stage in self.stages)
            return replace(self, stages=stages)
        if self.determining_readings is None:
            return self
        return replace(self, program=replace(self.program, sigma=None, may_stay_open=False))

    @cached_property
    def is_serial(self) -> bool:
        """Whether the pose is the product of driven joints: one limb without passive joints."""
        return is_serial(self.assembly) and not self.has_open_sums

    def select_joint(self, state: State, name: str) -> FloatArray:
        """Return the values (t, n) of a joint `limb.joint` [rad or m]."""
        group, k, j = self._joint_places[name]
        return state.joints[group][:, :, k, j]

    @cached_property
    def _joint_places(self) -> Mapping[str, tuple[int, int, int]]:
        """Group, limb in it and joint of each joint `limb.joint`."""
        return {
            f"{limb.name}.{joint.name}": (g, k, j)
            for g, group in enumerate(self.program.groups)
            for k, limb in enumerate(self.assembly.limbs[i] for i in group.limbs)
            for j, joint in enumerate(limb.joints)
        }

    @cached_property
    def joint_units(self) -> FloatArray:
        """Lengths (J,) [m] that a unit of each driven joint counts for, an angle at the size."""
        turns = [name in self.assembly.turning_drives for name in self.assembly.driven_joints]
        return np.where(turns, self.size, 1.0)

    @cached_property
    def drive_units(self) -> FloatArray:
        """Lengths (a,) [m] that a unit of what each drive moves counts for, an angle at the size.
        It moves a joint, or a sum, which is a length where a joint slides.
        """
        turning = self.assembly.turning_drives
        turns = [turning.issuperset(actuator.driven_joints) for actuator in self.actuators]
        return np.where(turns, self.size, 1.0)

    @cached_property
    def has_sums(self) -> bool:
        """Whether a reading is a weighted sum of joint values, or joints are coupled."""
        return any(row.weights for row in self.assembly.rows)

    @cached_property
    def is_elastic(self) -> bool:
        """Whether a drive has a compliance."""
        return bool((self.slots.constants[:, LOADED] >= 0).any())

    @cached_property
    def has_open_sums(self) -> bool:
        """Whether closure takes part in determining the driven joints, because their sums are
        fewer, or more than the freedoms.
        """
        rows, readings = self.assembly.rows, len(self.assembly.rows) - len(self.assembly.couplings)
        is_square = self.program.n_joints == len(rows) and readings <= len(self.freedoms)
        return self.has_sums and not self.stages and not is_square

    @property
    def has_redundant_sums(self) -> bool:
        """Whether sums are more than the freedoms: loops may stay open, but no file asks for it."""
        return (
            self.has_open_sums and self.program.may_stay_open and self.assembly.closure == "exact"
        )

    @cached_property
    def redundancy(self) -> tuple[float, ...] | None:
        """Relative standard deviations (a,) of readings that are more than the freedoms and each
        of which the platform's pose determines; None of other robots.
        """
        own, program = self.assembly, self.program
        if not self.has_redundant_sums:
            return program.sigma
        # by closure and couplings, as many as joints and other nodes have unknowns
        equations = program.count_equations(free=True) + len(own.couplings)
        sigma = [row.sigma or 1.0 for row in own.rows if row.column is None]
        is_determined = equations == sum(map(len, program.others))
        return tuple(s / max(sigma) for s in sigma) if is_determined else None

    @cached_property
    def has_redundant_readings(self) -> bool:
        """Whether some readings of the robot, or of a stage, determine others."""
        return any(stage.robot.determining_readings is not None for stage in self.blocks)

    @cached_property
    def all_parameters(self) -> ParameterUnits:
        """All parameters in SI, as columns of derivatives."""
        count = len(self.parameters)
        return ParameterUnits(self.slots, np.arange(count), np.ones(count))

    @property
    def nominal(self) -> Mechanism:
        """The same robot at its nominal values."""
        return self.with_values(self.parameters.nominal)

    def with_conditions(self, values: Mapping[str, float]) -> Mechanism:
        """Return the same robot with other references of conditions [degC, s, N, Nm], such as
        today's temperature and load, at which inverse kinematics and simulations hold them.

        Raises MechanismError: an unknown condition.
        """
        known = [a.name for a in self.actuators if a.reference is not None]
        known = [name for name in known if not name.startswith(LOAD)]
        known += FORCES if self.is_elastic else ()
        for name in values:
            if name not in known:
                raise MechanismError(
                    f"{self.name} has no condition {name!r}{suggest_names(name, known)}; "
                    f"it has {', '.join(known) or 'none'}"
                )
        actuators = tuple(
            replace(a, reference=values[a.name], stroke=None) if a.name in values else a
            for a in self.actuators
        )
        constants = self.slots.constants.copy()
        for i, actuator in enumerate(actuators):
            if actuator.reference is not None:
                constants[constants[:, SOURCE] == i, REFERENCE] = actuator.reference
        stages = []
        for stage in self.stages:
            names = {a.name for a in stage.robot.actuators}
            own = {name: value for name, value in values.items() if name in names}
            stages.append(replace(stage, robot=stage.robot.with_conditions(own)))
        load = self.assembly.load
        wrench = tuple(map(values.get, FORCES, load.wrench))
        ranges = {name: ends for name, ends in load.ranges.items() if name not in values}
        return replace(
            self,
            assembly=replace(
                self.assembly, actuators=actuators, load=replace(load, wrench=wrench, ranges=ranges)
            ),
            slots=replace(self.slots, constants=constants),
            stages=tuple(stages),
        )

    def with_values(self, values: ArrayLike) -> Mechanism:
        """Return the same robot with other parameter values (p,) [SI].

        Raises MechanismError: wrong number of values, or one that is not finite.
        """
        new = np.array(values, dtype=float)
        if new.shape != (len(self.parameters),):
            raise MechanismError(
                f"{self.name} has {len(self.parameters)} parameters, but values of shape "
                f"{new.shape} do not fit. Give one value for each"
            )
        if not np.isfinite(new).all():
            bad = self.parameters.names[int(np.argmin(np.isfinite(new)))]
            raise MechanismError(f"the value of {bad} is not finite. Give a number")
        new.setflags(write=False)
        return replace(self, values=new)
