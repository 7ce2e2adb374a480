# SPDX-License-Identifier: Apache-2.0
"""Probabilities and quantiles of the normal, chi-square, F, t and beta distributions.

They are the functions of `scipy.special`, which is imported when one of them is called: its import
takes twice as long as that of numpy, and `import loopcal` does not pay for it.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

import numpy as np
from numpy.typing import ArrayLike

from loopcal.typing import FloatArray

Distribution = Callable[..., FloatArray]


def _distribution(name: str) -> Distribution:
    """Return a function of `scipy.special`, whose arguments broadcast."""

    def evaluate(*arguments: ArrayLike) -> FloatArray:
        return np.asarray(getattr(import_module("scipy.special"), name)(*arguments), dtype=float)

    return evaluate


normal_probability: Distribution = _distribution("ndtr")
"""Probability of at most x."""

normal_quantile: Distribution = _distribution("ndtri")
"""Value that is not exceeded with a probability."""

chi_square_tail: Distribution = _distribution("chdtrc")
"""Probability of more than x with k degrees of freedom."""

chi_square_quantile: Distribution = _distribution("chdtri")
"""Value that k degrees of freedom exceed with a probability."""

f_tail: Distribution = _distribution("fdtrc")
"""Probability of more than x with k and `left` degrees of freedom."""

f_quantile: Distribution = _distribution("fdtri")
"""Value that is not exceeded with a probability."""

student_probability: Distribution = _distribution("stdtr")
"""Probability of at most t with some degrees of freedom."""

student_quantile: Distribution = _distribution("stdtrit")
"""Value of t that is not exceeded with a probability."""

beta_probability: Distribution = _distribution("betainc")
"""Probability of at most x, of the parameters a and b."""

binomial_tail: Distribution = _distribution("bdtrc")
"""Probability of more than k of n trials."""
