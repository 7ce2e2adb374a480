# SPDX-License-Identifier: Apache-2.0
"""Residuals of a fit, sorted for drawing: one series for each kind and component."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.apply.validation_findings import owner_of
from loopcal.estimate.residuals import KindResiduals
from loopcal.findings.wording import list_names
from loopcal.measure.kinds.joints.actuator_readings import ActuatorReadings
from loopcal.mechanism import Mechanism
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension, Unit

READING_PREFIX, TIME = "reading ", "time"
"""Start of the name of an actuator reading, and name of the time."""


@dataclass(frozen=True, eq=False)
class ResidualSeries:
    """The residuals of one component of one kind, without rows that were not measured.

    Attributes
    ----------
    kind, component : names. dimension : of the residuals.
    poses : (r,) number of the pose of each row, in order of measurement.
    raw : (r,) [SI]. whitened : (r,) over sigma.
    quantities : name -> (r,), what the residuals are drawn against [SI], [s], [degC].
    """

    kind: str
    component: str
    dimension: Dimension
    poses: IntArray
    raw: FloatArray
    whitened: FloatArray
    quantities: dict[str, FloatArray]

    @property
    def is_reading(self) -> bool:
        """Whether these are actuator readings, of which estimated poses take up a part."""
        return self.kind == ActuatorReadings.name

    @property
    def label(self) -> str:
        """Component and kind."""
        return self.kind if self.component in {"", self.kind} else f"{self.kind} {self.component}"


def list_poses(residuals: Sequence[KindResiduals]) -> tuple[str, ...]:
    """Return the labels of all poses with residuals, in order of measurement."""
    return tuple(dict.fromkeys(label for rows in residuals for label in rows.poses))


def list_series(robot: Mechanism, residuals: Sequence[KindResiduals]) -> list[ResidualSeries]:
    """Return residuals by kind and component."""
    place = {label: i for i, label in enumerate(list_poses(residuals), 1)}
    return [series for rows in residuals for series in _split(robot, rows, place)]


def _split(
    robot: Mechanism, rows: KindResiduals, place: dict[str, int]
) -> Iterator[ResidualSeries]:
    """Yield the components of one kind."""
    poses = np.array([place[label] for label in rows.poses], dtype=np.intp)
    actuators = [f"{READING_PREFIX}{actuator.name}" for actuator in robot.actuators]
    quantities = {**dict(zip(actuators, rows.readings.T, strict=False)), **rows.context}
    for j, component in enumerate(rows.components):
        used = _are_used(rows.raw[:, j], rows.whitened[:, j])
        yield ResidualSeries(
            rows.kind,
            component,
            rows.dimensions[j],
            poses[used],
            rows.raw[used, j],
            rows.whitened[used, j],
            {name: values[used] for name, values in quantities.items()},
        )


def _are_used(raw: FloatArray, whitened: FloatArray) -> BoolArray:
    """Return which residuals were measured and count: a row of weight 0 has no whitened one."""
    return np.isfinite(raw) & ((whitened != 0.0) | (raw == 0.0))


def list_quantities(series: list[ResidualSeries]) -> list[str]:
    """Return the quantities that vary: readings, then time, then temperatures."""
    names = dict.fromkeys(name for s in series for name in s.quantities)
    varying = []
    for name in names:
        values = np.concatenate([s.quantities[name] for s in series if name in s.quantities])
        known = values[np.isfinite(values)]
        if len(known) and np.ptp(known) > 0.0:
            varying.append(name)
    return varying


def find_quantity_unit(robot: Mechanism, name: str) -> tuple[float, str]:
    """Return the factor to SI and the symbol of a quantity that residuals are drawn against."""
    if name.startswith(READING_PREFIX):
        wanted = name.removeprefix(READING_PREFIX)
        (actuator,) = (a for a in robot.actuators if a.name == wanted)
        unit: Unit = robot.get_unit(actuator.dimension)
        return unit.factor_to_si, unit.symbol
    return 1.0, "s" if name == TIME else "degC"


def describe_residual_frame(setup: Sequence[str]) -> str:
    """Return in words what residuals are differences of, and after the fit of which frames.

    Parameters
    ----------
    setup : names of the fitted setup parameters, such as `tracker.x`.
    """
    owners = tuple(dict.fromkeys(owner_of(name) for name in setup))
    fitted = f"after the best fit of {list_names(owners, 4)}" if owners else "in the stated frames"
    return f"predicted - measured, {fitted}"
