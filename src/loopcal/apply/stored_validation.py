# SPDX-License-Identifier: Apache-2.0
"""A validation in a run folder: its numbers in result.json, and its differences as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from loopcal.apply.validation import Validation
from loopcal.diagnose import Blunder, KindErrors, NoiseFloor, PoseErrors
from loopcal.diagnose.fit_checks.blunders import Explanation
from loopcal.diagnose.row_errors import QuantityErrors
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray
from loopcal.units import Dimension

ERRORS = ("before", "after")
"""Errors whose differences are stored."""

PREFIX = "held_out"
"""First word of the names of the stored arrays, `held_out_<before or after>_<quantity>`."""


def store_differences(validation: Validation) -> dict[str, FloatArray]:
    """Return the differences (e, 3) [SI] of the errors before and after, by name."""
    return {
        f"{PREFIX}_{name}_{quantity}": errors.components
        for name in ERRORS
        for quantity, errors in getattr(validation, name).quantities.items()
    }


def restore_validation(
    content: Mapping[str, Any], arrays: Mapping[str, np.ndarray], robot: Mechanism
) -> Validation | None:
    """Return the numbers of a stored validation; None where an older version wrote it.

    Findings stay sentences of `content`. Only the errors before and after have differences by
    component; of the others, the first component is the size.

    Parameters
    ----------
    content : `Validation.to_dict()` of the run. arrays : of the run. robot : for units.
    """
    if content.get("judged") is None:
        return None
    errors = {
        name: _restore_errors(content[name], arrays, f"{PREFIX}_{name}")
        for name in ("before", "after", "commanded_before", "commanded_after", "not_compensable")
    }
    after = errors["after"]
    return Validation(
        poses=tuple(content["poses"]),
        before=errors["before"],
        after=after,
        commanded_before=errors["commanded_before"],
        commanded_after=errors["commanded_after"],
        not_compensable=errors["not_compensable"],
        noise_floor=_restore_floor(content["noise_floor"]),
        unreachable=tuple(content["failed"]),
        limit_position=content["limit_position"],
        limit_angle=content["limit_angle"],
        units={name: robot.get_unit(e.dimension) for name, e in after.quantities.items()},
        alignment={key: tuple(names) for key, names in content["alignment"].items()},
        kinds=_restore_kinds(content["kinds"]),
        setup_count=content["setup_count"],
        absorbed=content["absorbed"],
        judged=content["judged"],
        blunders=tuple(_restore_blunder(blunder) for blunder in content["blunders"]),
        without_blunders=_restore_rest(content["without_blunders"], content, robot),
    )


def _restore_rest(
    rest: Mapping[str, Any] | None, whole: Mapping[str, Any], robot: Mechanism
) -> Validation | None:
    """Return the statistics without blunders."""
    if rest is None:
        return None
    unknown = {"commanded_before": {}, "commanded_after": {}, "not_compensable": {}}
    unknown |= {"blunders": (), "without_blunders": None, "failed": ()}
    return restore_validation({**whole, **unknown, **rest}, {}, robot)


def _restore_errors(
    content: Mapping[str, Any], arrays: Mapping[str, np.ndarray], name: str
) -> PoseErrors:
    """Return the errors by quantity."""
    quantities = {}
    for quantity, stored in content.items():
        components = arrays.get(f"{name}_{quantity}")
        if components is None:
            size = np.array(stored["errors"], dtype=float)
            components = np.column_stack([size, np.full((len(size), 2), np.nan)])
        quantities[quantity] = QuantityErrors(
            Dimension[stored["dimension"].upper()],
            components,
            np.array(stored["rows"], dtype=np.intp),
            tuple(stored["targets"]),
            tuple(stored["components"]),
        )
    return PoseErrors(quantities)


def _restore_floor(content: Mapping[str, Any]) -> NoiseFloor:
    """Return the noise floor."""
    rms, largest = (
        {quantity: _number(value) for quantity, value in content[key].items()}
        for key in ("rms", "max")
    )
    return NoiseFloor(rms, largest)


def _restore_kinds(content: list[Mapping[str, Any]]) -> tuple[KindErrors, ...]:
    """Return the whitened errors of each kind."""
    keys = ("before", "after", "noise_floor")
    return tuple(
        KindErrors(
            kind["kind"],
            kind["count"],
            *(_number(kind[key]) for key in keys),
            change=_number(kind.get("change")),
        )
        for kind in content
    )


def _restore_blunder(content: Mapping[str, Any]) -> Blunder:
    """Return a pose that does not fit, without its explanation."""
    numbers = (_number(content["times"]), _number(content["p_value"]))
    return Blunder(tuple(content["poses"]), *numbers, Explanation("none"))


def _number(value: float | None) -> float:
    """Return a number of a file, in which null is not finite."""
    return float("nan") if value is None else float(value)
