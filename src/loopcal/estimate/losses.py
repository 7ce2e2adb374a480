# SPDX-License-Identifier: Apache-2.0
"""Losses reduce the weight of observation blocks that lie far from the fit.

For a block of m whitened residuals, d^2 = |W r|^2 has a chi-square distribution with m degrees of
freedom if the block belongs to the model. A loss is the weight w(d) of its squares in iteratively
reweighted least squares. Its constant is stated for a single residual and carried over to blocks of
m by equal probability: P(|N(0, 1)| > k) = P(chi2_m > limit^2). Huber, Robust Statistics (1981); the
usual constants give 95 % efficiency for a single normal residual.

A new loss is one more class here and its line in `LOSSES`: a frozen dataclass whose fields are its
settings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeVar

import numpy as np

from loopcal.errors import DataError, EstimationError
from loopcal.numerics.statistics import compute_chi_square_quantile, normal_probability
from loopcal.registry import Registry
from loopcal.typing import FloatArray

L = TypeVar("L")

LARGEST = 8.0
"""Largest constant [standard deviations]; the probability of more is below double precision."""


class Loss(Protocol):
    """The interface of a loss.

    A loss whose weight falls faster than 1 / distance has several minima. It states
    `is_redescending = True`, and its fit starts from that with Huber's loss.
    """

    def weight(self, distance: FloatArray, degrees: FloatArray) -> FloatArray:
        """Return the weight (u,) of blocks at distance d (u,) with this many residuals (u,)."""
        ...


LOSSES: Registry[type[Loss]] = Registry(
    "loss", "loopcal.losses", {"huber": f"{__name__}:Huber", "tukey": f"{__name__}:Tukey"}
)
"""Name of a loss on the command line, in study files and in results -> its class."""


def register_loss(loss: type[L]) -> type[L]:
    """Add a loss: a frozen dataclass with a `name` and the function `weight`; also a decorator.

    See docs/extending.md.

    Raises
    ------
    DataError : there is no function `weight` or no name, or the name is one of loopcal.
    """
    if not callable(getattr(loss, "weight", None)):
        raise DataError(f"{loss!r} lacks the function 'weight(distance, degrees)' of a loss")
    return LOSSES.register(loss)


@dataclass(frozen=True)
class Huber:
    """Weight 1 up to the limit and limit / d beyond it.

    Blocks far from the fit pull with a constant force; the minimum is unique for linear rows.

    Parameters
    ----------
    k : limit for a single residual, in standard deviations.

    Raises
    ------
    EstimationError : k is not above 0, or too large.
    """

    name: ClassVar[str] = "huber"
    k: float = 1.345

    def __post_init__(self) -> None:
        _check_constant("Huber", self.k)

    def weight(self, distance: FloatArray, degrees: FloatArray) -> FloatArray:
        """Return min(1, limit / d)."""
        limit = block_limit(self.k, degrees)
        return np.where(distance > limit, limit / np.maximum(distance, limit), 1.0)


@dataclass(frozen=True)
class Tukey:
    """Weight (1 - (d / limit)^2)^2 below the limit and 0 beyond it.

    Blocks far from the fit do not count at all. The fit starts from that with Huber's loss.

    Parameters
    ----------
    c : limit for a single residual, in standard deviations.

    Raises
    ------
    EstimationError : c is not above 0, or too large.
    """

    name: ClassVar[str] = "tukey"
    is_redescending: ClassVar[bool] = True
    c: float = 4.685

    def __post_init__(self) -> None:
        _check_constant("Tukey", self.c)

    def weight(self, distance: FloatArray, degrees: FloatArray) -> FloatArray:
        """Return (1 - (d / limit)^2)^2, or 0 beyond the limit."""
        share = np.minimum(distance / block_limit(self.c, degrees), 1.0)
        return (1.0 - share**2) ** 2


def weigh_blocks(loss: Loss, distance: FloatArray, degrees: FloatArray) -> FloatArray:
    """Return the weights (u,) that a loss gives to blocks; a user may have written it.

    EstimationError : not one finite weight of at least 0 for each block.
    """
    weight = np.asarray(loss.weight(distance, degrees), dtype=np.float64)
    if weight.shape != distance.shape:
        raise EstimationError(
            f"the loss {describe_loss(loss)} returned weights of shape {weight.shape} for "
            f"{len(distance)} blocks; its function weight must return one number for each block"
        )
    wrong = np.flatnonzero(~(np.isfinite(weight) & (weight >= 0.0)))
    if len(wrong):
        raise EstimationError(
            f"the loss {describe_loss(loss)} returned the weight {weight[wrong[0]]:.3g} at the "
            f"distance {distance[wrong[0]]:.3g}; weights must be finite and not negative"
        )
    return weight


def describe_loss(loss: Loss) -> str:
    """Return the name of a loss: its own `repr`, or that of a class that defines none."""
    has_own = type(loss).__repr__ is not object.__repr__
    return repr(loss) if has_own else type(loss).__name__


def block_limit(single: float, degrees: FloatArray) -> FloatArray:
    """Return the limit (u,) of the norm of a block of `degrees` (u,) residuals with the exceedance
    probability of `single`, the limit of one normal residual, in standard deviations.
    """
    exceedance = 2.0 * float(normal_probability(-single))
    # a quantile takes 30 us or more, and most blocks have the same number of residuals
    sizes, which = np.unique(np.maximum(degrees, 1.0), return_inverse=True)
    return np.sqrt(compute_chi_square_quantile(sizes, exceedance))[which]


def _check_constant(name: str, constant: float) -> None:
    """Refuse a constant outside (0, LARGEST]."""
    if not 0.0 < constant <= LARGEST:
        raise EstimationError(
            f"{name} loss with constant {constant}: give a number of standard deviations above 0 "
            f"and up to {LARGEST:g}"
        )
