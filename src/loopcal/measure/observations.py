# SPDX-License-Identifier: Apache-2.0
"""Observations: measured rows of one kind, with their poses and covariances."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal.errors import DataError
from loopcal.measure.array_checks import check_array, check_type, describe, set_fields
from loopcal.measure.kinds import Evaluation, Kind
from loopcal.measure.kinds.shared_errors import measure_progress
from loopcal.measure.traceability import InstrumentRecord
from loopcal.measure.whitening import compute_whitener
from loopcal.numerics.sorted_values import find_distinct
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import SD_RANGE, is_sd

TextArray = NDArray[np.str_]
"""Names of sessions or groups."""


@dataclass(frozen=True, eq=False, repr=False)
class Observations:
    """Rows of one kind.

    Missing values never change a shape: a component that is NaN, or a row of weight 0, has whitened
    residuals of zero.

    Parameters
    ----------
    kind : Kind
        With the robot's tool, see `Kind.with_tool`.
    rows : (r,) int
        Index of the pose of each row; (r, l) for kinds that compare l poses. A row of targets on
        the base belongs to no pose: its number does not matter, and becomes 0.
    measured : (r, c) [SI]
        NaN where not measured.
    covariance : (r, m, m) or (m, m) [SI]
        Of the residuals, see `from_sigma` and `Kind.linearize_noise`. Entries of missing components
        are ignored.
    weight : (r,), optional
        Factor of the squared whitened residual; 0 excludes a row. Default 1.
    session, group : text or (r,) text, optional
        Rows of one session share frames and targets, rows of one group share a surface. Default:
        one session and one group, without names.
    context : name -> (r,), optional
        Notes to each row that enter no equation: `time` [s], `temperature` and `temperature.PLACE`
        [degC], NaN where missing.
    progress : (r,), optional
        Progress of each row through its session, from -0.5 to 0.5: the part that it takes of a
        drift, see `drift_part`. Default: by the time of the rows, or else in their order.
    source : text, optional
        Where the rows come from, such as the name of a file; for messages.
    is_noise_assumed : bool, optional
        Whether nobody stated the covariance: a program that wrote the rows assumed it. It then
        decides no quality gate.
    instrument : InstrumentRecord, optional
        What measured the rows, and how that is traceable; for certificates.

    Attributes
    ----------
    present : (r, m) bool
        Residuals that exist; also those of rows of weight 0.
    whitener : (r, m, m)
        Inverse lower Cholesky factor of the covariance of the present components, times the root of
        the weight.

    Raises
    ------
    DataError
        If shapes do not fit the kind, a number is infinite, a covariance is not positive definite,
        a weight is negative, a row compares a pose with itself, or the kind finds a row invalid.
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
    present: BoolArray = field(init=False)
    whitener: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        kind = self.kind
        check_type(kind, Kind, "kind", "such as loopcal.Pose()")
        if not kind.has_tool:
            raise DataError(f"the kind {kind.name!r} has no tool; use kind.with_tool(robot.tool)")
        rows = check_rows(self.rows, kind)
        rows = np.zeros_like(rows) if kind.is_of_base else rows
        c, m, r = len(kind.columns), len(kind.noise_columns), len(rows)
        measured = check_array(
            self.measured, f"measured values of kind {kind.name!r}", (r, c), allow_nan=True
        )
        weights = _broadcast(self.weight, (r,), "the weight", f"one number for each of {r} rows")
        weight = check_array(weights, "the weight", (r,))
        if np.any(weight < 0.0):
            i = int(np.flatnonzero(weight < 0.0)[0])
            raise DataError(
                f"the weight of row {i + 1} is {weight[i]:.6g}; give a positive number, or 0 to "
                "exclude the row"
            )
        for i, problem in kind.find_invalid_rows(measured):
            raise DataError(f"row {i + 1} of kind {kind.name!r} {problem}")
        present = kind.detect_present(measured)
        covariance = _broadcast(
            self.covariance, (r, m, m), "covariance", f"({r}, {m}, {m}) or ({m}, {m})"
        )
        W = compute_whitener(covariance, present, weight)
        for array in (rows, covariance, present, W):
            array.setflags(write=False)
        session, group = (check_labels(getattr(self, s), r, s) for s in ("session", "group"))
        context = {
            name: check_array(v, f"the context {name!r}", (r,), allow_nan=True)
            for name, v in self.context.items()
        }
        if len(self.progress):
            progress = check_array(self.progress, "the progress of the rows", (r,))
            set_fields(self, progress=progress)
        set_fields(self, rows=rows, measured=measured, covariance=covariance, weight=weight)
        set_fields(self, session=session, group=group, context=context)
        set_fields(self, present=present, whitener=W)

    @classmethod
    def from_sigma(
        cls,
        kind: Kind,
        rows: ArrayLike,
        measured: ArrayLike,
        sigma: ArrayLike,
        session: str | TextArray = "",
        group: str | TextArray = "",
    ) -> Self:
        """Return rows with independent noise of the kind's noise columns.

        With N from `Kind.linearize_noise`, the covariance of the residuals is `N diag(sigma^2) N'`.

        Parameters
        ----------
        kind : Kind
        rows : (r,) int
        measured : (r, c) [SI]
        sigma : number, (m,) or (r, m) [SI]
            Standard deviations.
        session, group : text or (r,) text

        Returns
        -------
        observations : Observations

        Raises
        ------
        DataError
            As the class, and if sigma is negative or does not have one number for each noise
            column.
        """
        check_type(kind, Kind, "kind", "such as loopcal.Pose()")
        try:
            values = np.asarray(measured, dtype=float)
        except (TypeError, ValueError):
            raise DataError(
                f"measured: got {describe(measured)}; give an array of numbers (r, "
                f"{len(kind.columns)}) in SI units; loopcal.load_measurements reads files"
            ) from None
        names = ", ".join(column.name for column in kind.noise_columns)
        if values.ndim != 2 or values.shape[1] != len(kind.columns):
            columns = ", ".join(column.name for column in kind.columns)
            raise DataError(
                f"measured values of kind {kind.name!r} have shape {values.shape}; give (r, "
                f"{len(kind.columns)}): {columns}"
            )
        shape = (len(values), len(kind.noise_columns))
        sd = _broadcast(sigma, shape, "sigma", f"one number, or one for each of {names}")
        wrong = sd[~(is_sd(sd) | np.isnan(sd) | (sd == 0.0))]
        if len(wrong):
            raise DataError(f"sigma contains {wrong[0]:.6g}; give numbers above 0, {SD_RANGE}")
        N = kind.linearize_noise(values)
        covariance = (N * (sd * sd)[:, None, :]) @ np.swapaxes(N, -1, -2)
        of_session, of_group = np.asarray(session), np.asarray(group)
        return cls(kind, np.asarray(rows), values, covariance, session=of_session, group=of_group)

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
    def drift_part(self) -> FloatArray:
        """(r,) the part of its session's drift that each row takes. Some rows of a session, such as
        held-out ones, keep the parts that they have among all rows.
        """
        if len(self.progress):
            return self.progress
        return measure_progress(self.session, self.context.get("time"))

    def evaluate(
        self, T: FloatArray, nuisance: FloatArray | None = None, joints: FloatArray | None = None
    ) -> Evaluation:
        """Return residuals and derivatives of all rows at the poses of all n readings.

        Parameters
        ----------
        T : (t, n, 4, 4)
            T_base_platform of each pose.
        nuisance : (t or 1, r or 1, u), optional
        joints : (t, r, j), optional

        Returns
        -------
        Evaluation
        """
        return self.kind.evaluate(T[:, self.rows], self.measured[None], nuisance, joints)

    def take(self, keep: ArrayLike) -> Self:
        """Return the rows at these indices, or of this mask."""
        chosen = np.asarray(keep)
        names = ("rows", "measured", "covariance", "weight", "session", "group")
        arrays: dict[str, Any] = {name: getattr(self, name)[chosen] for name in names}
        context = {name: values[chosen] for name, values in self.context.items()}
        if self.kind.is_drift.any():
            arrays["progress"] = self.drift_part[chosen]
        return replace(self, context=context, **arrays)

    def with_weights(self, weight: ArrayLike) -> Self:
        """Return the same rows with other weights (r,)."""
        return replace(self, weight=np.asarray(weight, dtype=float))


def check_rows(rows: ArrayLike, kind: Kind) -> IntArray:
    """Return a checked copy of the pose indices (r,) or (r, l)."""
    given = np.array(rows)
    wanted = 1 if kind.poses_per_row == 1 else 2
    whole = np.issubdtype(given.dtype, np.integer) or given.size == 0
    if given.ndim != wanted or (wanted == 2 and given.shape[1] != kind.poses_per_row) or not whole:
        shape = "(r,)" if wanted == 1 else f"(r, {kind.poses_per_row})"
        raise DataError(
            f"rows of kind {kind.name!r} have shape {given.shape} and type {given.dtype}; give "
            f"whole numbers of shape {shape}: the index of the pose of each row"
        )
    if wanted == 2:
        same = np.flatnonzero(given[:, 0] == given[:, 1])
        if len(same):
            raise DataError(
                f"row {int(same[0]) + 1} of kind {kind.name!r} compares pose "
                f"{int(given[same[0], 0])} with itself; give two different poses"
            )
    return given.astype(np.intp)


def check_labels(value: ArrayLike, r: int, what: str) -> TextArray:
    """Return read-only labels (r,) from one text or one for each row."""
    given = np.asarray(value)
    if given.dtype.kind != "U" or given.shape not in ((), (r,)):
        raise DataError(
            f"the {what} has shape {given.shape} and type {given.dtype}; give one text, or one for "
            f"each of {r} rows"
        )
    labels = np.array(np.broadcast_to(given, (r,)))
    labels.setflags(write=False)
    return labels


def _broadcast(value: ArrayLike, shape: tuple[int, ...], what: str, wanted: str) -> FloatArray:
    """Return a copy of an array, broadcast to a shape; DataError where it does not fit."""
    try:
        given = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise DataError(f"{what}: got {describe(value)}; give {wanted}") from None
    try:
        return np.array(np.broadcast_to(given, shape))
    except ValueError:
        raise DataError(f"{what} has shape {given.shape}; give {wanted}") from None
