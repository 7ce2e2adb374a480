# SPDX-License-Identifier: Apache-2.0
"""Estimates that left what was known of the robot: where least squares is free to go, and the data
do not hold it.
"""

from __future__ import annotations

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.null_space import listed
from loopcal.estimate.methods.penalties import MAP, Method
from loopcal.typing import FloatArray

FAR = 10.0
"""Tolerances (sd) from nominal at which an estimate contradicts a tolerance that somebody stated;
noise never does that.
"""


def find_diverged(
    free: FreeParameters, deviation: FloatArray, method: Method, converged: bool
) -> list[str]:
    """Say which estimates left their stated tolerances by far, and what to do; nothing where
    tolerances are a prior.

    Parameters
    ----------
    free : the parameters. deviation : (p,) estimate - nominal, in tolerances. method : how it was
        estimated.
    converged : whether the iteration did.
    """
    if isinstance(method, MAP):
        return []
    far = np.flatnonzero((np.abs(deviation) > FAR) & ~free.assumed)
    advice = "a method with a prior (--method map) holds what the data do not tell"
    if not len(far):
        return (
            []
            if converged or free.assumed.all()
            else [f"where least squares goes astray, {advice}"]
        )
    order = far[np.argsort(-np.abs(deviation[far]), kind="stable")]
    names, most = listed([free.names[i] for i in order]), abs(float(deviation[order[0]]))
    left = f"{names} left the stated tolerance, by up to {most:.3g} times"
    return [f"{left}: rows or tolerances are wrong, or the data do not tell; {advice}"]
