# SPDX-License-Identifier: Apache-2.0
"""Observations: measured rows of one kind, with their poses and covariances."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass, field, replace
from datetime import date
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal.errors import DataError
from loopcal.findings import Finding, report_finding
from loopcal.measure.array_checks import (
    broadcast_array,
    check_array,
    check_type,
    drop_repeats,
    refuse_first,
    set_fields,
    take_rows,
)
from loopcal.measure.kinds.kind import Evaluation, Kind, measure_progress
from loopcal.numerics.statistics import find_distinct
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import SD_RANGE, Dimension, is_sd

# Smallest pivot of a correlation matrix. Below it a component equals a combination of the others
# to seven digits, and the inverse has fewer digits than a measurement.
SMALLEST_PIVOT = 1e-7
ROUNDING = 1e-9  # relative differences of variances and standard deviations that are rounding
SIZE_UNITS = {  # of standard deviations that a program stated
    Dimension.LENGTH: ("um", 1e-6),
    Dimension.ANGLE: ("urad", 1e-6),
    Dimension.RATIO: ("ppm", 1e-6),
    Dimension.PIXEL: ("px", 1.0),
}
DATES = ("calibrated", "due", "measured")  # fields of an instrument that hold a date
VARYING = "normal, rms"  # distribution where the value is that of several
SEVERAL_DAYS = "data.several-days"  # code of a finding
TextArray = NDArray[np.str_]  # names of sessions or groups


@dataclass(frozen=True)
class StatedSize:
    """The size of an error as a certificate or data sheet states it (JCGM 100, 4.3): a value with
    its unit, and the divisor that makes it a standard uncertainty, by the distribution.
    """

    value: float
    unit: str
    distribution: str = "normal"  # or "uniform", from -value to value, or VARYING
    divisor: float = 1.0


def find_size(sd: FloatArray, dimensions: Iterable[Dimension]) -> StatedSize | None:
    """Return the sd [SI] that all values have, or their root mean square; None for mixed units."""
    units = {SIZE_UNITS[dimension] for dimension in dimensions}
    if len(units) != 1 or not sd.size:
        return None
    (symbol, factor), first = units.pop(), float(sd[0])
    if np.any(np.abs(sd - first) > ROUNDING * first):
        rms = float(np.sqrt(np.mean(sd**2)))
        return StatedSize(float(f"{rms / factor:.3g}"), symbol, VARYING)
    return StatedSize(float(f"{first / factor:.12g}"), symbol)


class NoisePart(NamedTuple):
    """What one source adds to the noise of rows."""

    name: str  # such as "range"
    covariance: FloatArray  # (r, m, m) [SI]
    size: StatedSize | None = None  # as stated, where one number states it


def whiten_columns(whitener: FloatArray, columns: FloatArray) -> FloatArray:
    """Return whitened columns (.., m, c) of whiteners (.., m, m); residuals without common errors
    are scaled, which takes no product of matrices.
    """
    scale = np.einsum("...mm->...m", whitener)
    if np.count_nonzero(scale) < np.count_nonzero(whitener):
        return whitener @ columns
    return scale[..., None] * columns


def compute_whitener(covariance: FloatArray, present: BoolArray, weight: FloatArray) -> FloatArray:
    """Return matrices W (r, m, m) with `W C W' = weight` on the present components, zero elsewhere.

    W is the inverse lower Cholesky factor. Row and column of an absent component are replaced by
    those of the identity, which keeps the shape and gives the same factor for the others. Each step
    of a fit multiplies by the inverse, and numpy has no triangular solve of stacked blocks. It is
    accurate, because the pivots of the correlation matrices are bounded from below.

    covariance : (r, m, m) [SI], any numbers where a component is absent; DataError where it is not
        symmetric and positive definite. present : (r, m).
    weight : (r,) factor of the squared residuals, not negative; 0 excludes a row.

    Rows of one covariance, present and weighted alike, share one matrix: W is then read-only.
    """
    one = slice(1)
    if (
        len(present) > 1
        and len(drop_repeats(covariance)) == 1
        and np.all(present == present[one])
        and np.all(weight == weight[one])
    ):
        shared = compute_whitener(covariance[one], present[one], weight[one])
        return np.broadcast_to(shared, covariance.shape)
    both = present[:, :, None] & present[:, None, :]
    diagonal = np.eye(present.shape[1], dtype=bool)
    C = np.where(both, covariance, 0.0) + (diagonal & ~both)
    variance = np.einsum("rii->ri", C)
    sd = np.sqrt(np.maximum(variance, 0.0))
    _refuse(
        ~np.all(np.isfinite(C), axis=(1, 2)) | ~np.all(is_sd(sd), axis=1),
        f"has a variance that is not above 0 (standard deviations {SD_RANGE})",
    )
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        correlation = C / (sd[:, :, None] * sd[:, None, :])
    _refuse(~np.all(np.isfinite(correlation), axis=(1, 2)), "is not positive definite")
    asymmetric = np.abs(correlation - np.swapaxes(correlation, 1, 2)) > 1e-9
    _refuse(np.any(asymmetric, axis=(1, 2)), "is not symmetric")
    if np.any(correlation[:, ~diagonal]):
        try:
            L = np.linalg.cholesky(correlation)
        except np.linalg.LinAlgError:
            smallest = np.linalg.eigvalsh(correlation)[:, 0]
            _refuse(smallest <= max(float(np.min(smallest)), 0.0), "is not positive definite")
            raise
        pivots = np.min(np.einsum("rii->ri", L), axis=1)
        _refuse(pivots < SMALLEST_PIVOT, "is not positive definite to rounding")
        inverse = np.asarray(np.tril(np.linalg.inv(L)), dtype=np.float64)
    else:  # as in most files
        root = np.sqrt(np.where(diagonal, correlation, 1.0))
        inverse = np.where(diagonal, 1.0 / root, 0.0)
    return np.where(both, inverse / sd[:, None, :], 0.0) * np.sqrt(weight)[:, None, None]


def _refuse(wrong: BoolArray, what: str) -> None:
    refuse_first(
        wrong,
        lambda i: (
            f"the covariance of row {i + 1} {what}. Give each component a standard deviation above "
            "0 and correlations between -1 and 1 that are consistent"
        ),
    )


def is_date(text: str) -> bool:
    """Return whether a text is a date of the form 2026-01-31."""
    try:
        return date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False


@dataclass(frozen=True)
class InstrumentRecord:
    """An instrument and its calibration; a text that is empty is not stated.

    Parameters
    ----------
    name : what people call it. manufacturer, model, serial_number : which one it is.
    certificate : number of its calibration certificate. laboratory : that issued it.
    standard : reference standard or procedure of that calibration, such as "ISO 10360-10".
    calibrated, due : dates of its calibration and of the next one, as 2026-05-31.
    measured : date of these measurements.

    Raises
    ------
    DataError : not a date, or the due date lies before the calibration.
    """

    name: str = ""
    manufacturer: str = ""
    model: str = ""
    serial_number: str = ""
    certificate: str = ""
    laboratory: str = ""
    standard: str = ""
    calibrated: str = ""
    due: str = ""
    measured: str = ""

    def __post_init__(self) -> None:
        for key in DATES:
            text = getattr(self, key)
            if text and not is_date(text):
                raise DataError(f"{key} is {text!r}. Write a date as 2026-05-31")
        if self.due and self.calibrated and self.due < self.calibrated:
            raise DataError(
                f"due is {self.due}, which is before calibrated, {self.calibrated}. Correct one"
            )

    def __str__(self) -> str:
        """Return the instrument as a sentence names it."""
        name = self.name or " ".join(x for x in (self.manufacturer, self.model) if x)
        number = f"serial number {self.serial_number}" if self.serial_number else ""
        return ", ".join(part for part in (name, number) if part) or "without a name"

    def to_dict(self) -> dict[str, str]:
        """Return the stated facts by name."""
        return {name: value for name, value in asdict(self).items() if value}


def list_instruments(observations: Sequence[Observations]) -> tuple[InstrumentRecord, ...]:
    """Return the stated instruments of rows, each once."""
    stated = (rows.instrument for rows in observations)
    return tuple(dict.fromkeys(record for record in stated if record is not None))


def check_instruments(observations: Sequence[Observations]) -> list[Finding]:
    """Return the instruments that were not validly calibrated when they measured, and the days
    where there are several.

    Dates are compared with each other, not with the clock: without the date of the measurements
    nothing can be said.
    """
    findings = []
    for record in list_instruments(observations):
        stated: dict[str, Any] = {name: getattr(record, name) for name in DATES}
        stated["instrument"] = str(record)
        if not record.measured and record.due:
            stated = {"instrument": stated["instrument"], "due": record.due}
            findings.append(report_finding("data.instrument-not-dated", **stated))
        elif record.due and record.measured > record.due:
            findings.append(report_finding("data.instrument-past-due", **stated))
        elif record.measured and record.measured < record.calibrated:
            findings.append(report_finding("data.instrument-calibrated-later", **stated))
    # each file has its own kinds, and those with equal settings measure the same
    days = {id(o.kind): o.instrument.measured if o.instrument else "" for o in observations}
    kinds = {id(o.kind): repr(o.kind) for o in observations if len(days) > 1}
    count = Counter(kinds.values())
    joined = (days[number] for number, kind in kinds.items() if count[kind] > 1)
    return [*findings, *report_days([*joined, *filter(None, days.values())])]


def report_days(days: Sequence[str]) -> list[Finding]:
    """Return that measurements of several files are from several days, or of unknown ones, which
    are empty here.
    """
    known = sorted({*days} - {""})
    if len(known) < 2 and not (len(days) > 1 and "" in days):
        return []
    return [report_finding(SEVERAL_DAYS, days=known, is_open="" in days)]


@dataclass(frozen=True, eq=False, repr=False)
class Observations:
    """Rows of one kind.

    Missing values never change a shape: a component that is NaN, or a row of weight 0, has whitened
    residuals of zero.

    Parameters
    ----------
    kind : with the robot's tool, see `Kind.with_tool`.
    rows : (r,) int, index of the pose of each row; (r, l) for kinds that compare l poses. Those of
        targets on the base, which belong to no pose, become 0.
    measured : (r, c) [SI], NaN where not measured.
    covariance : (r, m, m) or (m, m) [SI], of the residuals, see `from_sigma` and
        `Kind.linearize_noise`. Entries of missing components are ignored.
    weight : (r,), factor of the squared whitened residual; 0 excludes a row. Default 1.
    session, group : text or (r,) text, rows of one session share frames and targets, rows of one
        group share a surface. Default: one session and one group, without names.
    context : name -> (r,), notes to each row that enter no equation: `time` [s], `temperature` and
        `temperature.PLACE` [degC], NaN where missing.
    progress : (r,), progress of each row through its session, from -0.5 to 0.5: the part that it
        takes of a drift, see `drift_part`. Default: by the time of the rows, or else their order.
    source : where the rows come from, such as the name of a file; for messages.
    is_noise_assumed : whether nobody stated the covariance: a program that wrote the rows assumed
        it. It then decides no quality gate.
    instrument : what measured the rows, and how that is traceable; for certificates.
    noise_parts : the covariance by source, for the uncertainty budget. What they leave of it is a
        part without a name.

    Attributes
    ----------
    present : (r, m) bool, residuals that exist; also those of rows of weight 0.
    whitener : (r, m, m), inverse lower Cholesky factor of the covariance of the present components,
        times the root of the weight.

    Raises
    ------
    DataError : shapes do not fit the kind, a number is infinite, a covariance is not positive
        definite, a weight is negative, or a row is invalid or compares a pose with itself.
    """

    kind: Kind
    rows: IntArray
    measured: FloatArray
    covariance: FloatArray
    weight: FloatArray = field(default_factory=lambda: np.array(1.0))
    session: TextArray = field(default_factory=lambda: np.array(""))
    group: TextArray = field(default_factory=lambda: np.array(""))
    context: Mapping[str, FloatArray] = field(default_factory=dict)
    progress: FloatArray = field(default_factory=lambda: np.empty(0))
    source: str = ""
    is_noise_assumed: bool = False
    instrument: InstrumentRecord | None = None
    noise_parts: tuple[NoisePart, ...] = ()
    present: BoolArray = field(init=False)
    whitener: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        kind = self.kind
        check_type(kind, Kind, "kind", "such as loopcal.Pose()")
        if not kind.has_tool:
            raise DataError(f"the kind {kind.name!r} has no tool. Use kind.with_tool(robot.tool)")
        rows = check_rows(self.rows, kind)
        rows = np.zeros_like(rows) if kind.is_of_base else rows
        m, r = len(kind.noise_columns), len(rows)
        measured = check_measured(self.measured, kind, r)
        wanted = f"one number for each of {r} rows"
        weights = broadcast_array(self.weight, (r,), "the weight", wanted)
        weight = check_array(weights, "the weight", (r,))
        refuse_first(
            weight < 0.0,
            lambda i: (
                f"the weight of row {i + 1} is {weight[i]:.6g}. Give a positive number, or 0 to "
                "exclude the row"
            ),
        )
        for i, problem in kind.find_invalid_rows(measured):
            raise DataError(f"row {i + 1} of kind {kind.name!r} {problem}")
        present = kind.detect_present(measured)
        covariance = broadcast_array(
            self.covariance, (r, m, m), "covariance", f"({r}, {m}, {m}) or ({m}, {m})"
        )
        W = compute_whitener(covariance, present, weight)
        for array in (rows, covariance, present, W):
            array.setflags(write=False)
        labels = {name: check_labels(getattr(self, name), r, name) for name in ("session", "group")}
        context = {
            name: check_array(v, f"the context {name!r}", (r,), allow_nan=True)
            for name, v in self.context.items()
        }
        if len(self.progress):
            progress = check_array(self.progress, "the progress of the rows", (r,))
            set_fields(self, progress=progress)
        set_fields(self, rows=rows, measured=measured, covariance=covariance, weight=weight)
        set_fields(self, context=context, present=present, whitener=W, **labels)

    @classmethod
    def from_sigma(
        cls,
        kind: Kind,
        rows: ArrayLike,
        measured: ArrayLike,
        sigma: ArrayLike,
        session: str | TextArray = "",
        group: str | TextArray = "",
        sight: Mapping[str, float] = MappingProxyType({}),
    ) -> Self:
        """Return rows with independent noise of the kind's noise columns.

        With N from `Kind.linearize_noise`, the covariance of the residuals is `N diag(sigma^2) N'`.

        Parameters
        ----------
        rows : (r,) int. measured : (r, c) [SI].
        sigma : standard deviations [SI]: a number, (m,) or (r, m); DataError unless above 0.
        session, group : text or (r,) text.
        sight : name -> standard deviation [SI] of noise by `Kind.sight_noise`, in addition.
        """
        check_type(kind, Kind, "kind", "such as loopcal.Pose()")
        values = check_measured(measured, kind)
        names = ", ".join(column.name for column in kind.noise_columns)
        shape = (len(values), len(kind.noise_columns))
        sd = broadcast_array(sigma, shape, "sigma", f"one number, or one for each of {names}")
        wrong = sd[~(is_sd(sd) | np.isnan(sd) | (sd == 0.0))]
        if len(wrong):
            raise DataError(f"sigma contains {wrong[0]:.6g}. Give numbers above 0, {SD_RANGE}")
        N, sd = drop_repeats(kind.linearize_noise(values)), drop_repeats(sd)
        covariance = (N * (sd * sd)[:, None, :]) @ np.swapaxes(N, -1, -2)
        names: Any = {"session": np.asarray(session), "group": np.asarray(group)}
        spread = kind.spread_sight_noise(values) if sight else {}
        parts = tuple(
            NoisePart(n, sd * sd * spread[n], find_size(np.array([sd]), [kind.sight_noise[n]]))
            for n, sd in sight.items()
        )
        covariance = sum((part.covariance for part in parts), covariance)
        return cls(kind, np.asarray(rows), values, covariance, noise_parts=parts, **names)

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        counts = [f"{len(self)} rows", f"{self.n_residuals} residuals"]
        for name in ("session", "group"):
            names = [text for text in find_distinct(getattr(self, name)).tolist() if text]
            if names:
                more = f" and {len(names) - 4} more" if len(names) > 4 else ""
                counts.append(f"{name} {', '.join(names[:4])}{more}")
        return f"Observations({self.kind!r}: {'; '.join(counts)})"

    @property
    def n_residuals(self) -> int:
        """Number of residuals that count: present, in rows of weight above 0."""
        return int(np.count_nonzero(self.present & (self.weight > 0.0)[:, None]))

    @property
    def is_measured(self) -> BoolArray:
        """(r,) rows of which a component is present, or whose kind has none (`closure`)."""
        return self.present.any(axis=1) | (self.present.shape[1] == 0)

    @property
    def labels(self) -> FloatArray:
        """(r, l) the columns that say what each row measures, such as its corner of a board."""
        return self.measured[:, : self.kind.label_count]

    @property
    def drift_part(self) -> FloatArray:
        """(r,) the part of its session's drift that each row takes; some rows of a session, such as
        held-out ones, keep theirs.
        """
        if len(self.progress):
            return self.progress
        return measure_progress(self.session, self.context.get("time"))

    def evaluate(
        self, T: FloatArray, nuisance: FloatArray | None = None, joints: FloatArray | None = None
    ) -> Evaluation:
        """Return residuals and derivatives of all rows at the poses T (t, n, 4, 4) of all n
        readings; the rest as for `Kind.evaluate`.
        """
        return self.kind.evaluate(T[:, self.rows], self.measured[None], nuisance, joints)

    def compute_residuals(
        self, T: FloatArray, nuisance: FloatArray | None = None, joints: FloatArray | None = None
    ) -> FloatArray:
        """Return the residuals (t, r, m) of `evaluate`."""
        return self.kind.compute_residuals(T[:, self.rows], self.measured[None], nuisance, joints)

    def take(self, keep: ArrayLike, poses: IntArray | None = None) -> Self:
        """Return the rows at these indices, or of this mask; `poses` are the indices of the poses
        of these, by default the present ones. They are not checked again.
        """
        chosen = np.asarray(keep)
        names = ("rows", "measured", "covariance", "weight", "session", "group", "present")
        names = (*names, "whitener")
        arrays: dict[str, Any] = {name: take_rows(getattr(self, name), chosen) for name in names}
        if poses is not None:
            arrays["rows"] = poses
        if self.kind.is_drift.any():
            arrays["progress"] = self.drift_part[chosen]
        for array in arrays.values():
            array.setflags(write=False)
        parts = tuple(
            part._replace(covariance=take_rows(part.covariance, chosen))
            for part in self.noise_parts
        )
        context = {name: values[chosen] for name, values in self.context.items()}
        taken = copy(self)
        set_fields(taken, context=context, noise_parts=parts, **arrays)
        return taken

    def split_noise(self) -> list[tuple[str, StatedSize | None, FloatArray | None]]:
        """Return name, stated size and root (r, m, m) of each part of the noise. Whitened rows
        times the roots have unit noise in sum; the root is None where one part is all. Parts that
        together exceed the covariance belong to an earlier one, and do not count.
        """
        parts, variance = list(self.noise_parts), np.einsum("rii->ri", self.covariance)
        rest = drop_repeats(self.covariance) - sum(drop_repeats(p.covariance) for p in parts)
        least = ROUNDING * np.where(self.present, variance, np.inf)
        if not parts or np.any(np.einsum("rii->ri", rest) < -least):  # or of another covariance
            parts = [NoisePart("", self.covariance)]
        elif np.any(np.abs(rest) > least[:, :, None]):
            parts.append(NoisePart("", rest))
        parts = [part._replace(size=part.size or self._find_size(part)) for part in parts]
        if len(parts) == 1:
            return [(parts[0].name, parts[0].size, None)]
        W = drop_repeats(self.whitener)
        alike = slice(len(W) if len(W) == 1 else None)  # the rows that are enough
        weight = np.where(self.weight > 0.0, self.weight, np.inf)[alike, None, None]
        split = []
        for part in parts:
            inner = np.where(self.present[alike, :, None], drop_repeats(part.covariance), 0.0)
            share, axes = np.linalg.eigh(W @ inner @ np.swapaxes(W, 1, 2) / weight)
            root = axes * np.sqrt(np.maximum(share, 0.0))[:, None] @ np.swapaxes(axes, 1, 2)
            split.append((part.name, part.size, np.broadcast_to(root, self.whitener.shape)))
        return split

    def _find_size(self, part: NoisePart) -> StatedSize | None:
        """Return the standard deviation of a part of the noise."""
        variance = np.einsum("rii->ri", np.broadcast_to(part.covariance, self.covariance.shape))
        dimensions = {column.dimension for column in self.kind.noise_columns}
        return find_size(np.sqrt(variance[self.present]), dimensions)

    def with_weights(self, weight: ArrayLike) -> Self:
        """Return the same rows with other weights (r,)."""
        return replace(self, weight=np.asarray(weight, dtype=float))


def check_measured(measured: ArrayLike, kind: Kind, r: int | None = None) -> FloatArray:
    """Return measured values as a read-only array (r, c) of any number of rows, or of `r`."""
    names = ", ".join(column.name for column in kind.columns)
    what = f"measured values of kind {kind.name!r} ({names})"
    return check_array(measured, what, (r, len(kind.columns)), allow_nan=True)


def check_rows(rows: ArrayLike, kind: Kind) -> IntArray:
    """Return a checked copy of the pose indices (r,) or (r, l)."""
    given = np.array(rows)
    wanted = 1 if kind.poses_per_row == 1 else 2
    whole = np.issubdtype(given.dtype, np.integer) or given.size == 0
    if given.ndim != wanted or (wanted == 2 and given.shape[1] != kind.poses_per_row) or not whole:
        shape = "(r,)" if wanted == 1 else f"(r, {kind.poses_per_row})"
        raise DataError(
            f"rows of kind {kind.name!r} have shape {given.shape} and type {given.dtype}. Give "
            f"whole numbers of shape {shape}: the index of the pose of each row"
        )
    if wanted == 2:
        refuse_first(
            given[:, 0] == given[:, 1],
            lambda i: (
                f"row {i + 1} of kind {kind.name!r} compares pose {int(given[i, 0])} with itself. "
                "Give two different poses"
            ),
        )
    return given.astype(np.intp)


def check_poses(rows: IntArray, kind: Kind, n: int) -> None:
    """Refuse rows (r,) or (r, l) of poses that do not exist."""
    poses = rows.reshape(len(rows), kind.poses_per_row)
    refuse_first(
        (poses < 0) | (poses >= n),
        lambda i, j: (
            f"row {i + 1} of kind {kind.name!r} refers to pose {int(poses[i, j])}, but the {n} "
            f"poses are 0 to {n - 1}. Correct the row, or add the readings of the pose"
        ),
    )


def check_labels(value: ArrayLike, r: int, what: str) -> TextArray:
    """Return read-only labels (r,) from one text or one for each row."""
    given = np.asarray(value)
    if given.dtype.kind != "U" or given.shape not in ((), (r,)):
        raise DataError(
            f"the {what} has shape {given.shape} and type {given.dtype}. Give one text, or one for "
            f"each of {r} rows"
        )
    labels = np.array(np.broadcast_to(given, (r,)))
    labels.setflags(write=False)
    return labels
