# SPDX-License-Identifier: Apache-2.0
"""Rows of one kind: which pose each saw, what it read, and how far to believe it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal.errors import DataError
from loopcal.measure.arrays import stored
from loopcal.measure.kinds import Evaluation, Kind
from loopcal.measure.whitening import whitener
from loopcal.typing import BoolArray, FloatArray

Ints = NDArray[np.intp]
Bools = BoolArray
Texts = NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class Observations:
    """Rows of one kind. Absence never changes a shape: a component that is NaN, or a row of weight
    0, whitens to zero.

    Parameters
    ----------
    kind : Kind
        Mounted on the robot's tool, see `Kind.with_tool`.
    rows : (r,) int
        Index of the pose each row saw ((r, l) for kinds that compare several poses).
    measured : (r, c) [SI]
        NaN where not measured.
    covariance : (r, m, m) or (m, m) [SI]
        Of the residuals, see `from_sigma` and `Kind.linearize_noise`; entries of absent components are
        not looked at.
    weight : (r,), optional
        Factor of the squared whitened residual; 0 makes a row absent. Default 1.
    session, group : text or (r,) text, optional
        Rows of one session share the kind's frames and targets, rows of one group its surface.
        Default: one of each, without a name.
    context : name -> (r,), optional
        What stood beside each row and enters no equation: `time` [s], `temperature` and
        `temperature.PLACE` [degC], NaN where it was not noted.

    Attributes
    ----------
    present : (r, m) bool
        Residuals that can be formed; a row of weight 0 keeps its own here.
    whitener : (r, m, m)
        Inverse lower Cholesky factor of the covariance of what is present, times the root of the
        weight.

    Raises
    ------
    DataError
        If shapes do not fit the kind, a number is infinite, a covariance is not positive definite,
        a weight is negative, a row links a pose with itself, or the kind doubts a row.
    """

    kind: Kind
    rows: Ints
    measured: FloatArray
    covariance: FloatArray
    weight: FloatArray = field(default_factory=lambda: np.array(1.0))
    session: Texts = field(default_factory=lambda: np.array(""))
    group: Texts = field(default_factory=lambda: np.array(""))
    context: Mapping[str, FloatArray] = field(default_factory=dict)
    present: Bools = field(init=False, repr=False)
    whitener: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        kind = self.kind
        if not kind.has_tool:
            raise DataError(
                f"the kind {kind.name!r} has no tool yet; use kind.with_tool(robot.tool)"
            )
        rows = indices(self.rows, kind)
        c, m, r = len(kind.columns), len(kind.noise_columns), len(rows)
        measured = stored(
            self.measured, f"measured values of kind {kind.name!r}", (r, c), allow_nan=True
        )
        weight = stored(
            _spread(self.weight, (r,), "the weight", f"one number for each of {r} rows"),
            "the weight",
            (r,),
        )
        if np.any(weight < 0.0):
            i = int(np.flatnonzero(weight < 0.0)[0])
            raise DataError(
                f"the weight of row {i + 1} is {weight[i]:.6g}; use 0 to leave a row out, or a "
                "positive number"
            )
        for i, doubt in kind.find_invalid_rows(measured):
            raise DataError(f"row {i + 1} of kind {kind.name!r} {doubt}")
        present = kind.detect_present(measured)
        covariance = _spread(
            self.covariance, (r, m, m), "covariance", f"({r}, {m}, {m}) or ({m}, {m})"
        )
        W = whitener(covariance, present, weight)
        for array in (rows, covariance, present, W):
            array.setflags(write=False)
        values = {"rows": rows, "measured": measured, "covariance": covariance, "weight": weight}
        values |= {name: labels(getattr(self, name), r, name) for name in ("session", "group")}
        context = {
            name: stored(v, f"the context {name!r}", (r,), allow_nan=True)
            for name, v in self.context.items()
        }
        for name, array in {
            **values,
            "context": context,
            "present": present,
            "whitener": W,
        }.items():
            object.__setattr__(self, name, array)

    @classmethod
    def from_sigma(
        cls,
        kind: Kind,
        rows: ArrayLike,
        measured: ArrayLike,
        sigma: ArrayLike,
        session: str | Texts = "",
        group: str | Texts = "",
    ) -> Self:
        """Rows with independent noise of the kind's noise columns, mapped to the residuals by `N
        diag(sigma^2) N'`.

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
            As the class, and if sigma does not have one number for each noise column.
        """
        values = np.asarray(measured, dtype=float)
        names = ", ".join(column.name for column in kind.noise_columns)
        shape = (len(values), len(kind.noise_columns))
        sd = _spread(sigma, shape, "sigma", f"one number, or one for each of {names}")
        if values.ndim != 2 or values.shape[1] != len(kind.columns):
            raise _wrong_columns(kind, values.shape)
        N = kind.linearize_noise(values)
        covariance = (N * (sd * sd)[:, None, :]) @ np.swapaxes(N, -1, -2)
        return cls(
            kind,
            np.asarray(rows),
            values,
            covariance,
            session=np.asarray(session),
            group=np.asarray(group),
        )

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def n_residuals(self) -> int:
        """How many residuals count: present, in rows of weight above 0."""
        return int(np.count_nonzero(self.present & (self.weight > 0.0)[:, None]))

    def evaluate(
        self, T: FloatArray, unknowns: FloatArray | None = None, joints: FloatArray | None = None
    ) -> Evaluation:
        """Residuals and derivatives of all rows at the poses of all n readings.

        Parameters
        ----------
        T : (t, n, 4, 4)
            T_base_platform of each pose.
        unknowns : (t or 1, r or 1, u), optional
        joints : (t, r, j), optional

        Returns
        -------
        Evaluation
        """
        return self.kind.evaluate(T[:, self.rows], self.measured[None], unknowns, joints)

    def take(self, keep: ArrayLike) -> Self:
        """The rows at these positions (or of this mask)."""
        chosen = np.asarray(keep)
        return replace(
            self,
            rows=self.rows[chosen],
            measured=self.measured[chosen],
            covariance=self.covariance[chosen],
            weight=self.weight[chosen],
            session=self.session[chosen],
            group=self.group[chosen],
            context={name: values[chosen] for name, values in self.context.items()},
        )

    def with_weights(self, weight: ArrayLike) -> Self:
        """The same rows with other weights (r,)."""
        return replace(self, weight=np.asarray(weight, dtype=float))


def indices(rows: ArrayLike, kind: Kind) -> Ints:
    """Checked copy of the pose indices (r,) or (r, l)."""
    given = np.array(rows)
    wanted = 1 if kind.poses_per_row == 1 else 2
    whole = np.issubdtype(given.dtype, np.integer) or given.size == 0
    if given.ndim != wanted or (wanted == 2 and given.shape[1] != kind.poses_per_row) or not whole:
        shape = "(r,)" if wanted == 1 else f"(r, {kind.poses_per_row})"
        raise DataError(
            f"rows of kind {kind.name!r} have shape {given.shape} and type {given.dtype}; give "
            "whole numbers of shape"
            f" {shape}: the index of the pose each row saw"
        )
    if wanted == 2:
        same = np.flatnonzero(given[:, 0] == given[:, 1])
        if len(same):
            raise DataError(
                f"row {int(same[0]) + 1} of kind {kind.name!r} links pose {int(given[same[0], 0])} "
                "with itself; name two poses"
            )
    return given.astype(np.intp)


def labels(value: ArrayLike, r: int, what: str) -> Texts:
    """Read-only labels (r,) from one text or one for each row."""
    given = np.asarray(value)
    if given.dtype.kind != "U" or given.shape not in ((), (r,)):
        raise DataError(
            f"the {what} has shape {given.shape} and type {given.dtype}; give one text, or one for "
            f"each of {r} rows"
        )
    spread = np.array(np.broadcast_to(given, (r,)))
    spread.setflags(write=False)
    return spread


def _spread(value: ArrayLike, shape: tuple[int, ...], what: str, wanted: str) -> FloatArray:
    """Copy of an array spread over a shape; DataError where it does not fit."""
    given = np.asarray(value, dtype=float)
    try:
        return np.array(np.broadcast_to(given, shape))
    except ValueError:
        raise DataError(f"{what} has shape {given.shape}; give {wanted}") from None


def _wrong_columns(kind: Kind, shape: tuple[int, ...]) -> DataError:
    names = ", ".join(column.name for column in kind.columns)
    return DataError(
        f"measured values of kind {kind.name!r} have shape {shape}; give (r, {len(kind.columns)}): "
        f"{names}"
    )
