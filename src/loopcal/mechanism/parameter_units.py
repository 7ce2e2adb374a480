# SPDX-License-Identifier: Apache-2.0
"""The parameters by which poses are differentiated, and how they move displacements and joints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from loopcal.engine import MapPattern, ParameterMap
from loopcal.mechanism.transmission import find_triangles, joint_slopes, term_derivatives
from loopcal.typing import FloatArray, IntArray

if TYPE_CHECKING:
    from loopcal.mechanism.model import SlotMap


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
        slots, cut = self.slots, len(self._pattern.displacements)
        slopes = self._constant
        if slots.shared:
            of_slots, of_columns, units = self._entries
            slopes = slots.jacobian(values)[:, of_slots, of_columns] * units
        return ParameterMap(
            self._pattern,
            slopes[:, :cut],
            slopes[:, cut:],
            self._evaluate_terms(q, tau),
            joint_slopes(q, tau, slots.frequency),
        )

    def _evaluate_terms(self, q: FloatArray, tau: FloatArray) -> FloatArray:
        """Return what the moved transmission terms contribute, (t | 1, n | 1, a, terms)."""
        w = self.slots.frequency
        has_offsets_only = not any(self._terms) and not len(find_triangles(tau))
        if not self._terms or has_offsets_only:
            # offsets are the same for all poses
            return np.ones((1, 1, len(w), len(self._terms)))
        return np.stack(term_derivatives(q, tau, w, self._terms), axis=-1)

    @cached_property
    def _entries(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Slots that may move, by which column of all parameters, and its unit, (z,) each."""
        slot, parameter = np.nonzero(self.slots.touches[:, self.places])
        return slot, self.places[parameter], self.units[parameter]

    @cached_property
    def _constant(self) -> FloatArray:
        """Derivatives (1, z) of slots without shared maps."""
        slot, column, unit = self._entries
        return (self.slots.matrix[slot, column] * unit)[None]

    @cached_property
    def _terms(self) -> tuple[int, ...]:
        """Numbers of the transmission terms that these parameters move."""
        moved = self._entries[0] - self.slots.n_displacements
        return tuple(np.unique(moved[moved >= 0] % self.slots.terms.shape[1]).tolist())

    @cached_property
    def _pattern(self) -> MapPattern:
        """Entries as the engine knows them; displacements are the first slots."""
        slot, parameter = np.nonzero(self.slots.touches[:, self.places])
        cut = int(np.searchsorted(slot, self.slots.n_displacements))
        joint, term = np.divmod(slot[cut:] - self.slots.n_displacements, self.slots.terms.shape[1])
        function = np.searchsorted(np.array(self._terms, dtype=np.int64), term)
        return MapPattern(
            len(self.places),
            np.column_stack([slot[:cut], parameter[:cut]]),
            np.column_stack([joint, function, parameter[cut:]]),
        )
