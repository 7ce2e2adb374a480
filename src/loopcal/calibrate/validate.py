# SPDX-License-Identifier: Apache-2.0
"""Prove a calibration on poses it has not seen, before and after, with two errors told apart.

Prediction error: what the model predicts at the readings that were measured, against what was measured.
Commanded error: where the machine goes when it is told to reach a pose with this geometry, against that pose. The poses
asked for are those that the geometry before calibration believes in at the measured readings, so before calibration the
machine's answer was measured. After calibration the readings change, by little; the machine is then taken to differ from
the identified model as it did at the measured readings. What no actuator can reach is shown as not compensable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.calibrate.checks import check_known
from loopcal.calibrate.identification import Identification
from loopcal.calibrate.pose_errors import INDICES, PoseErrors, pose_errors
from loopcal.errors import DataError
from loopcal.linalg import FloatArray
from loopcal.measure import Measurements, Observations, check_actuators
from loopcal.mechanism import Mechanism, forward, inverse
from loopcal.units import DISPLAY_UNITS, Dimension, unit


@dataclass(frozen=True, eq=False)
class Validation:
    """Errors on measured poses before and after calibration; rows are the r rows of all kinds.

    Attributes
    ----------
    poses : (r,) labels.
    before, after : prediction error at equal readings.
    commanded_before, commanded_after : pose error of the machine after commanding.
    not_compensable : the part of `commanded_after` for which the machine has no actuator.
    failed : labels of poses that one of the two geometries cannot reach; they are left out of all statistics.
    limit_position, limit_angle : quality gates [m], [rad] on the largest prediction error after; None for no gate.
    reasons : a sentence for each gate that is not met.
    units : display symbols of length and angle.
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

    @property
    def passed(self) -> bool:
        """Whether every quality gate is met."""
        return not self.reasons

    def improvement(self, index: str = "position", statistic: str = "rms") -> float:
        """Return how many times smaller a statistic of the prediction error became."""
        after = getattr(self.after.statistics(index), statistic)
        return getattr(self.before.statistics(index), statistic) / after if after > 0.0 else np.inf

    def rows(self) -> list[tuple[str, str, str, float, float, float, float]]:
        """Return a table: error, index, unit, and max, rms, mean, sd in that unit."""
        length, angle = (unit(symbol) for symbol in self.units)
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
                    four = (found.max / factor, found.rms / factor, found.mean / factor, found.sd / factor)
                    table.append((title, index, symbol, *four))
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
        head = f"{'error':<17} {'index':<20} {'max':>11} {'rms':>11} {'mean':>11} {'sd':>11} unit"
        lines = [f"{len(self.poses)} rows", head]
        for title, index, symbol, *four in self.rows():
            lines.append(f"{title:<17} {index:<20} " + " ".join(f"{x:>11.4g}" for x in four) + f" {symbol}")
        if self.failed:
            lines.append(f"left out, out of reach: poses {', '.join(self.failed)}")
        return "\n".join([*lines, *self.reasons])

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
        }


def validate(
    fit: Identification | Mechanism,
    data: Measurements,
    limit_position: float | None = None,
    limit_angle: float | None = None,
    before: Mechanism | None = None,
) -> Validation:
    """Compare a calibrated robot with measurements, best with ones it was not fitted to.

    Parameters
    ----------
    fit : the identification, or a calibrated robot.
    data : measurements held out.
    limit_position, limit_angle : quality gates [m], [rad].
    before : the geometry to compare with, and that of the controller; default: what `fit` started from (for a robot:
        its nominal values).

    Raises
    ------
    DataError
        Data of another robot, without rows, or with every pose out of reach.
    """
    robot = fit.robot if isinstance(fit, Identification) else fit
    old = before or (fit.initial if isinstance(fit, Identification) else fit.nominal)
    check_actuators(data, robot)
    check_known(o.kind for o in data.observations if len(o))
    rows = [o.take(o.weight > 0.0) for o in data.observations]
    rows = [o for o in rows if len(o)]
    if not rows:
        raise DataError("there is no row to validate with: every row is absent or has weight 0")
    believed, predicted = forward(old, data.readings), forward(robot, data.readings)
    reached = inverse(robot, believed.T)
    ok = believed.converged & predicted.converged & reached.converged
    if not ok.any():
        raise DataError(f"{robot.name} reaches none of the {data.n_poses} poses; check the readings and their units")
    rows = [o.take(ok[o.rows]) for o in rows]
    was = [o.evaluate(_safe(believed.T, ok)[None]).residual[0] for o in rows]
    now = [o.evaluate(_safe(predicted.T, ok)[None]).residual[0] for o in rows]
    missed = [_difference(o, _safe(reached.T, ok), _safe(believed.T, ok)) for o in rows]
    after = _errors(rows, now)
    reasons = _gates(after, _labels(rows, data), limit_position, limit_angle, _units(robot))
    return Validation(
        poses=_labels(rows, data),
        before=_errors(rows, was),
        after=after,
        commanded_before=_errors(rows, [-r for r in was]),
        commanded_after=_errors(rows, [m - r for m, r in zip(missed, now, strict=True)]),
        not_compensable=_errors(rows, missed),
        failed=tuple(data.labels[i] for i in np.flatnonzero(~ok)),
        limit_position=limit_position,
        limit_angle=limit_angle,
        reasons=reasons,
        units=_units(robot),
    )


def _safe(T: FloatArray, ok: np.ndarray) -> FloatArray:
    """Poses with the identity where they failed; rows that see those are gone."""
    return np.where(ok[:, None, None], T, np.eye(4))


def _difference(o: Observations, T: FloatArray, target: FloatArray) -> FloatArray:
    """What the kind would see between poses T and target (n, 4, 4), (r, m)."""
    r, m = o.present.shape
    wanted = o.kind.measure(target[None, o.rows], np.zeros((1, r, m)))
    return o.kind.evaluate(T[None, o.rows], wanted).residual[0]


def _errors(rows: list[Observations], residuals: list[FloatArray]) -> PoseErrors:
    """Indices of all kinds' rows, one after the other."""
    parts = []
    for o, residual in zip(rows, residuals, strict=True):
        shown = np.where(o.present, residual, np.nan)
        length = np.array([column.dimension is Dimension.LENGTH for column in o.kind.noise_columns])
        angle = np.array([column.dimension is Dimension.ANGLE for column in o.kind.noise_columns])
        parts.append(pose_errors(shown[:, length], shown[:, angle]))
    return PoseErrors(*(np.concatenate([getattr(p, index) for p in parts]) for index in INDICES))


def _labels(rows: list[Observations], data: Measurements) -> tuple[str, ...]:
    return tuple(data.labels[i] for o in rows for i in o.rows)


def _units(robot: Mechanism) -> tuple[str, str]:
    length, angle = (robot.units.get(d, DISPLAY_UNITS[d].symbol) for d in (Dimension.LENGTH, Dimension.ANGLE))
    return length, angle


def _gates(
    after: PoseErrors, poses: tuple[str, ...], position: float | None, angle: float | None, units: tuple[str, str]
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
        worst, factor = int(np.nanargmax(values)), unit(symbol).factor_to_si
        if values[worst] > limit:
            reasons.append(
                f"{name} error {values[worst] / factor:.4g} {symbol} at pose {poses[worst]} exceeds the limit of"
                f" {limit / factor:.4g} {symbol}"
            )
    return tuple(reasons)
