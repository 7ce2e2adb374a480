# SPDX-License-Identifier: Apache-2.0
"""Base class of measurement kinds: columns, residuals and their derivatives.

A new kind is one file with one frozen dataclass, and one entry in `KINDS`. Files, templates and
contract tests follow from this class. A kind receives platform poses, not the robot. It states

* `columns`, as written in files;
* `possible_setup`: frames, targets, surfaces and offsets that may be unknown;
* `_predict`: columns without noise, and derivatives; or, where noise is not just added to the
  columns, `_evaluate` and `_measure`;
* `guess_values`, if its parameters follow from data in closed form.

Example: `loopcal.measure.kinds.distance`. Shapes: t trials, r rows, c columns as in files,
m residuals (often c), u nuisance parameters of the kind, j joints that it senses. A kind with
`poses_per_row` l > 1 has an axis l for the poses that a row compares: T (t, r, l, 4, 4), jacobian
(t, r, l, m, 6). Values of nuisance parameters are plain numbers that add up;
`loopcal.measure.kinds.setup_parameters` says how a frame or a direction is written in them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self, cast

import numpy as np

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.measure.array_checks import set_fields
from loopcal.measure.kinds.setup_parameters import SetupItem
from loopcal.mechanism.chains import name_platform_entries
from loopcal.numerics.elimination import without_rounding
from loopcal.numerics.statistics import find_distinct
from loopcal.parameters import Parameter
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

# --- Rows of a kind: their columns, residuals and derivatives, and rows that are invalid.

InvalidRows = tuple[tuple[int, str], ...]
"""Index of each invalid row, and the end of a sentence that says why."""


@dataclass(frozen=True)
class Column:
    """A column of a measurement file: its name, and the dimension of its numbers."""

    name: str
    dimension: Dimension


POSITION_COLUMNS = tuple(Column(name, Dimension.LENGTH) for name in ("x", "y", "z"))
"""Columns of a position."""


class Evaluation(NamedTuple):
    """Residuals (predicted - measured) and their derivatives.

    Components that were not measured are zero in all arrays.

    Attributes
    ----------
    residual : (t, r, m) [SI]
    jacobian : (t, r, m, 6)
        By the platform twist (omega, v) in base axes; with an axis of poses before m where a row
        compares several poses.
    nuisance : (t, r, m, u) or None
        By the nuisance parameters of the kind; None where it has none.
    joints : (t, r, m, j) or None
        By the values of the joints that the kind senses; None where it senses poses only.
    """

    residual: FloatArray
    jacobian: FloatArray
    nuisance: FloatArray | None = None
    joints: FloatArray | None = None


class MeasuredColumns(NamedTuple):
    """Columns of rows as a kind compares its predictions with them, see `Kind.prepare_columns`.

    Attributes
    ----------
    columns : (t, r, c) [SI], with a placeholder where nothing was measured.
    reference : (t, r, k) the columns, or what a kind computes from them alone.
    present : (t, r, m) residuals that exist. is_complete : whether all do.
    """

    columns: FloatArray
    reference: FloatArray
    present: BoolArray
    is_complete: bool

    def take(self, trials: IntArray) -> MeasuredColumns:
        """Return the columns of some trials."""
        arrays = (self.columns[trials], self.reference[trials], self.present[trials])
        return MeasuredColumns(*arrays, self.is_complete)


def list_rows(wrong: BoolArray, describe: Callable[[int], str]) -> InvalidRows:
    """Return the rows of a mask (r,), each with its description."""
    return tuple((int(i), describe(int(i))) for i in np.flatnonzero(wrong))


def is_incomplete(columns: FloatArray) -> BoolArray:
    """Return the rows of columns (.., c) in which some values are missing, but not all."""
    missing = np.isnan(columns)
    return np.any(missing, axis=-1) & ~np.all(missing, axis=-1)


def drop_rounding(evaluation: Evaluation) -> Evaluation:
    """Return the evaluation with zeros where derivatives by nuisance parameters cancel, as those by
    the place of a target do between parallel poses.

    They are compared with derivatives by the platform twist. A meter is compared with a radian
    there; the tolerance is so small that the size of a machine does not matter.
    """
    if evaluation.nuisance is None:
        return evaluation
    by_twist = np.linalg.norm(evaluation.jacobian, axis=-1)
    by_twist = by_twist.sum(axis=-2) if evaluation.jacobian.ndim > 4 else by_twist
    return evaluation._replace(nuisance=without_rounding(evaluation.nuisance, by_twist[..., None]))


def zero_absent(evaluation: Evaluation, present: BoolArray) -> Evaluation:
    """Return the evaluation with zeros for components that are not `present` (t, r, m)."""
    by_row = present[..., None]
    has_links = evaluation.jacobian.ndim > present.ndim + 1
    by_nuisance, by_joints = (
        None if derivative is None else np.where(by_row, derivative, 0.0)
        for derivative in (evaluation.nuisance, evaluation.joints)
    )
    return Evaluation(
        np.where(present, evaluation.residual, 0.0),
        np.where(present[..., None, :, None] if has_links else by_row, evaluation.jacobian, 0.0),
        by_nuisance,
        by_joints,
    )


# --- The settings of a kind that differ from their defaults, as text.


def list_changed_settings(kind: Any) -> Iterator[str]:
    """Give `name=value` of each setting of a kind (a dataclass) that differs from its default."""
    for setting in fields(kind):
        value, factory = getattr(kind, setting.name), setting.default_factory
        usual = cast(Any, setting.default) if factory is MISSING else factory()
        if setting.init and not np.array_equal(value, usual):
            text = repr(value)
            if isinstance(value, np.ndarray):
                is_small = value.size <= 16
                text = f"{np.round(value, 6).tolist() if is_small else f'<array {value.shape}>'}"
            yield f"{setting.name}={text}"


# --- The errors that the residuals of a kind are: of which quantity, and of which target.


class ErrorGroup(NamedTuple):
    """Residuals that are the components of one error.

    Attributes
    ----------
    quantity : what the error is of, such as "position" or "length". dimension : of its number.
    target : name of the target or joint, empty where a row has only one.
    components : names of the components, such as ("x", "y", "z").
    columns : their indices among the m residuals.
    """

    quantity: str
    dimension: Dimension
    target: str
    components: tuple[str, ...]
    columns: tuple[int, ...]


def list_error_groups(kind: Kind) -> tuple[ErrorGroup, ...]:
    """Return the errors of one row of a kind."""
    residuals = kind.noise_columns
    targets = {"": tuple(range(len(residuals)))}
    if kind.sensed_joints and not kind.of:
        targets = {name: (i,) for i, name in enumerate(kind.sensed_joints)}
    elif residuals == kind.columns:
        targets = dict(kind.target_columns)
    quantities = {Dimension.LENGTH: kind.length_error, Dimension.ANGLE: kind.angle_error}
    groups = []
    for target, places in targets.items():
        for dimension, quantity in quantities.items():
            columns = tuple(i for i in places if residuals[i].dimension is dimension)
            names = tuple(residuals[i].name.removeprefix(f"{target}.") for i in columns)
            if columns:
                label = target if len(targets) > 1 else ""
                groups.append(ErrorGroup(quantity, dimension, label, names, columns))
    return tuple(groups)


# --- Errors that all rows of a session share, as unknowns of any kind: a bias, and a linear drift.

BIAS, DRIFT = "bias", "drift"
SHARED_ERRORS = (BIAS, DRIFT)
"""Setup items that any kind may list as unknown."""


def list_components(kind: Kind) -> dict[tuple[str, Dimension], list[int]]:
    """Return the measured components of a kind with the indices of their noise columns: x of all
    targets is one component.
    """
    members: dict[tuple[str, Dimension], list[int]] = {}
    for group in list_error_groups(kind):
        for name, column in zip(group.components, group.columns, strict=True):
            members.setdefault((name, group.dimension), []).append(column)
    return members


def name_shared_error(kind: Kind, item: str, component: str) -> str:
    """Return the name of the bias or drift of a component, such as `tracker.bias.x`: with the name
    of the fixed point or frame where the settings state one, else that of the kind.
    """
    owner = kind.name
    for setting in ("frame", "anchor_name"):
        value = getattr(kind, setting, "")
        if value and value != getattr(type(kind), setting):
            owner = value
    return f"{owner}.{item}.{component}"


def make_shared_errors(kind: Kind) -> Mapping[str, SetupItem]:
    """Return the bias and the drift of a kind: one parameter for each component."""
    return {
        item: SetupItem(
            tuple(
                Parameter(name_shared_error(kind, item, component), dimension, 0.0, scope="session")
                for component, dimension in list_components(kind)
            )
        )
        for item in SHARED_ERRORS
    }


def spread_components(kind: Kind) -> FloatArray:
    """Return the matrix (m, b) that adds a value for each component to its noise columns."""
    components = list_components(kind).values()
    matrix = np.zeros((len(kind.noise_columns), len(components)))
    for i, columns in enumerate(components):
        matrix[columns, i] = 1.0
    return matrix


def sum_shared_errors(kind: Kind, values: FloatArray) -> FloatArray:
    """Return the errors (.., b) of the components, from the values (.., u) of the nuisance
    parameters: of the drift, those are the parts that the rows take.
    """
    items = [kind.item_values(values, name) for name in kind.shared_errors]
    return np.asarray(sum(item for item in items if item is not None))


def add_shared_errors(
    kind: Kind, evaluation: Evaluation, measured: FloatArray, values: FloatArray
) -> Evaluation:
    """Return the evaluation of rows whose noise columns share a bias and a drift.

    Parameters
    ----------
    evaluation : without them. measured : (.., r, c) [SI]. values : (.., r, u) of all nuisance
        parameters.
    """
    slope = kind.linearize_noise(measured) @ spread_components(kind)
    error = slope @ sum_shared_errors(kind, values)[..., None]
    residual = evaluation.residual + error[..., 0]
    shape = residual.shape
    columns = [np.broadcast_to(slope, (*shape, slope.shape[-1]))] * len(kind.shared_errors)
    if evaluation.nuisance is not None:
        own = np.broadcast_to(evaluation.nuisance, (*shape, evaluation.nuisance.shape[-1]))
        columns.insert(0, own)
    return evaluation._replace(residual=residual, nuisance=np.concatenate(columns, axis=-1))


def measure_progress(session: np.ndarray, time: FloatArray | None) -> FloatArray:
    """Return the progress (r,) of rows through their session, from -0.5 to 0.5: by time [s] where
    all rows state one, else in their order.

    Parameters
    ----------
    session : (r,) its name. time : (r,) or None.
    """
    known = time is not None and bool(np.isfinite(time).all())
    progress = np.zeros(len(session))
    for name in find_distinct(session):
        chosen = np.flatnonzero(session == name)
        values = time[chosen] if known and time is not None else np.arange(float(len(chosen)))
        low, high = values.min(), values.max()
        if high > low:
            progress[chosen] = (values - 0.5 * (low + high)) / (high - low)
    return progress


# --- Rows that measure another body than the end platform: that of a stage of a chain, or the
# base.

BASE = "base"
"""Name of the base among the bodies that a kind may be `of`; no stage has it."""


def check_stage(kind: str, of: str, poses_per_row: int, measures_points: bool) -> None:
    """Refuse a stage of a kind that compares poses, and the base of one that measures no points.

    Raises
    ------
    DataError
    """
    if of and poses_per_row > 1:
        raise DataError(
            f"the kind {kind!r} compares poses of the end platform; leave out `of: {of}`"
        )
    if of == BASE and not measures_points:
        raise DataError(
            f"the kind {kind!r} measures a moving body, but `of: {BASE}` is for targets that are "
            "fixed to the base; leave it out, or use the kind position, bearing or distance"
        )


def list_sensed_numbers(of: str) -> tuple[str, ...]:
    """Return the names of the numbers of the platform of a stage; none without a stage, or of the
    base.
    """
    return name_platform_entries(of) if of not in ("", BASE) else ()


def find_platform(of: str, T: FloatArray, joints: FloatArray) -> FloatArray:
    """Return the measured platforms (.., 4, 4): T, those of the stage `of`, or the base.

    joints : (.., 12) of a stage.

    Raises
    ------
    DataError
        The numbers of the stage's platform are missing.
    """
    if not of:
        return T
    if of == BASE:
        return np.broadcast_to(np.eye(4), T.shape)
    if joints.shape[-1] != 12:
        raise DataError(f"the platform of stage {of!r} is not given; pass its numbers as `joints`")
    rows = joints.reshape(*joints.shape[:-1], 3, 4)
    last = np.broadcast_to(np.eye(4)[3:], (*rows.shape[:-2], 1, 4))
    return np.concatenate([rows, last], axis=-2)


def depend_on_platform(of: str, result: Evaluation, T: FloatArray) -> Evaluation:
    """Return an evaluation at platforms T (t, r, 4, 4), of a stage by the numbers of its platform.

    Its rows do not depend on the twist of the end platform, those of the base on no motion.
    """
    if not of:
        return result
    if of == BASE:
        return result._replace(jacobian=np.zeros_like(result.jacobian))
    by_entries = result.jacobian @ geometry.differentiate_by_entries(T)
    return result._replace(jacobian=np.zeros_like(result.jacobian), joints=by_entries)


class Kind(ABC):
    """A kind of measurement with its fixed settings (frame, tool, form of the orientation).

    Attributes
    ----------
    name : str
        Name in files and in `KINDS`.
    poses_per_row : int
        Number of poses that one row compares.
    changes_with_pose : bool
        Whether columns that stay constant while the robot moves indicate a mistake. It is False for
        touched surfaces and for locked joints, whose columns stay at 0.
    mixes_components : bool
        Whether a motion of base and setup mixes the components of a residual, so that rows contain
        it in proportion to the residual; see docs/theory/identification.md.
    wraps_angles : bool
        Whether differences of angles are wrapped into (-pi, pi].
    description : str
        What is measured, for suggestions to measure it with known setup; else "the" and the name.
    length_error, angle_error : str
        What its residuals are errors of, by dimension, such as "position"; see `list_error_groups`.
    allowed_unknown : tuple of str
        Setup items that `unknown` may list.
    unknown : tuple of str
        Setup items that are unknown.
    measures_points : bool
        Whether it measures targets, which may be fixed to the base (`of: base`).
    of : str
        The stage of a chain whose platform is measured, or "base"; empty for the end platform.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]  # every kind is a dataclass
    name: ClassVar[str]
    poses_per_row: ClassVar[int] = 1
    changes_with_pose: ClassVar[bool] = True
    mixes_components: ClassVar[bool] = False
    wraps_angles: ClassVar[bool] = True
    measures_points: ClassVar[bool] = False
    description: ClassVar[str] = ""
    length_error: ClassVar[str] = "length"
    angle_error: ClassVar[str] = "angle"
    allowed_unknown: ClassVar[tuple[str, ...]] = ()
    unknown: tuple[str, ...] = ()
    of: str = ""

    def __post_init__(self) -> None:
        names = (self.unknown,) if isinstance(self.unknown, str) else tuple(self.unknown)
        allowed = (*self.allowed_unknown, *SHARED_ERRORS)
        for name in (name for name in names if name not in allowed):
            sentence = f"{name!r} cannot be unknown in the kind {self.name!r}"
            raise DataError(f"{sentence}; allowed are {', '.join(allowed)}")
        set_fields(self, unknown=names)
        check_stage(self.name, self.of, self.poses_per_row, self.measures_points)

    def __repr__(self) -> str:
        """Return the settings that differ from their defaults, on one line."""
        return f"{type(self).__name__}({', '.join(list_changed_settings(self))})"

    # --- what a kind states about itself

    @property
    @abstractmethod
    def columns(self) -> tuple[Column, ...]:
        """The c columns of a row, as in files."""

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
    def is_of_base(self) -> bool:
        """Whether its targets are fixed to the base, so that its rows depend on no pose."""
        return self.of == BASE

    @property
    def sensed_joints(self) -> tuple[str, ...]:
        """Names of the j joints, driven or passive, whose values the residual depends on."""
        return list_sensed_numbers(self.of)

    def stack_joints(self, joints: Mapping[str, FloatArray], rows: IntArray) -> FloatArray | None:
        """Return the values (.., r, j) of the sensed joints at the poses of rows (r,), from those
        of all joints by name (.., n); None where it senses none. DataError if one is missing.
        """
        for name in (name for name in self.sensed_joints if name not in joints):
            sentence = f"the kind {self.name!r} needs the values of joint {name!r}"
            raise DataError(f"{sentence}; pass them as `joints`")
        columns = [joints[name][..., rows] for name in self.sensed_joints]
        return np.stack(columns, axis=-1) if columns else None

    @classmethod
    @abstractmethod
    def examples(cls) -> tuple[Kind, ...]:
        """Return instances that together show every setting, for documentation and tests."""

    def with_tool(self, T_platform_tool: FloatArray) -> Self:
        """Return the kind for a robot with this tool (4, 4).

        It is the same object where the tool does not matter or is stated.
        """
        del T_platform_tool
        return self

    @property
    def has_tool(self) -> bool:
        """Whether the kind knows the tool, or does not need it."""
        return True

    # --- setup items and their parameters, computed once

    @cached_property
    def setup_items(self) -> Mapping[str, SetupItem]:
        """The setup items that are unknown, in order; errors that rows share come last."""
        possible = {**self.possible_setup, **make_shared_errors(self)}
        return {**self.own_items, **{name: possible[name] for name in self.shared_errors}}

    @cached_property
    def own_items(self) -> Mapping[str, SetupItem]:
        """The frames, targets, surfaces and offsets that are unknown, in order."""
        possible = self.possible_setup
        return {name: possible[name] for name in self.unknown if name not in SHARED_ERRORS}

    @property
    def shared_errors(self) -> tuple[str, ...]:
        """Which of "bias" and "drift" are unknown."""
        return tuple(name for name in SHARED_ERRORS if name in self.unknown)

    @cached_property
    def is_drift(self) -> BoolArray:
        """(u,) nuisance parameters of which a row takes the part of its progress."""
        items = self.setup_items.items()
        return np.array([name == DRIFT for name, item in items for _ in item.parameters], bool)

    @cached_property
    def nuisance_parameters(self) -> tuple[Parameter, ...]:
        """The u parameters of all unknown items; rows of one scope share a value."""
        return tuple(p for item in self.setup_items.values() for p in item.parameters)

    def without_shared_errors(self) -> Self:
        """Return the kind without a bias or drift."""
        return replace(cast(Any, self), unknown=tuple(self.own_items))

    @property
    def references(self) -> Mapping[str, FloatArray]:
        """The stated orientations or points that parameters are counted from, by name.

        Kinds that share a name must agree on them.
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

    def assemble_values(self, items: Mapping[str, FloatArray]) -> FloatArray:
        """Return candidates (k, u) from values (k, w) or (w,) of some setup items; the other items
        stay nominal.
        """
        nominal = self.nominal_values
        columns = [
            np.atleast_2d(items.get(name, nominal[used])) for name, used in self._slices.items()
        ]
        count = max(len(values) for values in columns)
        return np.concatenate([np.broadcast_to(v, (count, v.shape[1])) for v in columns], axis=-1)

    def guess_values(self, T: FloatArray, measured: FloatArray) -> FloatArray:
        """Return candidates (k, u) for the nuisance parameters that rows share.

        They follow from poses T (r, 4, 4) and columns (r, c), in closed form where there is one.
        `loopcal.measure.initial_values` refines and compares them.
        """
        del T, measured
        return self.nominal_values[None]

    # --- rows

    def detect_present(self, measured: FloatArray) -> BoolArray:
        """Return which residuals (..., m) exist for columns (..., c); NaN is not measured."""
        return ~np.isnan(measured)

    def find_invalid_rows(self, measured: FloatArray) -> InvalidRows:
        """Return rows of columns (r, c) with impossible values: (index, end of a sentence)."""
        del measured
        return ()

    @property
    def placeholder(self) -> FloatArray:
        """Values (c,), or one for all columns (1,), in place of those that were not measured."""
        return np.zeros(1)

    def prepare_columns(self, measured: FloatArray) -> MeasuredColumns:
        """Return columns (.., r, c) as `evaluate` needs them, to evaluate the same rows often."""
        missing = np.isnan(measured)
        columns = np.where(missing, self.placeholder, measured) if np.any(missing) else measured
        present, reference = self.detect_present(measured), self._compute_reference(columns)
        return MeasuredColumns(columns, reference, present, bool(np.all(present)))

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
        T : (t or 1, r, 4, 4)
            T_base_platform of each row (with an axis of poses where a row compares several).
        measured : (t or 1, r, c) [SI]
            NaN where not measured. Or the same prepared by `prepare_columns`.
        nuisance : (t or 1, r or 1, u), optional
            Values of the nuisance parameters of each row; default: nominal.
        joints : (t, r, j), optional
            Values of the joints in `sensed_joints`.

        Raises
        ------
        DataError
            If the kind senses joints and none are given.
        """
        if joints is None:
            self.stack_joints({}, np.zeros(0, dtype=np.intp))  # refuses where it senses any
            joints = np.empty((1, 1, 0))
        if not isinstance(measured, MeasuredColumns):
            measured = self.prepare_columns(measured)
        values = self.nominal_values[None, None] if nuisance is None else nuisance
        T = find_platform(self.of, T, joints)
        if len(values) > len(T):
            T = np.broadcast_to(T, (len(values), *T.shape[1:]))
        result = drop_rounding(self._evaluate(T, measured.reference, values, joints))
        result = depend_on_platform(self.of, result, T)
        if self.shared_errors:
            result = add_shared_errors(self, result, measured.columns, values)
        return result if measured.is_complete else zero_absent(result, measured.present)

    def measure(
        self,
        T: FloatArray,
        noise: FloatArray,
        nuisance: FloatArray | None = None,
        joints: FloatArray | None = None,
    ) -> FloatArray:
        """Return the columns that an instrument with this noise writes.

        Parameters
        ----------
        T : (t, r, 4, 4) true T_base_platform. noise : (t, r, m) in the noise columns.
        nuisance : (t or 1, r or 1, u), default nominal. joints : (t, r, j), default zero.

        Returns
        -------
        measured : (t, r, c) [SI]
            With `evaluate(T, measured).residual = -linearize_noise(measured) noise` to first order.
        """
        values = self.nominal_values[None, None] if nuisance is None else nuisance
        joints = np.zeros_like(noise) if joints is None else joints
        if self.shared_errors:
            noise = noise + sum_shared_errors(self, values) @ spread_components(self).T
        T = find_platform(self.of, T, joints)
        return self._measure(T, noise, values, joints)

    def linearize_noise(self, measured: FloatArray) -> FloatArray:
        """Return the derivative (..., m, m) of the residuals by errors of the noise columns, up to
        its sign.
        """
        m = len(self.noise_columns)
        return np.broadcast_to(np.eye(m), (*measured.shape[:-1], m, m))

    # --- for the kinds themselves

    def _predict(self, T: FloatArray, values: FloatArray, joints: FloatArray) -> Evaluation:
        """Return columns without noise in place of residuals, and their derivatives."""
        raise NotImplementedError

    def _compute_reference(self, measured: FloatArray) -> FloatArray:
        """Return what `_evaluate` receives in place of complete columns (.., r, c): (.., r, k)."""
        return measured

    def _evaluate(
        self, T: FloatArray, measured: FloatArray, values: FloatArray, joints: FloatArray
    ) -> Evaluation:
        """Return `evaluate` for complete arrays, `measured` from `_compute_reference`; it may have
        any finite value where nothing was measured.
        """
        predicted = self._predict(T, values, joints)
        return predicted._replace(residual=self._subtract(predicted.residual, measured))

    def _measure(
        self, T: FloatArray, noise: FloatArray, values: FloatArray, joints: FloatArray
    ) -> FloatArray:
        """Return `measure` for complete arrays."""
        return self._predict(T, values, joints).residual + noise

    def _subtract(self, predicted: FloatArray, measured: FloatArray) -> FloatArray:
        """Return the difference of columns (.., c), angles wrapped."""
        difference = predicted - measured
        if not any(self._is_wrapped):
            return difference
        return np.where(np.array(self._is_wrapped), geometry.wrap_angle(difference), difference)

    @cached_property
    def _is_wrapped(self) -> tuple[bool, ...]:
        """Columns whose differences are wrapped."""
        return tuple(self.wraps_angles and c.dimension is Dimension.ANGLE for c in self.columns)

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
        """Return the evaluation of residuals (t, r, m) with derivatives (t, r, m, 6 + u) from
        `join_columns`.
        """
        return Evaluation(residual, rows[..., :6], rows[..., 6:] if self.own_items else None)
