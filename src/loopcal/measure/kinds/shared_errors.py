# SPDX-License-Identifier: Apache-2.0
"""Errors that all rows of a session share, as unknowns of any kind: a bias, and a linear drift.

The measured values of a session are off by `bias + progress * drift`, with `progress` from -0.5 in
its first row to 0.5 in its last one. Each has one number for each measured component, in the units
of its noise; targets that one row measures share it. The drift is thus the change over the session.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from loopcal.measure.kinds.error_groups import list_error_groups
from loopcal.measure.kinds.setup_parameters import SetupItem
from loopcal.numerics.sorted_values import find_distinct
from loopcal.parameters import Parameter
from loopcal.typing import FloatArray
from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.measure.kinds.kind import Kind
    from loopcal.measure.kinds.rows import Evaluation

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
