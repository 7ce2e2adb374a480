# SPDX-License-Identifier: Apache-2.0
"""Prove a calibration on poses it has not seen, before and after, with two errors told apart.

Prediction error: what the model predicts at the readings that were measured, against what was
measured. Commanded error: where the machine goes when it is told to reach a pose with this
geometry, against that pose. The poses asked for are those that the geometry before calibration
believes in at the measured readings, so before calibration the machine's answer was measured. After
calibration the readings change, by little; the machine is then taken to differ from the identified
model as it did at the measured readings. What no actuator can reach is shown as not compensable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from loopcal.diagnose import (
    INDICES,
    KindErrors,
    PoseErrors,
    PosePredictions,
    compare_predictions,
    compute_kind_errors,
    compute_row_errors,
    find_moved_setups,
    predict_poses,
)
from loopcal.errors import DataError, suggest_names
from loopcal.estimate.inference.null_space import listed
from loopcal.estimate.predicted import untold
from loopcal.estimate.result import Identification
from loopcal.measure import Measurements, check_actuators
from loopcal.mechanism import Mechanism, Solution
from loopcal.units import DISPLAY_UNITS, Dimension, find_unit

FEW = 5
"""Rows below which an error is said to be judged by too few: at 4 the rms of noise alone varies by
a third.
"""


@dataclass(frozen=True, eq=False)
class Validation:
    """Errors on measured poses before and after calibration; rows are the r rows of all kinds.

    Attributes
    ----------
    poses : (r,) labels.
    before, after : prediction error at equal readings.
    commanded_before, commanded_after : pose error of the machine after commanding.
    not_compensable : the part of `commanded_after` for which the machine has no actuator.
    failed : labels of poses that one of the two geometries cannot reach; they are left out of all
        statistics.
    limit_position, limit_angle : quality gates [m], [rad] on the largest prediction error after;
        None for no gate.
    reasons : a sentence for each gate that is not met.
    units : display symbols of length and angle.
    notes : where unknown frames, targets and surfaces come from: from the fit, or found anew from
        these rows.
    alignment : the same by name: `kept` as the fit found them, `fitted` to these very rows, after
        which errors are compared.
    kinds : prediction errors divided by sigma, of each kind and, last, of all.
    """

    poses: tuple[str, ...]
    before: PoseErrors
    after: PoseErrors
    commanded_before: PoseErrors
    commanded_after: PoseErrors
    not_compensable: PoseErrors
    failed: tuple[str, ...]
    limit_position: float | None
    limit_angle: float | None
    reasons: tuple[str, ...]
    units: tuple[str, str]
    notes: tuple[str, ...] = ()
    alignment: Mapping[str, tuple[str, ...]] = field(
        default_factory=lambda: {"kept": (), "fitted": ()}
    )
    kinds: tuple[KindErrors, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether every quality gate is met."""
        return not self.reasons

    def improvement(self, index: str = "position", statistic: str = "rms") -> float:
        """Return how many times smaller a statistic of the prediction error became."""
        after = getattr(self.after.statistics(index), statistic)
        return getattr(self.before.statistics(index), statistic) / after if after > 0.0 else np.inf

    @property
    def several_kinds(self) -> bool:
        """Whether rows of several kinds are mixed; then only errors divided by sigma can be
        compared.
        """
        return len(self.kinds) > 2

    def comparisons(self) -> tuple[tuple[str, float], ...]:
        """Return what is compared before and after calibration (rms), and how many times smaller it
        became.
        """
        if self.several_kinds:
            return (("error of all kinds, divided by sigma", self.kinds[-1].improvement),)
        measured = [
            index for index in ("position", "orientation") if self.after.statistics(index).count
        ]
        return tuple((f"{index} error", self.improvement(index)) for index in measured)

    def rows(self) -> list[tuple[str, str, str, int, float, float, float, float]]:
        """Return a table: error, index, unit, number of rows that have it, and max, rms, mean, sd
        in that unit.
        """
        length, angle = (find_unit(symbol) for symbol in self.units)
        scale = {
            "position": (length.factor_to_si, length.symbol),
            "position_balance": (length.factor_to_si, length.symbol),
            "orientation": (angle.factor_to_si, angle.symbol),
            "orientation_balance": (angle.factor_to_si, angle.symbol),
            "integrated": (1.0, "mm+rad"),
        }
        table = []
        for title, errors in self.errors().items():
            for index in INDICES:
                found = errors.statistics(index)
                if found.count:
                    factor, symbol = scale[index]
                    four = (
                        found.max / factor,
                        found.rms / factor,
                        found.mean / factor,
                        found.sd / factor,
                    )
                    table.append((title, index, symbol, found.count, *four))
        return table

    def errors(self) -> dict[str, PoseErrors]:
        """Return the errors by name."""
        return {
            "predicted before": self.before,
            "predicted after": self.after,
            "commanded before": self.commanded_before,
            "commanded after": self.commanded_after,
            "not compensable": self.not_compensable,
        }

    def __str__(self) -> str:
        head = f"{'error':<17} {'index':<20} {'n':>5} {'max':>11} {'rms':>11} {'mean':>11} {'sd':>11} unit"
        lines = [f"{len(self.poses)} rows", head]
        for title, index, symbol, count, *four in self.rows():
            lines.append(
                f"{title:<17} {index:<20} {count:>5} "
                + " ".join(f"{x:>11.4g}" for x in four)
                + f" {symbol}"
            )
        if self.failed:
            lines.append(f"left out, out of reach: poses {', '.join(self.failed)}")
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes), *self.reasons])

    def to_dict(self) -> dict[str, Any]:
        """Return the result by attribute name for JSON, SI (integrated: mm + rad)."""
        named = ("before", "after", "commanded_before", "commanded_after", "not_compensable")
        return {
            "poses": list(self.poses),
            **{name: getattr(self, name).to_dict() for name in named},
            "failed": list(self.failed),
            "limit_position": self.limit_position,
            "limit_angle": self.limit_angle,
            "passed": self.passed,
            "reasons": list(self.reasons),
            "notes": list(self.notes),
            "alignment": {name: list(parts) for name, parts in self.alignment.items()},
            "kinds": [vars(kind) for kind in self.kinds],
        }


def validate(
    fit: Identification | Mechanism,
    data: Measurements,
    limit_position: float | None = None,
    limit_angle: float | None = None,
    before: Mechanism | None = None,
    known: Mapping[str, float] | None = None,
    refit: Sequence[str] = (),
    known_before: Mapping[str, float] | None = None,
) -> Validation:
    """Compare a calibrated robot with measurements, best with ones it was not fitted to.

    Parameters
    ----------
    fit : the identification, or a calibrated robot. data : measurements held out.
    limit_position, limit_angle : quality gates [m], [rad].
    before : the geometry to compare with, and that of the controller; default: what `fit` started
        from (for a robot: its nominal values).
    known : values [SI] by name of frames, targets and surfaces that a fit found; they are kept.
        Default: those of `fit`.
    refit : names of some of them, such as `tracker*`, that were set up anew, to be found from these
        rows.
    known_before : the same for the geometry before, to compare like with like; default: the values
        with which `fit` began.

    Raises
    ------
    DataError
        Data of another robot, without rows, or with every pose out of reach.
    """
    robot = fit.robot if isinstance(fit, Identification) else fit
    old = before or (fit.initial if isinstance(fit, Identification) else fit.nominal)
    check_actuators(data, robot)
    starts, kept = _known(fit, before, (known_before, known), refit, data)
    compared = compare_predictions(old, robot, data, starts, kept)
    first, last, rows = compared.before, compared.after, list(compared.data.observations)
    poses, ok, told, units = compared.rows, compared.usable, compared.predictable, _units(robot)
    was, now, missed = (
        first.residuals(rows),
        last.residuals(rows),
        first.differences(rows, compared.reached),
    )
    after = compute_row_errors(rows, now)
    return Validation(
        poses=poses,
        before=compute_row_errors(rows, was),
        after=after,
        commanded_before=compute_row_errors(rows, [-r for r in was]),
        commanded_after=compute_row_errors(rows, [m - r for m, r in zip(missed, now, strict=True)]),
        not_compensable=compute_row_errors(rows, missed),
        failed=tuple(data.labels[i] for i in np.flatnonzero(~ok & told)),
        limit_position=limit_position,
        limit_angle=limit_angle,
        reasons=_gates(after, poses, limit_position, limit_angle, units),
        units=units,
        notes=(
            *_few(after),
            *_notes(first, last),
            *_anew(robot, compared.data, compared.solution, ok, kept),
            *untold(data, told),
        ),
        alignment=_alignment(last),
        kinds=compute_kind_errors(rows, was, now),
    )


def _known(
    fit: Identification | Mechanism,
    before: Mechanism | None,
    known: tuple[Mapping[str, float] | None, Mapping[str, float] | None],
    refit: Sequence[str],
    data: Measurements,
) -> tuple[dict[str, float], dict[str, float]]:
    """What is known of frames, targets and surfaces for the geometry before, and for the calibrated
    one.
    """
    own = fit.local if isinstance(fit, Identification) else None
    then, now = known
    kept = (own.values if own else {}) if now is None else now
    starts = (
        (own.starts if own and before is None and now is None else {}) if then is None else then
    )
    return _kept(starts, refit, data), _kept(kept, refit, data)


def _kept(known: Mapping[str, float], refit: Sequence[str], data: Measurements) -> dict[str, float]:
    """What is known, without the frames, targets and surfaces to be found anew; DataError for a
    name that is not there.
    """
    there = {name.rsplit(".", 1)[0] for name in data.unknowns.table.names}
    for pattern in refit:
        if not any(fnmatchcase(name, pattern) for name in there):
            raise DataError(
                "no frame, target or surface of these measurements is called "
                f"{pattern!r}{suggest_names(pattern, there)}; there are"
                f" {', '.join(sorted(there)) or 'none'}"
            )
    return {
        n: v
        for n, v in known.items()
        if not any(fnmatchcase(n.rsplit(".", 1)[0], pattern) for pattern in refit)
    }


def _alignment(view: PosePredictions) -> dict[str, tuple[str, ...]]:
    """Frames, targets and surfaces by where their values come from: kept as known, or fitted to
    these rows.
    """
    names = view.setup.table.names
    there = [name in view.kept for name in names]
    return {
        word: tuple(
            dict.fromkeys(
                n.rsplit(".", 1)[0] for n, c in zip(names, there, strict=True) if c is carried
            )
        )
        for word, carried in (("kept", True), ("fitted", False))
    }


def _notes(first: PosePredictions, last: PosePredictions) -> tuple[str, ...]:
    """Say where the unknowns of the measurements come from, and after which best fit errors are
    compared.
    """
    found, notes = _alignment(last), []
    if found["kept"]:
        notes.append(f"{listed(found['kept'])}: as the fit found it")
    unlike = [name for name in found["kept"] if name in _alignment(first)["fitted"]]
    if unlike:
        names = listed(unlike)
        notes.append(
            f"errors before calibration are those after the best fit of {names} to these rows, "
            "which flatters them"
        )
    if found["fitted"]:
        names = listed(found["fitted"])
        notes.append(
            f"{names}: found anew from these rows, which flatters: errors are those after the best "
            f"fit of {names}"
        )
    return tuple(notes)


def _anew(
    robot: Mechanism, data: Measurements, found: Solution, ok: np.ndarray, kept: Mapping[str, float]
) -> tuple[str, ...]:
    """Say which of the frames, targets and surfaces that are kept seem to have been set up anew."""
    table = data.unknowns.table
    owner = {p.name: p.name.rsplit(".", 1)[0] for p in table.entries}
    rows = list(data.observations)

    def sizes(refit: tuple[str, ...]) -> tuple[float, int]:
        try:
            view = predict_poses(
                robot,
                data,
                found,
                ok,
                {name: v for name, v in kept.items() if owner.get(name) not in refit},
            )
        except DataError:  # too few rows to find it from
            return float("nan"), 0
        errors = [
            np.where(o.present, r, 0.0) for o, r in zip(rows, view.residuals(rows), strict=True)
        ]
        total = sum(
            float(((o.whitener @ e[..., None]) ** 2).sum())
            for o, e in zip(rows, errors, strict=True)
        )
        free = sum(p.free and owner[p.name] in refit for p in table.entries)
        left = sum(o.n_residuals for o in rows) - free
        return float(np.sqrt(total / max(left, 1))), left

    names = dict.fromkeys(owner[p.name] for p in table.entries if p.free and p.name in kept)
    moved = find_moved_setups(tuple(names), sizes)
    return () if moved is None else (moved.sentence,)


def _few(after: PoseErrors) -> tuple[str, ...]:
    """Say which errors too few rows measure to judge them by."""
    counts = {index: after.statistics(index).count for index in ("position", "orientation")}
    rows = {
        index: f"only {n} row{' measures' if n == 1 else 's measure'} {index}"
        for index, n in counts.items()
    }
    return tuple(
        f"{rows[index]}: too few to judge its errors by"
        for index, n in counts.items()
        if 0 < n < FEW
    )


def _units(robot: Mechanism) -> tuple[str, str]:
    length, angle = (
        robot.units.get(d, DISPLAY_UNITS[d].symbol) for d in (Dimension.LENGTH, Dimension.ANGLE)
    )
    return length, angle


def _gates(
    after: PoseErrors,
    poses: tuple[str, ...],
    position: float | None,
    angle: float | None,
    units: tuple[str, str],
) -> tuple[str, ...]:
    """Sentences for the gates that are not met; a gate on what was not measured is not met."""
    reasons = []
    for name, limit, symbol in (("position", position, units[0]), ("orientation", angle, units[1])):
        if limit is None:
            continue
        values = getattr(after, name)
        if not np.isfinite(values).any():
            reasons.append(f"the {name} limit cannot be checked: no row measures {name}")
            continue
        worst, factor = int(np.nanargmax(values)), find_unit(symbol).factor_to_si
        if values[worst] > limit:
            reasons.append(
                f"{name} error {values[worst] / factor:.4g} {symbol} at pose {poses[worst]} "
                "exceeds the limit of"
                f" {limit / factor:.4g} {symbol}"
            )
    return tuple(reasons)
