# SPDX-License-Identifier: Apache-2.0
"""The parameters by which poses are differentiated, and how they move displacements and joints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from loopcal.engine import MapPattern, ParameterMap
from loopcal.mechanism.transmission.sums import invert_weights
from loopcal.mechanism.transmission.terms import (
    differentiate_sums,
    find_triangles,
    joint_slopes,
    joints_from_readings,
    select_weights,
    term_derivatives,
)
from loopcal.typing import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from loopcal.mechanism.model import SlotMap


class MovedSlots(NamedTuple):
    """Which slots of a mechanism some parameters move.

    Attributes
    ----------
    slots, columns : (z,) slots that may move, and by which of the parameters. A term of a summed
        drive is there once for each joint, because it moves all of them.
    terms : numbers of the transmission terms among them; of summed drives, counted through all
        actuators.
    pattern : the same as the engine knows it; displacements are the first slots.
    """

    slots: IntArray
    columns: IntArray
    terms: tuple[int, ...]
    pattern: MapPattern


def find_moved_slots(
    touches: BoolArray, n_displacements: int, n_terms: int, n_summed: int = 0
) -> MovedSlots:
    """Return the slots that p parameters move.

    touches : (s, p) which of the slots each may move. n_terms : of the transmission of an actuator.
    n_summed : joints whose values are in sums.
    """
    slot, column = np.nonzero(touches)
    cut = int(np.searchsorted(slot, n_displacements))
    joint, term = np.divmod(slot[cut:] - n_displacements, n_terms)
    if n_summed:
        term = np.tile(slot[cut:] - n_displacements, n_summed)
        joint = np.repeat(np.arange(n_summed), len(slot) - cut)
        slot, column = (
            np.concatenate([part[:cut], np.tile(part[cut:], n_summed)]) for part in (slot, column)
        )
    terms, function = np.unique(term, return_inverse=True)
    pattern = MapPattern(
        touches.shape[1],
        np.column_stack([slot[:cut], column[:cut]]),
        np.column_stack([joint, function, column[cut:]]),
    )
    return MovedSlots(slot, column, tuple(terms.tolist()), pattern)


@dataclass(frozen=True, eq=False)
class ParameterUnits:
    """Some parameters of a mechanism, each with the unit of its column.

    slots : of the mechanism. places : (p,) positions of the parameters in its table.
    units : (p,) [SI].
    """

    slots: SlotMap
    places: IntArray
    units: FloatArray

    def linearize(self, values: FloatArray, tau: FloatArray, q: FloatArray) -> ParameterMap:
        """Return how these parameters and the readings move displacements and joint values.

        values : (t | 1, all). tau : (t | 1, a, k) their terms. q : (t | 1, n, a) readings.
        """
        slots, pattern = self.slots, self.slots.moved_by(self.places).pattern
        cut = len(pattern.displacements)
        slopes = self._constant
        if slots.shared:
            of_slots, of_columns, units = self._entries
            slopes = slots.jacobian(values)[:, of_slots, of_columns] * units
        return ParameterMap(
            pattern,
            slopes[:, :cut],
            slopes[:, cut:],
            self._evaluate_terms(q, tau),
            self._evaluate_slopes(q, tau),
        )

    def _evaluate_slopes(self, q: FloatArray, tau: FloatArray) -> FloatArray:
        """Return d joint / d reading (t | 1, n | 1, a); with summed drives one for each joint, so
        that derivatives by readings are those by joints.
        """
        if (weights := select_weights(tau)) is not None:
            return np.ones((1, 1, weights.shape[-1]))
        return joint_slopes(q, tau, self.slots.frequency)

    def _evaluate_terms(self, q: FloatArray, tau: FloatArray) -> FloatArray:
        """Return what the moved transmission terms contribute, (t | 1, n | 1, a, terms)."""
        w, terms = self.slots.frequency, self.slots.moved_by(self.places).terms
        if (weights := select_weights(tau)) is not None:
            actuators, numbers = np.divmod(np.array(terms, np.int64), tau.shape[-1])
            slopes = differentiate_sums(q, tau, w, joints_from_readings(q, tau, w))
            inverse = invert_weights(weights)[:, None][..., actuators]
            return inverse * slopes[:, :, None, actuators, numbers]
        has_offsets_only = not any(terms) and not len(find_triangles(tau))
        if not terms or has_offsets_only:
            # offsets are the same for all poses
            return np.ones((1, 1, len(w), len(terms)))
        return np.stack(term_derivatives(q, tau, w, terms), axis=-1)

    @cached_property
    def _entries(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Slots that may move, by which column of all parameters, and its unit, (z,) each."""
        moved = self.slots.moved_by(self.places)
        return moved.slots, self.places[moved.columns], self.units[moved.columns]

    @cached_property
    def _constant(self) -> FloatArray:
        """Derivatives (1, z) of slots without shared maps."""
        slot, column, unit = self._entries
        return (self.slots.matrix[slot, column] * unit)[None]
