# SPDX-License-Identifier: Apache-2.0
"""Proofs that Newton's method from a start converges to a known solution: NumPy gives none.

They only save time, which another engine can use. Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from loopcal.engine.program import Program, State
from loopcal.typing import FloatArray


def has_driven_rods(program: Program) -> bool:
    """Return whether the mechanism has six freedoms and six limbs, each a driven rod alone."""
    return (
        len(program.freedoms) == 6
        and not program.others
        and sum(len(group.limbs) for group in program.groups) == 6
        and all(
            g.ending == "distance" and not g.joints and g.actuator[0, 0] >= 0
            for g in program.groups
        )
    )


def certify(program: Program, e: FloatArray, start: State, goal: State) -> NDArray[np.int8]:
    """Prove nothing, see `loopcal.engine.certify`."""
    return np.zeros(goal.T.shape[:2], np.int8)
