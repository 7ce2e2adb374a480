# SPDX-License-Identifier: Apache-2.0
"""Residuals of a fit with their labels, also as arrays of a run folder."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from loopcal.typing import FloatArray
from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.estimate.observation_rows import ObservationRows, Residuals
    from loopcal.estimate.problem import Problem
    from loopcal.measure import Measurements


@dataclass(frozen=True, eq=False)
class KindResiduals:
    """Residuals (predicted - measured) of the rows of one kind after the fit.

    Attributes
    ----------
    kind : its name. components : names of the m residuals. poses : (r,) labels.
    raw : (r, m) [SI]. whitened : (r, m), divided by sigma (zero where absent).
    context : name -> (r,), time [s] and temperatures [degC] of the rows, to plot the residuals
        against.
    dimensions : (m,) of the components. readings : (r, a) actuator readings of the rows [SI], of
        the first pose where a row compares several; NaN where missing.
    """

    kind: str
    components: tuple[str, ...]
    poses: tuple[str, ...]
    raw: FloatArray
    whitened: FloatArray
    context: Mapping[str, FloatArray] = field(default_factory=dict)
    dimensions: tuple[Dimension, ...] = ()
    readings: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def __repr__(self) -> str:
        """Return the kind and the size of the residuals."""
        return f"<KindResiduals of {self.kind}: {len(self.raw)} rows of {len(self.components)}>"


OWN = ("residual", "whitened", "components", "dimensions", "rows", "readings")
"""First words of the names of stored arrays, beside those of the context; `rows` are labels."""

_NAME = re.compile(r"residual_(\d+)_(.+)", re.DOTALL)


def store_residuals(residuals: Sequence[KindResiduals]) -> dict[str, np.ndarray]:
    """Return residuals by name, `<what>_<i>_<kind>`; a quantity of the context keeps its name."""
    stored: dict[str, np.ndarray] = {}
    for i, r in enumerate(residuals):
        dimensions = np.array([dimension.value for dimension in r.dimensions], str)
        components, labels = np.array(r.components, str), np.array(r.poses, str)
        named = (r.raw, r.whitened, components, dimensions, labels, r.readings)
        arrays = {**r.context, **dict(zip(OWN, named, strict=True))}
        stored |= {f"{name}_{i}_{r.kind}": array for name, array in arrays.items()}
    return stored


def residuals_from_arrays(arrays: Mapping[str, np.ndarray]) -> tuple[KindResiduals, ...]:
    """Return the residuals in the arrays of a run folder; none where an older version wrote it."""
    matches = [match for name in arrays if (match := _NAME.fullmatch(name))]
    result = []
    for match in sorted(matches, key=lambda m: int(m[1])):
        ending = f"_{match[1]}_{match[2]}"
        own = {name: arrays.get(name + ending) for name in OWN}
        if any(array is None for array in own.values()):
            return ()
        raw, whitened, components, dimensions, labels, readings = (arrays[n + ending] for n in OWN)
        result.append(
            KindResiduals(
                kind=match[2],
                components=tuple(components.tolist()),
                poses=tuple(labels.tolist()),
                raw=raw,
                whitened=whitened,
                context={
                    name.removesuffix(ending): array
                    for name, array in arrays.items()
                    if name.endswith(ending) and not name.startswith((*OWN, "fitted_"))
                },
                dimensions=tuple(Dimension(value) for value in dimensions.tolist()),
                readings=readings,
            )
        )
    return tuple(result)


def label_residuals(
    residuals: tuple[Residuals, ...], data: Measurements, problem: Problem
) -> tuple[KindResiduals, ...]:
    """Return the residuals (t = 1) of every kind with labels; those of uncertain readings last."""
    observations = [o for o in data.all_observations if len(o)]
    present, context = [o.present for o in observations], [o.context for o in observations]
    if problem.is_uncertain:
        present.append(np.isfinite(data.readings))
        context.append(data.context)
    return tuple(
        KindResiduals(
            kind=s.kind.name,
            components=tuple(column.name for column in s.kind.noise_columns),
            poses=_label_rows(s, data.labels),
            raw=np.where(measured, r.raw[0], np.nan),
            whitened=r.whitened[0],
            context=columns,
            dimensions=tuple(column.dimension for column in s.kind.noise_columns),
            readings=_take_readings(s, data.readings),
        )
        for s, measured, columns, r in zip(problem.rows, present, context, residuals, strict=True)
    )


def _take_readings(rows: ObservationRows, readings: FloatArray) -> FloatArray:
    """Return the readings (r, a) of the first pose of each row; NaN for targets on the base."""
    of_first = readings[rows.poses_by_link[:, 0]]
    return np.full_like(of_first, np.nan) if rows.kind.is_of_base else of_first


def _label_rows(rows: ObservationRows, labels: tuple[str, ...]) -> tuple[str, ...]:
    """Return a label for each row: those of the poses that it observed, or "base"."""
    poses = rows.poses_by_link
    if rows.kind.is_of_base:
        return (rows.kind.of,) * len(poses)
    if poses.shape[1] == 1:
        return tuple(map(labels.__getitem__, poses[:, 0].tolist()))
    return tuple("/".join(labels[i] for i in members) for members in poses.tolist())
