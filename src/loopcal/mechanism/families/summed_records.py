# SPDX-License-Identifier: Apache-2.0
"""Drives of `limbs` files whose readings are sums of joint values: `sum: {m: 1, n: 2}`.

The names are those that limbs state under `actuated:`. In a file with a sum, every reading is under
`actuators:`, in the order of the columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Protocol

import numpy as np

from loopcal.errors import MechanismError, suggest_names
from loopcal.mechanism.assembly import Address, LinearMap
from loopcal.mechanism.families.error_models import ErrorModel, join_errors, single_error
from loopcal.mechanism.families.records import RatioTolerance, standard_deviation
from loopcal.mechanism.transmission.sums import count_independent
from loopcal.units import Dimension

WEIGHT = "weight"


class SummedDrive(Protocol):
    """What a drive of a sum states beside its transmission."""

    @property
    def unknown(self) -> tuple[str, ...]:
        """Names of the terms to identify."""
        ...

    @property
    def weights(self) -> RatioTolerance | None:
        """Tolerance of the weights."""
        ...


class SumError(MechanismError):
    """An impossible sum; `actuator` is the name under which a file states it."""

    def __init__(self, sentence: str, actuator: str) -> None:
        super().__init__(sentence)
        self.actuator = actuator


def has_sums(actuators: Mapping[str, object]) -> bool:
    """Return whether a drive of a file is a sum."""
    return any(getattr(drive, "sum", None) for drive in actuators.values())


def list_readings(
    actuators: Mapping[str, object], joints: Mapping[str, str]
) -> dict[str, tuple[str, Mapping[str, float]]]:
    """Return the readings of a file with sums: name -> (key in the file, weights of joints).

    joints : driven joints by name, each with the name that the file states; a drive that copies of
    a limb have in common is one reading for each copy.

    Raises
    ------
    SumError
        A triangle drive, or a drive that is no sum and moves no joint.
    """
    readings: dict[str, tuple[str, Mapping[str, float]]] = {}
    for key, drive in actuators.items():
        weights: Mapping[str, float] | None = getattr(drive, "sum", None)
        if weights is None:
            raise SumError(
                f"actuator {key!r} is a triangle drive beside sums; let it drive a stage of its "
                "own in a file of the family stages",
                key,
            )
        if weights:
            readings[key] = key, weights
            continue
        own = [name for name, stated in joints.items() if key in (name, stated)]
        if not own:
            raise SumError(
                f"actuator {key!r} drives no joint and states no `sum:`; write 'actuated: {key}' "
                f"at a joint, or the sum that it reads of {', '.join(joints)}",
                key,
            )
        readings |= {name: (key, {name: 1.0}) for name in own}
    return readings


def check_sums(
    sums: Mapping[str, Mapping[str, float]], turning: Mapping[str, bool], known: Mapping[str, str]
) -> None:
    """Refuse sums that are no readings of the driven joints.

    Parameters
    ----------
    sums : weights of all readings of a file by name; of a drive without a sum {joint: 1}.
    turning : whether each driven joint is rotary. known : driven joint -> its limb.

    Raises
    ------
    SumError
        An unknown joint, a sum of an angle and a length, weights that are all zero or not finite,
        a joint in no sum, more readings than joints, or sums that depend on each other.
    """
    for name, weights in sums.items():
        _check_sum(name, weights, turning)
    read = {joint for weights in sums.values() for joint, w in weights.items() if w != 0.0}
    unread = [joint for joint in turning if joint not in read]
    if unread:
        raise SumError(
            f"joint {unread[0]!r} of limb {known[unread[0]]!r} is in no sum, so no reading states "
            f"it; add it to a `sum:`, or list {unread[0]!r} among the actuators",
            next(iter(sums)),
        )
    W = np.array([[weights.get(joint, 0.0) for joint in turning] for weights in sums.values()])
    a, joints = W.shape
    if a > joints:
        raise SumError(
            f"{a} readings ({', '.join(sums)}) are sums of {joints} joints "
            f"({', '.join(turning)}); leave out readings",
            list(sums)[-1],
        )
    for i in range(a):
        if count_independent(W[: i + 1]) <= i:
            name = list(sums)[i]
            raise SumError(
                f"the weights of the sums are singular: that of actuator {name!r} follows from "
                f"those of {', '.join(list(sums)[:i])}, so it states nothing new; correct a weight",
                name,
            )


def _check_sum(name: str, weights: Mapping[str, float], turning: Mapping[str, bool]) -> None:
    """Refuse a sum of unknown joints, of unlike joints, or without a weight."""
    for joint, weight in weights.items():
        if joint not in turning:
            raise SumError(
                f"the sum of actuator {name!r} names {joint!r}, which no limb states under "
                f"'actuated:'{suggest_names(joint, list(turning))}; allowed are "
                f"{', '.join(turning)}",
                name,
            )
        if not np.isfinite(weight):
            raise SumError(
                f"the weight of {joint!r} in the sum of actuator {name!r} is {weight:g}; state a "
                "finite number",
                name,
            )
    if not any(weights.values()):
        raise SumError(
            f"all weights in the sum of actuator {name!r} are zero, so its reading states nothing; "
            "give a weight other than 0",
            name,
        )
    angles = [joint for joint in weights if turning[joint]]
    lengths = [joint for joint in weights if not turning[joint]]
    if angles and lengths:
        raise SumError(
            f"actuator {name!r} is a sum of the angle {angles[0]!r} and the length {lengths[0]!r}; "
            "sum joints of one kind, and describe a screw with the `lead:` of its joint",
            name,
        )


def is_weight(weights: Mapping[str, float], term: str) -> bool:
    """Return whether an unknown of a drive is a weight of its sum."""
    return bool(weights) and term.partition(".")[0] == WEIGHT


def weight_errors(
    name: str, drive: object, weights: Mapping[str, float], other: tuple[str, ...]
) -> ErrorModel:
    """Return the unknown weights of a sum, `q1.weight.m` and so on.

    Parameters
    ----------
    other : terms of the drive beside the weights.

    Raises
    ------
    SumError
        The weight of a joint that is not in the sum.
    """
    unknown: tuple[str, ...] = getattr(drive, "unknown", ())
    tolerance: RatioTolerance | None = getattr(drive, "weights", None)
    errors = []
    for joint in _expand_unknowns(unknown, weights):
        if joint not in weights:
            allowed = (*other, WEIGHT, *(f"{WEIGHT}.{known}" for known in weights))
            raise SumError(
                f"actuator {name!r} has no term {WEIGHT + '.' + joint!r}; allowed are "
                f"{', '.join(allowed)}",
                name,
            )
        parameter = f"{name}.{WEIGHT}.{joint}"
        address = Address(name, "transmission", f"{WEIGHT}.{joint}")
        sd = standard_deviation(tolerance, parameter)
        entry = LinearMap(parameter, address)
        errors.append(single_error(parameter, Dimension.RATIO, weights[joint], sd, entry))
    return join_errors(errors)


def _expand_unknowns(unknown: tuple[str, ...], weights: Mapping[str, float]) -> Iterator[str]:
    """Yield the joints whose weights are unknown; `weight` means all of a sum."""
    for term in unknown:
        if weights and term == WEIGHT:
            yield from weights
        elif is_weight(weights, term):
            yield term.partition(".")[2]
