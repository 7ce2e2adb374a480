# SPDX-License-Identifier: Apache-2.0
"""Measurements: the actuator readings at n poses, and the observations made at them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import DataError
from loopcal.measure import array_checks
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.nuisance import NuisanceParameters, StatedValue, collect_nuisance_parameters
from loopcal.measure.observations import Observations, check_poses
from loopcal.measure.readings import (
    check_reading_sigma,
    find_reading_tolerance,
    find_repeats,
    weight_reading_sigma,
)
from loopcal.numerics.elimination import find_connected_groups
from loopcal.numerics.statistics import find_distinct, find_distinct_rows
from loopcal.results.description import Field, label_axes
from loopcal.results.result import TableResult
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import SI_SYMBOLS


def _check_bodies(of_poses: Sequence[Observations], of_base: Sequence[Observations]) -> None:
    """Refuse rows of the base among those of poses, the reverse, and a target on two bodies."""
    kinds = [rows.kind for rows in (*of_poses, *of_base)]
    for i, kind in enumerate(kinds):
        if kind.is_of_base != (i >= len(of_poses)):
            fault = 'poses. Pass them as `observations`, or give their kind `of="base"`'
            if kind.is_of_base:
                fault = "targets on the base. Pass them as `base_observations`, not `observations`"
            raise DataError(f"rows of kind {kind.name!r} measure {fault}")
        if kind.is_of_base and (shared := list_moving_targets(kind, kinds)):
            raise DataError.of("data.target-on-two-bodies", targets=shared)


def list_moving_targets(kind: Kind, others: Iterable[Kind]) -> tuple[str, ...]:
    """Return the targets of a kind of the base that are on a platform by another kind."""
    others = [other for other in others if not other.is_of_base]
    moving = {target for other in others for target in getattr(other, "targets", ())}
    return tuple(target for target in kind.target_columns if target in moving)


def anchor_rows(rows: Observations, observations: Sequence[Observations]) -> IntArray:
    """Return a pose (r,) for each row of the base, on which its numbers do not depend.

    It is the first pose of the same session (else of all) that another row needs, so that nothing
    is solved for its sake, and no session is joined with another.
    """
    first: dict[str, int] = {}
    needed: list[int] = []
    for other in observations:
        counted = (other.weight > 0.0) & other.is_measured
        poses = other.rows.reshape(len(other), other.kind.poses_per_row)[counted, 0].tolist()
        needed += poses[:1]
        for pose, session in zip(poses, other.session[counted].tolist(), strict=True):
            first.setdefault(session, pose)
    usual = needed[0] if needed else 0
    poses = [first.get(session, usual) for session in rows.session.tolist()]
    return np.array(poses, dtype=np.intp)


OF_POSES = ("readings", "reading_sigma", "block", "is_held_out")  # attributes (n, ..), or None


@dataclass(frozen=True, eq=False, repr=False)
class Measurements(TableResult):
    """Everything measured on one robot.

    Parameters
    ----------
    readings : (n, a) [SI], actuator readings at each pose.
    observations : their rows are indices of poses.
    block : (n,) int, poses of equal number belong together (repeats, a shared covariance) and are
        never split. Default: each pose is a block.
    labels : names of the poses, for messages and tables. Default "1", "2", ...
    reading_sigma : (n, a) or an array that broadcasts to it [SI], standard deviation of each
        reading: 0 is exact, infinity is missing or ignored. A reading may be NaN only where its
        sigma is infinite. Default None: exact, unless the robot states the sigma of its actuators.
    stated_values : priors and fixed values of nuisance parameters; others are estimated.
    base_observations : rows of targets that are fixed to the base (kinds with `of="base"`). They
        belong to no pose: whatever poses are taken, held out or weighted, these rows stay, and they
        are no errors of poses.
    is_held_out : (n,) bool, poses that are held out for validation, as the column `use` of a file
        states. A calibration validates on them, and no fit uses them. Default: none.

    Raises
    ------
    DataError : shapes differ, a number is not finite, a row refers to a pose that does not exist, a
        block is partly held out, or a target is on the base and on a platform.
    """

    robot_name: str
    readings: FloatArray
    observations: tuple[Observations, ...]
    block: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    labels: tuple[str, ...] = ()
    reading_sigma: FloatArray | None = None
    stated_values: tuple[StatedValue, ...] = ()
    is_held_out: BoolArray = field(default_factory=lambda: np.empty(0, dtype=bool))
    base_observations: tuple[Observations, ...] = ()

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *(
            Field(name, lambda data, i=i: [row[i] for row in data.list_values()], "number")
            for i, name in enumerate(("kind", "pose", "component", "unit", "value"))
        ),
        Field("reading", "readings", "measured_pose actuator", "m or rad"),
        Field("held_out", "is_held_out", "measured_pose"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(measured_pose="labels")

    def __post_init__(self) -> None:
        readings = array_checks.check_array(self.readings, "readings", (None, None), allow_nan=True)
        if self.reading_sigma is None:
            array_checks.refuse_first(
                np.isnan(readings),
                lambda i, j: (
                    f"readings: row {i + 1}, column {j + 1} is nan. Give a finite number, "
                    f"or reading_sigma = inf if it is missing"
                ),
            )
        n = len(readings)
        if n == 0:
            raise DataError("the measurements have no pose. Give at least one row of readings")
        block = np.array(self.block if len(self.block) else np.arange(n))
        if block.shape != (n,) or not np.issubdtype(block.dtype, np.integer):
            raise DataError(
                f"block has shape {block.shape} and type {block.dtype}. Give one whole number for "
                "each pose"
            )
        block.setflags(write=False)
        labels = tuple(self.labels) or tuple(str(i + 1) for i in range(n))
        if len(labels) != n:
            raise DataError(f"{len(labels)} labels for {n} poses. Give one for each")
        for rows in self.observations:
            array_checks.check_type(
                rows, Observations, "observations", "such as loopcal.Observations.from_sigma(...)"
            )
            check_poses(rows.rows, rows.kind, n)
        array_checks.set_fields(
            self,
            readings=readings,
            block=block,
            labels=labels,
            observations=tuple(self.observations),
            base_observations=tuple(self.base_observations),
            is_held_out=_check_held_out(self.is_held_out, block, labels),
        )
        _check_bodies(self.observations, self.base_observations)
        if self.reading_sigma is not None:
            sigma = check_reading_sigma(self.reading_sigma, readings, labels)
            array_checks.set_fields(self, reading_sigma=sigma)

    def __repr__(self) -> str:
        n, a = self.readings.shape
        lines = [f"Measurements of {self.robot_name!r}: {n} poses, {a} actuator readings each"]
        lines += [f"  {rows!r}" for rows in self.observations[:8]]
        lines += [f"  {rows!r}" for rows in self.base_observations]
        if len(self.observations) > 8:
            lines.append(f"  and {len(self.observations) - 8} more")
        if self.reading_sigma is not None:
            lines.append("  with uncertain readings")
        return "\n".join(lines)

    def list_values(self) -> list[tuple[str, str, str, str, float]]:
        """Return kind, pose, component, unit and value [SI] of every measured number."""
        return [
            (
                o.kind.name,
                "/".join(self.labels[i] for i in poses),
                column.name,
                SI_SYMBOLS[column.dimension],
                value,
            )
            for o in self.observations
            for poses, values in zip(o.rows.reshape(len(o), -1), o.measured.tolist(), strict=True)
            for column, value in zip(o.kind.columns, values, strict=True)
        ]

    @property
    def n_poses(self) -> int:
        """Number of poses n."""
        return len(self.readings)

    @property
    def all_observations(self) -> tuple[Observations, ...]:
        """The observations of poses, then those of targets on the base."""
        return (*self.observations, *self.base_observations)

    @property
    def n_rows(self) -> int:
        """Number of scalar residuals of poses that count: present, with a weight above 0."""
        return sum(rows.n_residuals for rows in self.observations)

    @property
    def n_base_rows(self) -> int:
        """Number of scalar residuals of targets on the base that count."""
        return sum(rows.n_residuals for rows in self.base_observations)

    @cached_property
    def repeats(self) -> IntArray:
        """(n,) number of the pose that each pose repeats, see `loopcal.measure.readings`."""
        readings, sigma = self.readings, self.reading_sigma
        return find_repeats(readings, find_reading_tolerance(readings, self.observations, sigma))

    @property
    def undivided(self) -> IntArray:
        """(n,) number of the poses that stay together where some are held out: blocks, and all that
        repeat a pose of the block, because a repeat of a fitted pose says nothing of other poses.
        """
        names, block = np.unique(self.block, return_inverse=True)
        order = np.argsort(self.repeats, kind="stable")
        repeated = np.flatnonzero(np.diff(self.repeats[order]) == 0)
        links = np.column_stack([block[order[repeated]], block[order[repeated + 1]]])
        return find_connected_groups(links, len(names))[block]

    @property
    def noise_source(self) -> str:
        """Whether the noise of the rows is "stated", "assumed", or "mixed"."""
        assumed = {rows.is_noise_assumed for rows in self.observations}
        return "mixed" if len(assumed) > 1 else "assumed" if True in assumed else "stated"

    @cached_property
    def nuisance_parameters(self) -> NuisanceParameters:
        """The nuisance parameters of the observations, with their stated values."""
        return collect_nuisance_parameters(self.all_observations, self.labels, self.stated_values)

    @property
    def context(self) -> Mapping[str, FloatArray]:
        """Time [s] and temperatures [degC] (n,) by name: means of the rows of a pose, or NaN."""
        means: dict[str, FloatArray] = {}
        for name in dict.fromkeys(name for rows in self.observations for name in rows.context):
            total, count = np.zeros(self.n_poses), np.zeros(self.n_poses)
            for rows in (rows for rows in self.observations if name in rows.context):
                poses = rows.rows.reshape(len(rows), rows.kind.poses_per_row)
                values = np.broadcast_to(rows.context[name][:, None], poses.shape)
                present = ~np.isnan(values)
                np.add.at(total, poses[present], values[present])
                np.add.at(count, poses[present], 1.0)
            nothing = np.full(self.n_poses, np.nan)
            means[name] = np.divide(total, count, out=nothing, where=count > 0.0)
        return means

    @property
    def fitted(self) -> Self:
        """The measurements without the held-out poses; raises DataError where none is left."""
        return self.take(~self.is_held_out) if self.is_held_out.any() else self

    def take(self, poses: ArrayLike) -> Self:
        """Return the measurements of these poses (k,), in their order, or of a mask (n,); DataError
        where a pose does not exist, is named twice, or none is left.

        Rows of other poses are left out; those of targets on the base stay.
        """
        given = np.asarray(poses)
        is_mask = given.dtype == bool
        if given.size and not is_mask and not np.issubdtype(given.dtype, np.integer):
            raise DataError(
                f"poses: got an array of type {given.dtype}. Give indices, or a mask of booleans"
            )
        if is_mask and given.shape != (self.n_poses,):
            raise DataError(
                f"the mask of poses has shape {given.shape}. Give ({self.n_poses},), one for each "
                "pose"
            )
        chosen = np.flatnonzero(given) if is_mask else given.astype(np.intp)
        outside = (chosen < 0) | (chosen >= self.n_poses)
        if np.any(outside) or len(find_distinct(chosen)) < len(chosen) or not len(chosen):
            raise DataError(
                f"cannot take poses {chosen.tolist()}. Give at least one of 0 to "
                f"{self.n_poses - 1}, each once"
            )
        place = np.full(self.n_poses, -1)
        place[chosen] = np.arange(len(chosen))
        observations = []
        for rows in self.observations:
            target = place[rows.rows]
            kept = np.all(target.reshape(len(rows), rows.kind.poses_per_row) >= 0, axis=1)
            observations.append(rows.take(kept, target[kept]))
        of_poses: dict[str, Any] = {
            name: None if values is None else values[chosen]
            for name in OF_POSES
            for values in (getattr(self, name),)
        }
        labels = tuple(self.labels[i] for i in chosen)
        return replace(self, observations=tuple(observations), labels=labels, **of_poses)

    def split(
        self, *, hold_out: float, seed: int, regions: IntArray | None = None
    ) -> tuple[Self, Self]:
        """Split the poses at random into a set to fit and a held-out set.

        Blocks and repeats of a pose are not split (`undivided`), and the poses to fit determine
        every frame, target and surface as far as possible, see `choose_fitted`. The poses of each
        set keep their order.

        Parameters
        ----------
        hold_out : share of the poses that is not fitted (0.25 fits three poses of four), as nearly
            as whole blocks allow; both sets get at least one block. DataError unless it is between
            0 and 1, or where all poses are in one block.
        seed : the same seed gives the same sets. regions : (n,) numbers of sets of poses that are
            not split either.
        """
        array_checks.check_seed(seed)
        if not 0.0 < hold_out < 1.0:
            raise DataError(
                f"cannot hold out a share of {hold_out}. Give the share of the poses outside the "
                "fit, above 0 and below 1, such as 0.25"
            )
        fitted = choose_fitted(self, hold_out, seed, regions)
        return self.take(fitted), self.take(~fitted)

    def with_weights(self, weight: ArrayLike) -> Self:
        """Return the same measurements with one weight (n,) for each pose.

        A row that compares poses gets the product of their weights. Uncertain readings are weighted
        like those of their pose: sigma / sqrt(weight). `Observations.with_weights` : single rows.

        Raises
        ------
        DataError : the number of weights is not that of the poses, or one is negative.
        """
        given = array_checks.check_array(weight, "the weight of the poses", (self.n_poses,))
        observations = tuple(
            rows.with_weights(given[rows.rows].reshape(len(rows), -1).prod(axis=1))
            for rows in self.observations
        )
        sigma = weight_reading_sigma(self.reading_sigma, given)
        return replace(self, observations=observations, reading_sigma=sigma)


def _check_held_out(is_held_out: ArrayLike, block: IntArray, labels: tuple[str, ...]) -> BoolArray:
    """Return the mask of held-out poses (n,), read-only; none where it is empty."""
    given = np.array(is_held_out, dtype=bool)
    mask = given if given.size else np.zeros(len(block), dtype=bool)
    if mask.shape != block.shape:
        raise DataError(
            f"is_held_out has shape {mask.shape}. Give one boolean for each of {len(block)} poses"
        )
    for i in np.flatnonzero(mask & np.isin(block, block[~mask]))[:1]:
        j = np.flatnonzero((block == block[i]) & ~mask)[0]
        raise DataError.of("data.block-partly-held-out", held_out=labels[i], fitted=labels[j])
    mask.setflags(write=False)
    return mask


ENOUGH = 0.5  # share of the poses to hold out that the setup must leave


class _SetupValues(NamedTuple):
    """How many values e different poses measure with each frame, target, surface and offset."""

    owner: IntArray  # (e,) which frame, target, surface or offset
    pose: IntArray  # (e,) the pose, of repeats only one
    values: IntArray  # (e,) number of its measured values
    needed: IntArray  # (o,) number of unknown parameters of each owner

    def find_needed(self, unit: IntArray, rank: IntArray) -> tuple[BoolArray, BoolArray]:
        """Return which units of poses (u,) determine the setup, those of low rank first; and which
        entries (e,) belong to owners that need all of their units, of two or more.

        unit : (n,) of each pose. rank : (u,) of each unit in the order of the choice.
        """
        pairs, member = np.unique(
            np.column_stack([self.owner, rank[unit[self.pose]]]), axis=0, return_inverse=True
        )
        owner, place = pairs.T
        begin = np.searchsorted(owner, np.arange(len(self.needed)))
        after = np.cumsum(np.bincount(member.ravel(), self.values, len(pairs)))
        before = np.concatenate([[0.0], after])[:-1]
        is_short = before - before[begin[owner]] < self.needed[owner]
        last = begin + np.bincount(owner, is_short, len(begin)).astype(np.intp)
        is_needed = np.arange(len(pairs)) <= last[owner]  # those that are short, and one more
        is_needed &= np.bincount(owner)[owner] > 1
        is_whole = np.bincount(owner, ~is_needed, len(begin)) == 0
        return np.isin(rank, place[is_needed]), is_whole[self.owner]


def choose_fitted(
    data: Measurements, hold_out: float, seed: int, regions: IntArray | None = None
) -> BoolArray:
    """Return which poses (n,) are fitted where a share is held out at random, by whole
    `data.undivided` and whole regions (n,), if given; not by regions that link all poses.

    A session has a frame of its own, a surface its plane. Where too few of its poses are fitted,
    nobody can predict the others. Each frame, target, surface and offset that is estimated
    therefore keeps, in the order of the choice, poses with as many measured values as it has
    parameters, and one pose more: three points for a frame, as two leave a rotation about a line.

    Where the setup leaves less than half of the poses to hold out, sessions that need all of theirs
    are held out as a whole; where it leaves none then, it does not count. DataError where the poses
    cannot be divided.
    """
    unit, setup = np.unique(data.undivided, return_inverse=True)[1], _count_values(data)
    if regions is not None:
        joined = _join(np.column_stack([unit, unit.max() + 1 + regions]), unit)
        unit = joined if joined.max() > 0 else unit
    if unit.max() == 0:
        raise DataError(
            "cannot split measurements of a single block. Measure more poses, or use smaller blocks"
        )

    def permute(unit: IntArray) -> IntArray:
        return np.random.default_rng(np.random.SeedSequence(seed)).permutation(unit.max() + 1)

    order = permute(unit)
    is_needed, is_whole = setup.find_needed(unit, np.argsort(order))
    if np.bincount(unit)[~is_needed].sum() < ENOUGH * hold_out * data.n_poses:
        links = np.column_stack([unit[setup.pose], unit.max() + 1 + setup.owner])[is_whole]
        joined = _join(links, unit)
        order = permute(joined)
        is_needed = setup.find_needed(joined, np.argsort(order))[0]
        if is_needed.all() or len(order) < 2:
            order = permute(unit)
            is_needed = np.zeros(len(order), dtype=bool)
        else:
            unit = joined
    order = order[np.argsort(~is_needed[order], kind="stable")]
    error = np.abs(np.cumsum(np.bincount(unit)[order])[:-1] - (1.0 - hold_out) * data.n_poses)
    error[: max(int(is_needed.sum()) - 1, 0)] = np.inf
    return np.isin(unit, order[: int(np.argmin(error)) + 1])


def _join(links: IntArray, unit: IntArray) -> IntArray:
    """Return the number (n,) of the group of units to which each pose belongs; links (k, 2) join
    units (n,) and what has the numbers above them.
    """
    groups = find_connected_groups(links, int(max(links.max(initial=0), unit.max())) + 1)
    return np.unique(groups[unit], return_inverse=True)[1]


def _count_values(data: Measurements) -> _SetupValues:
    """Return the measured values with each unknown setup; repeats of a pose add nothing."""
    nuisance, n = data.nuisance_parameters, data.n_poses
    table = nuisance.table
    is_open = np.array(table.free & np.isnan(table.tolerance))
    names = [name.rsplit(".", 1)[0] for name in table.names]
    owner_of = np.unique(names, return_inverse=True)[1].reshape(-1)
    keys, counts = [np.zeros(0, np.intp)], [np.zeros(0)]
    for o, used in zip(data.observations, nuisance.indices, strict=False):
        row, column = np.nonzero(is_open[used] & (o.weight > 0.0)[:, None])
        pair = find_distinct_rows(np.column_stack([row, owner_of[used[row, column]]]))[0]
        keys.append(pair[:, 1] * n + o.rows.reshape(len(o), -1)[pair[:, 0], 0])
        counts.append(o.present.sum(axis=1)[pair[:, 0]])
    at, member = np.unique(np.concatenate(keys), return_inverse=True)
    count = np.bincount(member, np.concatenate(counts), len(at)).astype(np.intp)
    owner, pose = at // n, at % n
    by_count = np.lexsort((-count, data.repeats[pose], owner))
    owner, pose, count = owner[by_count], pose[by_count], count[by_count]
    same = (np.diff(owner) == 0) & (np.diff(data.repeats[pose]) == 0)
    first = np.concatenate([[True], ~same])[: len(at)]
    needed = np.bincount(owner_of[is_open], minlength=int(owner_of.max(initial=-1)) + 1)
    return _SetupValues(owner[first], pose[first], count[first], needed)
