# SPDX-License-Identifier: Apache-2.0
"""The result of identifying many machines at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.methods.penalties import Method
from loopcal.estimate.minimization.linear_model import LinearModel
from loopcal.numerics.decomposition import Decomposition
from loopcal.numerics.gauss_newton import DescentStatus
from loopcal.presentation import TableResult
from loopcal.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class IdentifiedTrials(TableResult):
    """t machines identified at once; arrays are (t, ...), SI.

    Attributes
    ----------
    values : (t, p of the robot). status : (t,) DescentStatus. iterations : (t,).
    cost : (t,) whitened sum of squares. free_parameters : names, nominal values and tolerances.
    linear_models : of the last rows of consecutive trials. method : with what `adapt_method`
        entered.
    """

    values: FloatArray
    status: IntArray
    iterations: IntArray
    cost: FloatArray
    free_parameters: FreeParameters
    linear_models: tuple[LinearModel, ...]
    method: Method

    def __repr__(self) -> str:
        """Return the number of trials and how many converged."""
        return (
            f"<IdentifiedTrials of {self.free_parameters.robot.name}: {len(self.values)} trials of "
            f"{len(self.free_parameters)} parameters, {int(self.converged.sum())} converged>"
        )

    @cached_property
    def decomposition(self) -> Decomposition:
        """The decompositions of the rows: variances and leverages are read from them."""
        decompositions = [model.decomposition for model in self.linear_models]
        if any(part.dual is not None for part in decompositions):
            decompositions = [part.with_dual() for part in decompositions]
        return Decomposition.join(decompositions)

    @cached_property
    def penalty(self) -> FloatArray:
        """(t, p free) of the directions of the decompositions."""
        return np.concatenate([model.penalty for model in self.linear_models])

    @cached_property
    def prior_variance(self) -> FloatArray | None:
        """(t, p free) see `Method.prior_variance`."""
        return self.method.prior_variance(self.decomposition, self.penalty, self.free_parameters)

    @property
    def converged(self) -> BoolArray:
        """(t,) which trials converged."""
        return self.status == DescentStatus.CONVERGED

    def standard_deviations(self, noise_variance: FloatArray | float = 1.0) -> FloatArray:
        """Return standard deviations (t, p free) [SI]; infinite where the data do not determine a
        parameter. They do not contain the uncertainty of factors on the tolerances.
        """
        scaled = self.decomposition.standard_deviations(
            self.penalty, noise_variance, self.prior_variance
        )
        return scaled * self.free_parameters.tolerance
