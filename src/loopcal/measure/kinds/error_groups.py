# SPDX-License-Identifier: Apache-2.0
"""The errors that the residuals of a kind are: of which quantity, and of which target.

A row with three targets has three position errors, a full pose has a position and an orientation
error. The residuals of one group are components of one error, whose size is the root of the sum of
their squares. Lengths are not position errors: they are known along one line only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from loopcal.units import Dimension

if TYPE_CHECKING:
    from loopcal.measure.kinds.kind import Kind


class ErrorGroup(NamedTuple):
    """Residuals that are the components of one error.

    Attributes
    ----------
    quantity : what the error is of, such as "position" or "length". dimension : of its number.
    target : name of the target or joint, empty where a row has only one.
    components : names of the components, such as ("x", "y", "z").
    columns : their indices among the m residuals.
    """

    quantity: str
    dimension: Dimension
    target: str
    components: tuple[str, ...]
    columns: tuple[int, ...]


def list_error_groups(kind: Kind) -> tuple[ErrorGroup, ...]:
    """Return the errors of one row of a kind."""
    residuals = kind.noise_columns
    targets = {"": tuple(range(len(residuals)))}
    if kind.sensed_joints and not kind.of:
        targets = {name: (i,) for i, name in enumerate(kind.sensed_joints)}
    elif residuals == kind.columns:
        targets = dict(kind.target_columns)
    quantities = {Dimension.LENGTH: kind.length_error, Dimension.ANGLE: kind.angle_error}
    groups = []
    for target, places in targets.items():
        for dimension, quantity in quantities.items():
            columns = tuple(i for i in places if residuals[i].dimension is dimension)
            names = tuple(residuals[i].name.removeprefix(f"{target}.") for i in columns)
            if columns:
                label = target if len(targets) > 1 else ""
                groups.append(ErrorGroup(quantity, dimension, label, names, columns))
    return tuple(groups)
