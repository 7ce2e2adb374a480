# SPDX-License-Identifier: Apache-2.0
"""Base class of measurement kinds: columns, residuals and their derivatives.

A new kind is one frozen dataclass and one entry in `KINDS`; files, templates and contract tests
follow. A kind receives platform poses, not the robot. It states

* `columns`, as written in files;
* `possible_setup`: frames, targets, surfaces and offsets that may be unknown;
* `_predict`: columns without noise, and derivatives; or, where noise is not just added to the
  columns, `_evaluate` and `_measure`;
* `guess_values`, if its parameters follow from data in closed form;
* `label_count` and `rows_per_pose`, if a row is one of many targets, whose number is in a column.

Example: `loopcal.measure.kinds.distance`. Shapes: t trials, r rows, c columns as in files,
m residuals (often c), u nuisance parameters of the kind, j joints that it senses. A kind with
`poses_per_row` l > 1 has an axis l for the poses that a row compares: T (t, r, l, 4, 4), jacobian
(t, r, l, m, 6). Values of nuisance parameters are plain numbers that add up;
`loopcal.measure.kinds.setup_parameters` says how a frame or a direction is written in them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self, cast

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.array_checks import set_fields
from loopcal.measure.kinds.setup_parameters import SetupItem, encode_frame
from loopcal.mechanism.limb_rows import name_entries
from loopcal.numerics.elimination import has_rounding, without_rounding
from loopcal.numerics.statistics import find_distinct
from loopcal.parameters import Parameter
from loopcal.plain_text import represent
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

# Index of each invalid row, and the end of a sentence that says why.
InvalidRows = tuple[tuple[int, str], ...]
# Common errors of an instrument, which its rows share: setup items that any kind may list as
# unknown. A constant and a linear drift of each component; factors on the measured lengths: of the
# instrument's scale, and by the temperature and the coefficient of expansion of what it measures.
BIAS, DRIFT = "bias", "drift"
SCALES = ("scale", "temperature", "expansion")
SHARED_ERRORS = (BIAS, DRIFT, *SCALES)
BASE = "base"  # name of the base among the bodies that a kind may be `of`; no stage has it


@dataclass(frozen=True)
class Column:
    """A column of a measurement file: its name, and the dimension of its numbers."""

    name: str
    dimension: Dimension


def make_angles(*names: str) -> tuple[Column, ...]:
    """Return columns of angles."""
    return tuple(Column(name, Dimension.ANGLE) for name in names)


POSITION_COLUMNS = tuple(Column(name, Dimension.LENGTH) for name in ("x", "y", "z"))


class Evaluation(NamedTuple):
    """Residuals (predicted - measured) and their derivatives; zero where nothing was measured."""

    residual: FloatArray  # (t, r, m) [SI]
    # (t, r, m, 6) by the platform twist (omega, v) in base axes; with an axis of poses before m
    # where a row compares several poses
    jacobian: FloatArray
    nuisance: FloatArray | None = None  # (t, r, m, u) by the nuisance parameters of the kind
    joints: FloatArray | None = None  # (t, r, m, j) by the values of the joints that it senses


class MeasuredColumns(NamedTuple):
    """Columns of rows as a kind compares its predictions with them, see `Kind.prepare_columns`."""

    columns: FloatArray  # (t, r, c) [SI], with a placeholder where nothing was measured
    reference: FloatArray  # (t, r, k) the columns, or what a kind computes from them alone
    present: BoolArray  # (t, r, m) residuals that exist
    is_complete: bool  # whether all do

    def take(self, trials: IntArray) -> MeasuredColumns:
        """Return the columns of some trials."""
        arrays = (self.columns[trials], self.reference[trials], self.present[trials])
        return MeasuredColumns(*arrays, self.is_complete)


class ErrorGroup(NamedTuple):
    """Residuals that are the components of one error."""

    quantity: str  # what the error is of, such as "position" or "length"
    dimension: Dimension  # of its number
    target: str  # name of the target or joint, empty where a row has only one
    components: tuple[str, ...]  # their names, such as ("x", "y", "z")
    columns: tuple[int, ...]  # their indices among the m residuals


def checked(check: Callable[[Any, str], FloatArray], what: str, default: Any = None) -> Any:
    """Return the field of a setting that `check(value, what)` copies and checks, unless None."""
    return field(default_factory=lambda: default, metadata={"check": check, "what": what})


def list_rows(wrong: BoolArray, describe: Callable[[int], str]) -> InvalidRows:
    """Return the rows of a mask (r,), each with its description."""
    return tuple((int(i), describe(int(i))) for i in np.flatnonzero(wrong))


def list_not_unit(vectors: FloatArray, what: str, more: str = "") -> InvalidRows:
    """Return the rows of vectors (r, k) whose length is not 1."""
    length = np.linalg.norm(vectors, axis=-1)
    rule = f"the length must be 1 to 1e-3{more}"
    return list_rows(
        np.abs(length - 1.0) > 1e-3, lambda i: f"has a {what} of length {length[i]:.6g}; {rule}"
    )


def is_incomplete(columns: FloatArray) -> BoolArray:
    """Return the rows of columns (.., c) in which some values are missing, but not all."""
    missing = np.isnan(columns)
    return np.any(missing, axis=-1) & ~np.all(missing, axis=-1)


def name_shared_error(kind: Kind, item: str, component: str) -> str:
    """Return the name of the bias or drift of a component, such as `tracker.bias.x`: with the name
    of the fixed point or frame where the settings state one, else that of the kind. That of a
    scale has no component, and rather that of the frame, which instruments have in common.
    """
    owner = kind.name
    settings = ("frame", "anchor_name")
    for setting in reversed(settings) if item in SCALES else settings:
        value = getattr(kind, setting, "")
        if value and value != getattr(type(kind), setting):
            owner = value
    if item == BIAS and kind.bias_item != BIAS:
        return f"{owner}.{kind.bias_item}"
    return f"{owner}.{item}" if item in SCALES else f"{owner}.{item}.{component}"


def measure_progress(session: np.ndarray, time: FloatArray | None) -> FloatArray:
    """Return the progress (r,) of rows through their session (r,), from -0.5 to 0.5: by time (r,)
    [s] where all rows state one, else in their order.
    """
    time = None if time is None or not np.isfinite(time).all() else time
    progress = np.zeros(len(session))
    for name in find_distinct(session):
        chosen = np.flatnonzero(session == name)
        values = np.arange(float(len(chosen))) if time is None else time[chosen]
        low, high = values.min(), values.max()
        if high > low:
            progress[chosen] = (values - 0.5 * (low + high)) / (high - low)
    return progress


class Kind(ABC):
    """A kind of measurement with its fixed settings (frame, tool, form of the orientation).

    Attributes
    ----------
    name : in files and in `KINDS`. per_target : columns of a row, or of each of its targets, where
        no setting changes them. poses_per_row : number of poses that one row compares.
    changes_with_pose : whether columns that stay constant while the robot moves indicate a mistake.
        It is False for touched surfaces and for locked joints, whose columns stay at 0.
    mixes_components : whether a motion of base and setup mixes the components of a residual, so
        that rows contain it in proportion to the residual; see docs/theory/identification.md.
    wraps_angles : whether differences of angles are wrapped into (-pi, pi].
    description : what is measured, for suggestions to measure it with known setup; else "the" and
        the name.
    length_error, angle_error : what its residuals are errors of, by dimension, such as "position".
    allowed_unknown : setup items that `unknown` may list. bias_item : the one that the bias of a
        session is. common_items : those that all sessions may have in common.
    label_count : number of the first columns that say what a row measures, such as the corner of a
        board. row_settings : names of settings that a column of a file may repeat, by which its
        rows belong to one of several kinds.
    unknown : setup items that are unknown; "bias" stands for `bias_item`.
    measures_points : whether it measures targets, which may be fixed to the base (`of: base`).
    of : the body that is measured: the platform of a stage of a chain, one of `bodies:`, or "base";
        empty for the end platform.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]  # every kind is a dataclass
    name: ClassVar[str]
    per_target: ClassVar[tuple[Column, ...]] = ()
    poses_per_row: ClassVar[int] = 1
    changes_with_pose: ClassVar[bool] = True
    mixes_components: ClassVar[bool] = False
    wraps_angles: ClassVar[bool] = True
    measures_points: ClassVar[bool] = False
    description: ClassVar[str] = ""
    length_error: ClassVar[str] = "length"
    angle_error: ClassVar[str] = "angle"
    allowed_unknown: ClassVar[tuple[str, ...]] = ()
    bias_item: ClassVar[str] = BIAS
    common_items: ClassVar[tuple[str, ...]] = ()
    label_count: ClassVar[int] = 0
    row_settings: ClassVar[tuple[str, ...]] = ()
    unknown: tuple[str, ...] = ()
    of: str = ""

    def __post_init__(self) -> None:
        stated = (self.unknown,) if isinstance(self.unknown, str) else self.unknown
        names = tuple(dict.fromkeys(self.bias_item if n == BIAS else n for n in stated))
        allowed = tuple(dict.fromkeys((*self.allowed_unknown, self.bias_item, DRIFT, *SCALES)))
        for name in (name for name in names if name not in allowed):
            sentence = f"{name!r} cannot be unknown in the kind {self.name!r}"
            raise DataError(f"{sentence}. Allowed: {', '.join(allowed)}")
        set_fields(self, unknown=names)
        for setting in fields(self):
            value, how = getattr(self, setting.name), setting.metadata
            if "check" in how and value is not None:
                set_fields(self, **{setting.name: how["check"](value, how["what"])})
        if self.of and self.poses_per_row > 1:
            raise DataError(
                f"the kind {self.name!r} compares poses of the end platform. Leave out "
                f"`of: {self.of}`"
            )
        if self.is_of_base and not self.measures_points:
            raise DataError(
                f"the kind {self.name!r} measures a moving body, but `of: {BASE}` needs targets "
                "on the base. Leave it out, or use the kind position, bearing or "
                "distance"
            )
        scales = [name for name in names if name in SCALES]
        if scales and not self._length_places[0]:
            raise DataError(
                f"the kind {self.name!r} measures angles, which have no {scales[0]}. Remove "
                f"{scales[0]!r}"
            )

    __repr__ = represent

    @property
    def columns(self) -> tuple[Column, ...]:
        """The c columns of a row, as in files."""
        return self.per_target

    @property
    def noise_columns(self) -> tuple[Column, ...]:
        """The m numbers for which a noise or sigma is stated, one for each residual."""
        return self.columns

    @cached_property
    def possible_setup(self) -> Mapping[str, SetupItem]:
        """The frames, targets, surfaces and offsets that may be unknown, by name."""
        return {}

    @property
    def target_columns(self) -> Mapping[str, tuple[int, ...]]:
        """The measured objects by name, with the indices of their columns."""
        return {self.name: tuple(range(len(self.columns)))}

    @property
    def rows_per_pose(self) -> int:
        """Number of rows that an instrument measures at each pose."""
        return 1

    def list_labels(self, r: int) -> FloatArray:
        """Return the labels (r, `label_count`) of the rows of a simulation."""
        return np.zeros((r, 0))

    def hide_unseen(self, T: FloatArray, columns: FloatArray, values: FloatArray) -> FloatArray:
        """Return measured columns (t, r, c) with NaN where an instrument sees nothing."""
        return columns

    @property
    def is_of_base(self) -> bool:
        """Whether its targets are fixed to the base, so that its rows depend on no pose."""
        return self.of == BASE

    @property
    def sensed_joints(self) -> tuple[str, ...]:
        """Names of the j joints, driven or passive, whose values the residual depends on; of a
        body, the twelve numbers of its pose.
        """
        return name_entries(self.of) if self.of not in ("", BASE) else ()

    def stack_joints(self, joints: Mapping[str, FloatArray], rows: IntArray) -> FloatArray | None:
        """Return the values (.., r, j) of the sensed joints at the poses of rows (r,), from those
        of all joints by name (.., n); None where it senses none. DataError if one is missing.
        """
        for name in (name for name in self.sensed_joints if name not in joints):
            sentence = f"the kind {self.name!r} needs the values of joint {name!r}"
            raise DataError(f"{sentence}. Pass them as `joints`")
        columns = [joints[name][..., rows] for name in self.sensed_joints]
        return np.stack(columns, axis=-1) if columns else None

    @classmethod
    @abstractmethod
    def examples(cls) -> tuple[Kind, ...]:
        """Return instances that together show every setting, for documentation and tests."""

    def with_tool(self, T_platform_tool: FloatArray) -> Self:
        """Return the kind for a robot with this tool (4, 4); itself where it has no need of it."""
        return self

    @property
    def has_tool(self) -> bool:
        """Whether the kind knows the tool, or does not need it."""
        return True

    @cached_property
    def own_items(self) -> Mapping[str, SetupItem]:
        """The frames, targets, surfaces and offsets that are unknown, in order."""
        possible = self.possible_setup
        return {name: possible[name] for name in self.unknown if name not in SHARED_ERRORS}

    @property
    def shared_errors(self) -> tuple[str, ...]:
        """Which of the common errors of an instrument are unknown."""
        return tuple(name for name in SHARED_ERRORS if name in self.unknown)

    @cached_property
    def error_groups(self) -> tuple[ErrorGroup, ...]:
        """The errors that the residuals of one row are."""
        residuals = self.noise_columns
        targets: Mapping[str, tuple[int, ...]] = {"": tuple(range(len(residuals)))}
        if self.sensed_joints and not self.of:
            targets = {name: (i,) for i, name in enumerate(self.sensed_joints)}
        elif residuals == self.columns:
            targets = self.target_columns
        quantities = {
            Dimension.LENGTH: self.length_error,
            Dimension.ANGLE: self.angle_error,
            Dimension.PIXEL: "image",
        }
        groups = []
        for target, places in targets.items():
            for dimension, quantity in quantities.items():
                columns = tuple(i for i in places if residuals[i].dimension is dimension)
                names = tuple(residuals[i].name.removeprefix(f"{target}.") for i in columns)
                if columns:
                    label = target if len(targets) > 1 else ""
                    groups.append(ErrorGroup(quantity, dimension, label, names, columns))
        return tuple(groups)

    @cached_property
    def component_columns(self) -> Mapping[tuple[str, Dimension], list[int]]:
        """The measured components with their noise columns: x of all targets is one component."""
        members: dict[tuple[str, Dimension], list[int]] = {}
        for group in self.error_groups:
            for name, column in zip(group.components, group.columns, strict=True):
                members.setdefault((name, group.dimension), []).append(column)
        return members

    @cached_property
    def setup_items(self) -> Mapping[str, SetupItem]:
        """The unknown setup items in order, shared errors last: a parameter for each component."""
        items = dict(self.own_items)
        for item in self.shared_errors:
            components = self.component_columns
            of_item = [("", Dimension.RATIO)] if item in SCALES else list(components)
            named = [(name_shared_error(self, item, name), d) for name, d in of_item]
            shared = (Parameter(name, d, 0.0, scope="session") for name, d in named)
            items[item] = SetupItem(tuple(shared))
        return items

    @property
    def sight_noise(self) -> Mapping[str, Dimension]:
        """What the noise may consist of beside that of columns, as a tracker has it."""
        return {}

    def spread_sight_noise(self, measured: FloatArray) -> dict[str, FloatArray]:
        """Return covariances (.., m, m) of values (.., m) per variance of each `sight_noise`."""
        return {}

    @cached_property
    def common_errors(self) -> Mapping[int, str]:
        """Place among the u parameters -> common error of the instrument: `tracker.bias`."""
        return {
            i: name_shared_error(self, item, "").rstrip(".")
            for item in self.shared_errors
            for i in range(*self._slices[item].indices(len(self.nuisance_parameters)))
        }

    @cached_property
    def is_drift(self) -> BoolArray:
        """(u,) nuisance parameters of which a row takes the part of its progress."""
        items = self.setup_items.items()
        return np.array([name == DRIFT for name, item in items for _ in item.parameters], bool)

    @cached_property
    def nuisance_parameters(self) -> tuple[Parameter, ...]:
        """The u parameters of all unknown items; rows of one scope share a value."""
        return tuple(p for item in self.setup_items.values() for p in item.parameters)

    @cached_property
    def divided(self) -> tuple[Kind, IntArray] | None:
        """The kind of the rows of one target, and the places (k, u') of its nuisance parameters for
        each of k targets; None where rows are not divided.
        """
        return None

    @cached_property
    def _is_length(self) -> tuple[bool, ...]:
        """(u,) which parameters of the kind's own items are lengths."""
        of_items = (p for item in self.own_items.values() for p in item.parameters)
        return tuple(p.dimension is Dimension.LENGTH for p in of_items)

    def without_shared_errors(self) -> Self:
        """Return the kind without common errors of the instrument."""
        return replace(cast(Any, self), unknown=tuple(self.own_items))

    @cached_property
    def _spread(self) -> FloatArray:
        """The matrix (m, b) that adds a shared error of each component to its noise columns."""
        components = self.component_columns.values()
        matrix = np.zeros((len(self.noise_columns), len(components)))
        for i, columns in enumerate(components):
            matrix[columns, i] = 1.0
        return matrix

    @cached_property
    def _length_places(self) -> tuple[list[int], list[int]]:
        """The indices of the lengths among the columns, and among the residuals."""
        of_columns, of_residuals = (
            [i for i, column in enumerate(columns) if column.dimension is Dimension.LENGTH]
            for columns in (self.columns, self.noise_columns)
        )
        return of_columns, of_residuals

    def _list_unknown(self, names: Sequence[str]) -> list[str]:
        """Return those of some common errors that are unknown."""
        return [name for name in names if name in self._slices]

    def _sum_items(self, values: FloatArray, names: Sequence[str]) -> FloatArray:
        """Return the sum (.., w) of values of setup items; of a drift, the parts of the rows."""
        return np.asarray(sum(values[..., self._slices[name]] for name in names))

    def _add_shared_errors(
        self, result: Evaluation, columns: FloatArray, values: FloatArray
    ) -> Evaluation:
        """Return an evaluation with the common errors: a predicted length l is `(1 + sum of the
        scales) l`, and bias and drift are added.
        """
        residual, jacobian, by_setup, joints = result
        blocks = [] if by_setup is None else [by_setup]
        constants, scales = (self._list_unknown(names) for names in ((BIAS, DRIFT), SCALES))
        length = np.zeros_like(residual)
        if scales:
            of_columns, places = self._length_places
            length[..., places] = residual[..., places] + columns[..., of_columns]
            scale = self._sum_items(values, scales)
            factor = (1.0 + scale * np.isin(np.arange(length.shape[-1]), places))[..., None]
            residual = residual + scale * length
            jacobian = jacobian * (factor[..., None, :, :] if self.poses_per_row > 1 else factor)
            blocks = [block * factor for block in blocks]
            joints = None if joints is None else joints * factor
        if constants:
            slope = self.linearize_noise(columns) @ self._spread
            residual = residual + (slope @ self._sum_items(values, constants)[..., None])[..., 0]
            blocks += [slope] * len(constants)
        blocks += [length[..., None]] * len(scales)
        blocks = [np.broadcast_to(b, (*residual.shape, b.shape[-1])) for b in blocks]
        return Evaluation(residual, jacobian, np.concatenate(blocks, axis=-1), joints)

    @property
    def references(self) -> Mapping[str, FloatArray]:
        """The stated orientations or points that parameters are counted from, by name, on which
        kinds that share a name must agree.
        """
        return {k: v for item in self.setup_items.values() for k, v in item.references.items()}

    @cached_property
    def _slices(self) -> Mapping[str, slice]:
        """Where the values of each unknown item are among the u values."""
        slices, first = {}, 0
        for name, item in self.setup_items.items():
            slices[name] = slice(first, first := first + len(item.parameters))
        return slices

    @property
    def nominal_values(self) -> FloatArray:
        """Nominal values (u,) of the nuisance parameters."""
        return np.array([parameter.nominal for parameter in self.nuisance_parameters])

    def item_values(self, values: FloatArray, name: str) -> FloatArray | None:
        """Return the values (.., w) of one setup item, None where it is known."""
        return values[..., self._slices[name]] if name in self._slices else None

    def stated_or_unknown(self, values: FloatArray, name: str) -> FloatArray:
        """Return the values (.., w) of one setup item, the stated ones (w,) where it is known."""
        if name in self._slices:
            return values[..., self._slices[name]]
        return np.array([parameter.nominal for parameter in self.possible_setup[name].parameters])

    def assemble_values(self, items: Mapping[str, FloatArray]) -> FloatArray:
        """Return candidates (k, u) from values (k, w) or (w,) of some items, others nominal."""
        nominal = self.nominal_values
        columns = [
            np.atleast_2d(items.get(name, nominal[used])) for name, used in self._slices.items()
        ]
        count = max(len(values) for values in columns)
        return np.concatenate([np.broadcast_to(v, (count, v.shape[1])) for v in columns], axis=-1)

    def spread_frames(self) -> FloatArray:
        """Return candidates (k, u): 24 evenly spread orientations of an unknown frame, with its
        origin where it is stated; the nominal values without one.
        """
        stated = getattr(self, "T_base_frame", None)
        if stated is None or "frame" not in self.own_items:
            return self.nominal_values[None]
        frames = geometry.make_pose(geometry.OCTAHEDRAL_ROTATIONS @ stated[:3, :3], stated[:3, 3])
        return self.assemble_values({"frame": encode_frame(stated, frames)})

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return candidates (k, u) for the nuisance parameters that rows share, from poses T
        (r, 4, 4) and columns (r, c); `loopcal.measure.initial_values` refines and compares them.
        """
        return self.nominal_values[None]

    def guess_sets(
        self, T: FloatArray, measured: FloatArray, is_row: BoolArray, worth: float = np.inf
    ) -> list[FloatArray | DataError]:
        """Return the candidates (k, u) of `guess_values` for s sets of rows with parameters of
        their own, or why there are none, from poses T (s | 1, r, 4, 4) and columns (s, r, c) of
        those that a set has, `is_row` (s | 1, r). Candidates that are known to have more than
        `worth` times the lowest sum of squares may be left out.
        """
        guesses: list[FloatArray | DataError] = []
        for j, of_set in enumerate(measured):
            own = is_row[j if len(is_row) > 1 else 0]
            try:
                guesses.append(self.guess_values(T[j if len(T) > 1 else 0][own], of_set[own]))
            except DataError as error:
                guesses.append(error)
        return guesses

    def detect_present(self, measured: FloatArray) -> BoolArray:
        """Return which residuals (..., m) exist for columns (..., c); NaN is not measured."""
        return ~np.isnan(measured)

    def find_invalid_rows(self, measured: FloatArray) -> InvalidRows:
        """Return rows of columns (r, c) with impossible values: (index, end of a sentence)."""
        return ()

    @property
    def placeholder(self) -> FloatArray:
        """Values (c,), or one for all columns (1,), in place of those that were not measured."""
        return np.zeros(1)

    def prepare_columns(self, measured: FloatArray) -> MeasuredColumns:
        """Return columns (.., r, c) as `evaluate` needs them."""
        missing = np.isnan(measured)
        columns = np.where(missing, self.placeholder, measured) if np.any(missing) else measured
        present, reference = self.detect_present(measured), self._compute_reference(columns)
        return MeasuredColumns(columns, reference, present, bool(np.all(present)))

    def compare_platform(self, measured: MeasuredColumns) -> tuple[FloatArray, FloatArray] | None:
        """Return references (t, r, 12), and S (m, 6) with which the residuals are S times the
        differences of the platform's poses from these by `engine.compare_poses`, or None.
        """
        return None

    def evaluate(
        self,
        T: FloatArray,
        measured: FloatArray | MeasuredColumns,
        nuisance: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> Evaluation:
        """Return residuals and derivatives at platform poses.

        Parameters
        ----------
        T : (t or 1, r, 4, 4) T_base_platform of each row (with an axis of poses where a row
            compares several).
        measured : (t or 1, r, c) [SI], NaN where not measured; or the result of `prepare_columns`.
        nuisance : (t or 1, r or 1, u) of each row; default: nominal.
        joints : (t, r, j), values of the joints in `sensed_joints`; DataError if one is missing.
        """
        if joints is None:
            self.stack_joints({}, np.zeros(0, dtype=np.intp))  # refuses where it senses any
            joints = np.empty((1, 1, 0))
        if not isinstance(measured, MeasuredColumns):
            measured = self.prepare_columns(measured)
        values = self.nominal_values[None, None] if nuisance is None else nuisance
        T = self._find_platform(T, joints)
        if len(values) > len(T):
            T = np.broadcast_to(T, (len(values), *T.shape[1:]))
        result = self._evaluate(T, measured.reference, values, joints)
        if result.nuisance is not None:
            # Derivatives by the place of a target cancel between parallel poses: what is rounding
            # beside the derivative by the twist is zero. Radians count as moves of the largest
            # distance from the base, whatever the size of a machine.
            reach = np.abs(T[..., :3, 3]).max(initial=0.0)
            reach = np.where(reach > 0.0, reach, 1.0)
            largest = self.poses_per_row * np.sqrt(6.0) * (reach + 1.0 / reach)
            if has_rounding(result.nuisance, largest * np.abs(result.jacobian).max(initial=0.0)):
                square = result.jacobian**2
                by_move = np.sqrt(
                    square[..., :3].sum(axis=-1) / reach**2 + square[..., 3:].sum(axis=-1)
                )
                by_move = by_move.sum(axis=-2) if self.poses_per_row > 1 else by_move
                size = by_move[..., None] * np.where(np.array(self._is_length), 1.0, reach)
                result = result._replace(nuisance=without_rounding(result.nuisance, size))
        if self.of:  # rows of a stage depend on its platform, those of the base on no motion
            by_entries = (
                None if self.is_of_base else result.jacobian @ geometry.differentiate_by_entries(T)
            )
            result = result._replace(jacobian=np.zeros_like(result.jacobian), joints=by_entries)
        if self.shared_errors:
            result = self._add_shared_errors(result, measured.columns, values)
        if measured.is_complete:
            return result
        present = measured.present[..., None]
        by_twist = present[..., None, :, :] if self.poses_per_row > 1 else present
        by_nuisance, by_joints = (
            None if derivative is None else np.where(present, derivative, 0.0)
            for derivative in (result.nuisance, result.joints)
        )
        residual = np.where(measured.present, result.residual, 0.0)
        jacobian = np.where(by_twist, result.jacobian, 0.0)
        return Evaluation(residual, jacobian, by_nuisance, by_joints)

    def compute_residuals(
        self,
        T: FloatArray,
        measured: FloatArray,
        nuisance: FloatArray | None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Return the residuals (t, r, m) of `evaluate` from nuisance parameters (t, r, u); those of
        targets one by one, because each has few derivatives.
        """
        if nuisance is None or self.divided is None or self.is_of_base:
            return self.evaluate(T, measured, nuisance, joints).residual
        (kind, places), r = self.divided, measured.shape[1]
        k, both = len(places), (measured, nuisance[..., places])
        columns, values = (a.reshape(len(a), r * k, -1) for a in both)
        joints = None if joints is None else joints.repeat(k, axis=1)
        residual = kind.evaluate(T.repeat(k, axis=1), columns, values, joints).residual
        return residual.reshape(len(residual), r, -1)

    def _find_platform(self, T: FloatArray, joints: FloatArray) -> FloatArray:
        """Return the measured bodies (.., 4, 4): end platforms T, those of a stage, or the base."""
        if not self.of:
            return T
        if self.is_of_base:
            return np.broadcast_to(np.eye(4), T.shape)
        if joints.shape[-1] != 12:
            raise DataError(
                f"the platform of stage {self.of!r} is missing. Pass its numbers as `joints`"
            )
        rows = joints.reshape(*joints.shape[:-1], 3, 4)
        last = np.broadcast_to(np.eye(4)[3:], (*rows.shape[:-2], 1, 4))
        return np.concatenate([rows, last], axis=-2)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        nuisance: FloatArray | None = None,
        joints: FloatArray | None = None,
        labels: FloatArray | None = None,
    ) -> FloatArray:
        """Return the columns (t, r, c) [SI] that an instrument with this noise writes.

        To first order, `evaluate(T, measured).residual = -linearize_noise(measured) noise`.

        Parameters
        ----------
        T : (t, r, 4, 4) true T_base_platform. noise : (t, r, m) in the noise columns.
        nuisance : (t or 1, r or 1, u), default nominal. joints : (t, r, j), default zero.
        labels : (r, `label_count`) of the rows, default `list_labels`.
        """
        values = self.nominal_values[None, None] if nuisance is None else nuisance
        joints = np.zeros_like(noise) if joints is None else joints
        if constants := self._list_unknown((BIAS, DRIFT)):
            noise = noise + self._sum_items(values, constants) @ self._spread.T
        if self.label_count:
            labels = self.list_labels(noise.shape[1]) if labels is None else labels
            labels = np.broadcast_to(labels, (*noise.shape[:2], self.label_count))
            noise = np.concatenate([labels, noise], axis=-1)
        columns = self._measure(self._find_platform(T, joints), noise, values, joints)
        if scales := self._list_unknown(SCALES):
            (of_columns, places), columns = self._length_places, np.array(columns)
            length = columns[..., of_columns] - noise[..., places]
            columns[..., of_columns] += self._sum_items(values, scales) * length
        return columns

    def linearize_noise(self, measured: FloatArray) -> FloatArray:
        """Return the derivative (..., m, m) of residuals by errors of noise columns, up to sign."""
        m = len(self.noise_columns)
        return np.broadcast_to(np.eye(m), (*measured.shape[:-1], m, m))

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        """Return columns without noise in place of residuals, and their derivatives."""
        raise NotImplementedError

    def _compute_reference(self, measured: FloatArray) -> FloatArray:
        """Return what `_evaluate` receives in place of complete columns (.., r, c): (.., r, k)."""
        return measured

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        """Return `evaluate` for complete arrays; `measured` is from `_compute_reference`."""
        predicted = self._predict(T, values, joints)
        return predicted._replace(residual=self._subtract(predicted.residual, measured))

    def _measure(
        self, T: FloatArray, noise: FloatArray, values: FloatArray, joints: FloatArray
    ) -> FloatArray:
        """Return `measure` for complete arrays; the noise begins with the labels of the rows."""
        return self._predict(T, values, joints).residual + noise

    def _subtract(self, predicted: FloatArray, measured: FloatArray) -> FloatArray:
        """Return the difference of columns (.., c), angles wrapped."""
        difference = predicted - measured
        if not self._is_wrapped.any():
            return difference
        return np.where(self._is_wrapped, geometry.wrap_angle(difference), difference)

    @cached_property
    def _is_wrapped(self) -> BoolArray:
        is_angle = [c.dimension is Dimension.ANGLE for c in self.columns]
        wrapped = np.array(is_angle, dtype=bool) & self.wraps_angles
        wrapped.setflags(write=False)
        return wrapped

    def join_columns(self, blocks: Mapping[str, FloatArray], shape: tuple[int, ...]) -> FloatArray:
        """Return derivatives (*shape, 6 + u): by the twist, then by each unknown setup item.

        blocks : setup item or "twist" -> (.., w); a missing block is zero. shape : leading axes.
        """
        if not self.own_items and "twist" in blocks and blocks["twist"].shape[:-1] == shape:
            return blocks["twist"]
        widths = {"twist": 6} | {k: len(item.parameters) for k, item in self.own_items.items()}
        given = ((blocks.get(name, np.zeros(w)), w) for name, w in widths.items())
        return np.concatenate([np.broadcast_to(b, (*shape, w)) for b, w in given], axis=-1)

    def split_columns(self, residual: FloatArray, rows: FloatArray) -> Evaluation:
        """Return residuals (t, r, m) with derivatives (t, r, m, 6 + u) from `join_columns`."""
        return Evaluation(residual, rows[..., :6], rows[..., 6:] if self.own_items else None)
