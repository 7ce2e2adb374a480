# SPDX-License-Identifier: Apache-2.0
"""Estimates of the nuisance parameters after a fit: frames, targets, surfaces, offsets.

Given the machine's deviation z, the best nuisance parameters are b = b0 + S (z - z0) with the
covariance (F'F)^+ of their own. z has the covariance C of the fit, so that b has
(F'F)^+ + S C S'. A direction of infinite variance that moves b makes the variance of b infinite,
too: a frame is then known only together with the machine.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from loopcal.estimate.elimination import NuisanceElimination
from loopcal.estimate.linearization import Linearization
from loopcal.estimate.null_space import Combination, sparsify_basis
from loopcal.estimate.posterior import NOISE, CovariancePart, combine_degrees
from loopcal.findings import Finding, report_finding
from loopcal.measure.kinds.setup_parameters import ROTATION_AXES
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.decomposition import Decomposition
from loopcal.parameters import ParameterTable
from loopcal.results.description import Field, label_axes
from loopcal.results.result import TableResult
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

SMALLEST_EFFECT = 1e-7
"""Share of all that the machine does to a nuisance parameter below which a direction does not move
it: rounding."""


@dataclass(frozen=True, eq=False)
class NuisanceEstimate(TableResult):
    """Nuisance parameters after a fit. Arrays are (U,) in the order of `table`, SI.

    Attributes
    ----------
    table : nominal values, priors, and which were kept fixed.
    start : values that fit best at the geometry from which the fit starts; NaN where its poses do
        not determine them.
    estimate : (U,).
    sd : standard deviations; infinite where the data do not determine the parameter, 0 where it is
        fixed, NaN without an interval.
    slope : (U, p) change of the best values by the machine's deviations in tolerances.
    root : (U, U) square root of their covariance at a known machine; NaN without intervals.
    is_unobservable : (U,) parameters with a part in a direction that no row determines, whatever
        the machine.
    display : factor to SI and symbol of the unit in which each is shown.
    is_harmless : whether the unobservable directions only displace targets and frames together,
        along directions that the platform never turns: no pose of this robot shows them.
    """

    table: ParameterTable
    start: FloatArray
    estimate: FloatArray
    sd: FloatArray
    slope: FloatArray
    root: FloatArray
    is_unobservable: BoolArray
    display: tuple[tuple[float, str], ...]
    is_harmless: bool = False

    FIELDS: ClassVar[tuple[Field, ...]] = (
        Field("unit", lambda setup: [symbol for _, symbol in setup.display], "parameter"),
        Field("nominal", lambda setup: setup.list_shown(setup.table.nominal), "parameter"),
        Field("estimate", lambda setup: setup.list_shown(setup.estimate), "parameter"),
        Field("sd", lambda setup: setup.list_shown(setup.sd), "parameter"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="names")

    def list_shown(self, values: FloatArray) -> FloatArray:
        """Return values (U,) [SI] in the units in which they are shown."""
        return values / [factor for factor, _ in self.display]

    def __len__(self) -> int:
        return len(self.table)

    def __repr__(self) -> str:
        owners = ", ".join(_owners(self.names)) or "none"
        return f"<NuisanceEstimate: {len(self)} setup parameters ({owners})>"

    def __str__(self) -> str:
        """Return one line for each: name, estimate and standard deviation in its unit."""
        title = "setup parameter"
        width = max(map(len, (title, *self.names)))
        lines = [f"{title:<{width}} {'estimate':>14} {'+/- (1 sd)':>12} unit"]
        for entry, value, sd, (factor, symbol) in zip(
            self.table.entries, self.estimate, self.sd, self.display, strict=True
        ):
            decimals, half = format_half_width(sd / factor) if entry.free else (6, "fixed")
            number = f"{value / factor:>14.{decimals}f}"
            lines.append(f"{entry.name:<{width}} {number} {half:>12} {symbol}")
        return "\n".join(lines) if self.names else "no setup parameters"

    @classmethod
    def empty(cls, parameters: int) -> NuisanceEstimate:
        """Return the estimate of no nuisance parameters at all, for p parameters."""
        nothing, slope = np.zeros(0), np.zeros((0, parameters))
        root, is_unobservable = np.zeros((0, 0)), np.zeros(0, dtype=bool)
        return cls(ParameterTable(()), nothing, nothing, nothing, slope, root, is_unobservable, ())

    @property
    def names(self) -> tuple[str, ...]:
        """Names, such as `tracker.x`."""
        return self.table.names

    @property
    def values(self) -> Mapping[str, float]:
        """Estimates by name [SI]."""
        return dict(zip(self.names, self.estimate.tolist(), strict=True))

    @property
    def starts(self) -> Mapping[str, float]:
        """Values by name [SI] that fit best at the geometry from which the fit starts."""
        return dict(zip(self.names, self.start.tolist(), strict=True))

    def count_degrees(self, parts: Iterable[CovariancePart], tolerance: FloatArray) -> FloatArray:
        """Return the effective degrees of freedom (U,) of the standard deviations; infinite where
        nothing in them was estimated. The noise among the parts of the machine's posterior is also
        that of the setup parameters at a known machine; `tolerance` (p,) [SI].
        """
        own = np.nan_to_num((self.root**2).sum(axis=1))
        squares = []
        for part in parts:
            by_machine = ((self.slope @ (part.root / tolerance[:, None])) ** 2).sum(axis=1)
            squares.append((by_machine + own * (part.source == NOISE), part.degrees))
        return combine_degrees(self.sd**2, squares)

    def rows(self, coverage: FloatArray, degrees: FloatArray) -> list[dict[str, Any]]:
        """Return one entry for each, in its unit, ready for JSON; `coverage` (U,) is the number of
        standard deviations in `plus_minus`, `degrees` (U,) is theirs.
        """
        shown = []
        for i, entry in enumerate(self.table.entries):
            factor, symbol = self.display[i]
            numbers = {
                "nominal": entry.nominal,
                "estimate": self.estimate[i],
                "sd": self.sd[i],
                "plus_minus": coverage[i] * self.sd[i],
            }
            tolerance = None if entry.tolerance is None else entry.tolerance / factor
            scaled = {name: float(value) / factor for name, value in numbers.items()}
            shown.append(
                {
                    "name": entry.name,
                    "unit": symbol,
                    **scaled,
                    "degrees": float(degrees[i]),
                    "tolerance": tolerance,
                    "free": entry.free,
                }
            )
        return shown

    def report_unobservable(self) -> tuple[Finding, ...]:
        """Return which frames, targets, surfaces and offsets cannot be determined."""
        owners = _owners(
            n for n, lost in zip(self.names, self.is_unobservable, strict=True) if lost
        )
        code = "setup.common-displacement" if self.is_harmless else "setup.unobservable"
        return (report_finding(code, names=owners),) if owners else ()


def estimate_nuisance(
    nuisance: NuisanceElimination,
    linearization: Linearization,
    robot: Mechanism,
    decomposition: Decomposition,
    variance: FloatArray,
    noise: float,
    start: FloatArray | None = None,
) -> NuisanceEstimate:
    """Return the nuisance parameters of one trial after a fit, linearized at the estimate.

    `variance` (p,) is that of each direction of the decomposition, `noise` that of the whitened
    rows; NaN where no interval is given. `start` (U,) fits the initial geometry; by default the fit
    began there.
    """
    table = nuisance.local.table
    begin = linearization.next_start.first_nuisance[0] if start is None else start
    units = [robot.get_unit(entry.dimension) for entry in table.entries]
    shown = tuple((unit.factor_to_si, unit.symbol) for unit in units)
    U, p = len(table), len(decomposition.scale)
    if linearization.nuisance is None or not np.isfinite(linearization.cost[0]):
        estimate, nothing = linearization.next_start.nuisance[0].copy(), np.zeros(U)
        unobservable = np.zeros(U, dtype=bool)
        slope, root = np.zeros((U, p)), np.full((U, U), np.nan)
        return NuisanceEstimate(table, begin, estimate, nothing, slope, root, unobservable, shown)
    done, is_free = linearization.nuisance.elimination, nuisance.is_free
    V = decomposition.scale[:, None] * decomposition.directions[0]
    slope, is_unobservable = done.slope[0], done.is_unobservable[0]
    moved = slope[is_free] @ V
    unknown = np.isinf(variance)
    moved_by_unknown = np.linalg.norm(moved[:, unknown], axis=1)
    is_infinite = moved_by_unknown > SMALLEST_EFFECT * np.linalg.norm(moved, axis=1)
    by_machine = (moved**2) @ np.where(unknown, 0.0, variance)
    square = np.zeros(U)
    square[is_free] = np.where(
        is_infinite | is_unobservable[is_free],
        np.inf,
        done.variances()[0, is_free] * noise + by_machine,
    )
    return NuisanceEstimate(
        table,
        begin,
        linearization.nuisance.best[0],
        np.sqrt(square),
        slope,
        done.joint_root()[0] * np.sqrt(noise),
        is_unobservable,
        shown,
        _only_displaces(robot, table, is_unobservable, int(is_free.sum() - done.rank[0])),
    )


def add_followers(
    combinations: tuple[Combination, ...], null: FloatArray, nuisance: NuisanceEstimate
) -> tuple[Combination, ...]:
    """Add to unidentifiable combinations the frames and targets that change with them.

    The combinations must be those that describe the null space (p, d).
    """
    if not len(nuisance) or not combinations:
        return combinations
    changed = np.abs(sparsify_basis(null) @ nuisance.slope.T)
    limit = SMALLEST_EFFECT * np.abs(nuisance.slope).max(axis=1, initial=0.0)
    described = []
    for combination, moved in zip(combinations, changed > limit, strict=True):
        names = _owners(n for n, m in zip(nuisance.names, moved, strict=True) if m)
        described.append(replace(combination, nuisance=tuple(names)))
    return tuple(described)


def _only_displaces(
    robot: Mechanism, table: ParameterTable, is_unobservable: BoolArray, count: int
) -> bool:
    """Return whether `count` unobservable directions are common displacements of targets and
    frames along directions that the platform never turns: all three where it only translates, and
    the axis where it has one rotation.
    """
    lost = [p for p, is_lost in zip(table.entries, is_unobservable, strict=True) if is_lost]
    rotations = sum(freedom in ROTATION_AXES for freedom in robot.freedoms)
    return (
        count <= {0: 3, 1: 1}.get(rotations, 0)
        and all(p.dimension is Dimension.LENGTH for p in lost)
        and len(_owners(p.name for p in lost)) > 1
    )


def _owners(names: Iterable[str]) -> list[str]:
    """Return the frames, targets and surfaces to which parameters such as `tracker.x` belong."""
    return list(dict.fromkeys(name.rsplit(".", 1)[0] for name in names))


def format_half_width(half: float) -> tuple[int, str]:
    """Return the decimals that an uncertainty leaves, and the uncertainty with two digits."""
    if np.isnan(half):
        return 6, "not given"
    if np.isinf(half):
        return 6, "unknown"
    if half == 0.0:
        return 6, "0"
    decimals = int(np.clip(1 - np.floor(np.log10(half)), 0, 12))
    return decimals, f"{half:.{decimals}f}"
