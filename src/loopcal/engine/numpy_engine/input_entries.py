# SPDX-License-Identifier: Apache-2.0
"""What parameters and readings move in each limb: the entries of a map, group by group."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loopcal.engine.program import Group, ParameterMap
from loopcal.typing import FloatArray, IntArray


class Entries(NamedTuple):
    """Entries of a map that move the k limbs of a group, sorted by limb and parameter.

    limb, column, parameter : (z,); columns are the slots, then the driven joints. coefficient :
    (t | 1, z). basis : (t | 1, n | 1, z), one for displacements. driven : the driven joints.
    """

    limb: IntArray
    column: IntArray
    parameter: IntArray
    coefficient: FloatArray
    basis: FloatArray
    driven: tuple[int, ...]

    def by_parameter(
        self, columns: FloatArray, p: int, trial: IntArray, pose: IntArray
    ) -> FloatArray:
        """Return the rows of all limbs by p parameters, (N, r k, p), of columns (N, r, c, k)."""
        N, r, c, k = columns.shape
        factor = pick_rows(self.basis, trial, pose) * pick_rows(self.coefficient, trial)
        values = columns.reshape(N, r, c * k)[..., self.column * k + self.limb] * factor[:, None]
        target = self.limb * p + self.parameter
        begin = np.flatnonzero(np.diff(target, prepend=-1))
        if len(begin) < len(target):  # several entries of one parameter in one limb
            values, target = np.add.reduceat(values, begin, axis=2), target[begin]
        out = np.zeros((N, r, k * p))
        out[..., target] = values
        return out.reshape(N, r * k, p)

    def by_reading(self, columns: FloatArray, readings: FloatArray, group: Group) -> FloatArray:
        """Return the rows by a readings, (N, r k, a), of columns (N, r, c, k)."""
        N, r, _, k = columns.shape
        out = np.zeros((N, r, k, readings.shape[-1]))
        for i, j in enumerate(self.driven):
            actuator = group.actuator[j]
            slopes = columns[:, :, len(group.slots) + i] * readings[:, None, actuator]
            out[:, :, np.arange(k), actuator] += slopes
        return out.reshape(N, r * k, -1)


def pick_rows(array: FloatArray, *rows: IntArray) -> FloatArray:
    """Return the rows of an array whose leading axes may be 1 and then broadcast."""
    return array[
        tuple(i if length > 1 else 0 * i[:1] for i, length in zip(rows, array.shape, strict=False))
    ]


def select_entries(group: Group, inputs: ParameterMap) -> Entries:
    """Return the entries of a group."""
    pattern, slots = inputs.pattern, len(group.slots)
    place, parameter = pattern.displacements.T
    own = np.flatnonzero((place >= group.columns.start) & (place < group.columns.stop))
    limb, column = np.divmod(place[own] - group.columns.start, max(slots, 1))
    ones = np.ones((*inputs.basis.shape[:2], len(own)))
    parts = [(limb, column, parameter[own], inputs.displacements[:, own], ones)]
    driven = tuple(np.flatnonzero(group.actuator[:, 0] >= 0).tolist())
    joint, function, parameter = pattern.joints.T
    for i, j in enumerate(driven):
        limb, own = np.nonzero(group.actuator[j][:, None] == joint)
        basis = inputs.basis[:, :, joint[own], function[own]]
        column = np.full(len(own), slots + i)
        parts.append((limb, column, parameter[own], inputs.joints[:, own], basis))
    arrays = [np.concatenate(of_all, axis=-1) for of_all in zip(*parts, strict=True)]
    order = np.lexsort((arrays[2], arrays[0]))
    return Entries(*(array[..., order] for array in arrays), driven=driven)
