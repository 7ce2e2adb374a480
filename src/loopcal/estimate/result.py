# SPDX-License-Identifier: Apache-2.0
"""The result of an identification: the corrected robot, how sure each number is, and how well the
data were explained.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from loopcal.estimate.descent import DescentStatus
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.null_space import Combination
from loopcal.estimate.inference.posterior import Posterior
from loopcal.estimate.inference.residual_test import LEVEL, ResidualTest, coverage_factor
from loopcal.estimate.methods.penalties import Method
from loopcal.estimate.methods.prior_conflict import PriorConflict
from loopcal.estimate.nuisance_estimate import NuisanceEstimate
from loopcal.estimate.poses.estimate import EstimatedPoses
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class KindResiduals:
    """Residuals (predicted - measured) of one kind's rows after the fit.

    Attributes
    ----------
    kind : its name. components : names of the m residuals. poses : (r,) labels.
    raw : (r, m) [SI]. whitened : (r, m), divided by sigma (zero where absent).
    context : name -> (r,), time [s] and temperatures [degC] of the rows, to plot the residuals
        against.
    """

    kind: str
    components: tuple[str, ...]
    poses: tuple[str, ...]
    raw: FloatArray
    whitened: FloatArray
    context: Mapping[str, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Identification:
    """A robot identified from measurements. Arrays over parameters are (p,) in the order of
    `names`, SI.

    Attributes
    ----------
    robot : Mechanism at the estimated values. initial : the same robot as it was given, to compare
        with.
    method, unknowns : how it was estimated, and the free parameters with their units.
    estimate : (p,). covariance : (p, p), infinite and NaN where the data cannot tell.
    posterior : the same knowledge by directions, from which the accuracy of poses and a later prior
    are made.
    rank, condition, singular_values, rank_tolerance : of the whitened, tolerance-scaled matrix.
    unidentifiable : combinations that change nothing that was measured.
    check : the residual against its degrees of freedom.
    conflict : the stated tolerances against the data, where the method uses them; else None.
    residuals : of every kind. status : how the iteration ended. iterations : steps taken.
    cost_history : (i + 1,) whitened sum of squares; with a loss, the first and those after the last
        change of weights are at the final weights, those between at the weights of their time.
        estimate_history : (i + 1, p).
    notes : sentences that belong to the result.
    weight : (n,) of each pose by the loss, 1 without one. dropped : labels of the poses that were
        left out as asked.
    local : what was found of the unknowns that the measurements bring with them: frames, targets,
        surfaces.
    latent : where the machine stood and what its readings were, where these are not exact; else
        None.
    """

    robot: Mechanism
    initial: Mechanism
    method: Method
    unknowns: FreeParameters
    estimate: FloatArray
    covariance: FloatArray
    posterior: Posterior
    rank: int
    condition: float
    singular_values: FloatArray
    rank_tolerance: float
    unidentifiable: tuple[Combination, ...]
    check: ResidualTest
    conflict: PriorConflict | None
    residuals: tuple[KindResiduals, ...]
    status: DescentStatus
    iterations: int
    cost_history: FloatArray
    estimate_history: FloatArray
    notes: tuple[str, ...]
    weight: FloatArray
    dropped: tuple[str, ...]
    local: NuisanceEstimate
    latent: EstimatedPoses | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return self.unknowns.names

    @property
    def nominal(self) -> FloatArray:
        """(p,) nominal values."""
        return self.unknowns.nominal

    @property
    def tolerance(self) -> FloatArray:
        """(p,) tolerances used, stated or assumed."""
        return self.unknowns.tolerance

    @property
    def converged(self) -> bool:
        """Whether the iteration converged."""
        return self.status is DescentStatus.CONVERGED

    @cached_property
    def sd(self) -> FloatArray:
        """(p,) standard deviations: infinite where the data cannot tell, NaN where no interval can
        be given.
        """
        return np.sqrt(np.diag(self.covariance))

    def interval(self, level: float = LEVEL) -> FloatArray:
        """Return half-widths (p,) of intervals of this coverage."""
        return coverage_factor(self.check, level) * self.sd

    @property
    def plus_minus(self) -> FloatArray:
        """Half-widths of 95 % intervals over ALL parameters of the robot, NaN for fixed ones: for
        `save_robot`.
        """
        result = np.full(len(self.robot.parameters), np.nan)
        result[self.unknowns.places] = self.interval()
        return result

    @property
    def dof(self) -> float:
        """Equations minus parameters effectively used."""
        return self.check.dof

    @property
    def chi_square(self) -> float:
        """Whitened sum of squares, see `ResidualTest`."""
        return self.check.chi_square

    @property
    def p_value(self) -> float:
        """Probability of a larger chi-square."""
        return self.check.p_value

    @property
    def noise(self) -> str:
        """`given` or `estimated`."""
        return self.check.noise

    def __str__(self) -> str:
        factor, symbols = self.unknowns.display()
        half = self.interval()
        width = max(len(name) for name in (*self.names, *self.local.names))
        lines = [f"{'parameter':<{width}} {'nominal':>14} {'estimate':>14} {'+/- (95 %)':>12} unit"]
        for i, name in enumerate(self.names):
            decimals, shown = _uncertainty(half[i] / factor[i])
            nominal, estimate = self.nominal[i] / factor[i], self.estimate[i] / factor[i]
            lines.append(
                f"{name:<{width}} {nominal:>14.{decimals}f} {estimate:>14.{decimals}f} {shown:>12} "
                f"{symbols[i]}"
            )
        for entry in self.local.rows(coverage_factor(self.check)):
            decimals, shown = _uncertainty(entry["plus_minus"]) if entry["free"] else (6, "fixed")
            nominal, estimate = (
                f"{entry[name]:>14.{decimals}f}" for name in ("nominal", "estimate")
            )
            lines.append(
                f"{entry['name']:<{width}} {nominal} {estimate} {shown:>12} {entry['unit']}"
            )
        lines += [
            "",
            (
                f"{self.status.sentence} after {self.iterations} steps; rank {self.rank} of "
                f"{len(self.names)}"
            ),
        ]
        lines += [
            f"chi-square {self.chi_square:.5g} with {self.check.degrees:.4g} degrees of freedom"
        ]
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])

    def to_dict(self) -> dict[str, Any]:
        """Return the result by attribute name for JSON; parameters in SI and in the units of the
        robot's file.
        """
        factor, symbols = self.unknowns.display()
        half = self.interval()
        parameters = [
            {
                "name": parameter.name,
                "unit": symbols[i],
                "nominal": self.nominal[i] / factor[i],
                "estimate": self.estimate[i] / factor[i],
                "sd": self.sd[i] / factor[i],
                "plus_minus": half[i] / factor[i],
                "tolerance": self.tolerance[i] / factor[i],
                "tolerance_assumed": bool(self.unknowns.assumed[i]),
            }
            for i, parameter in enumerate(self.unknowns.parameters)
        ]
        return {
            "robot": self.robot.name,
            "method": repr(self.method),
            "parameters": parameters,
            "local": self.local.rows(coverage_factor(self.check)),
            "rank": self.rank,
            "condition": self.condition,
            "singular_values": self.singular_values,
            "rank_tolerance": self.rank_tolerance,
            "unidentifiable": [c.to_dict() for c in self.unidentifiable],
            "dof": self.dof,
            "chi_square": self.chi_square,
            "degrees": self.check.degrees,
            "p_value": self.p_value,
            "noise": self.noise,
            "sigma_scale": self.check.sigma_scale,
            "prior_conflict": None if self.conflict is None else self.conflict.to_dict(),
            "dropped": list(self.dropped),
            "readings": None if self.latent is None else self.latent.to_dict(),
            "status": self.status.name.lower(),
            "iterations": self.iterations,
            "cost_history": self.cost_history,
            "notes": list(self.notes),
        }

    def arrays(self) -> dict[str, FloatArray]:
        """Return the arrays of the result by name [SI], for the run folder."""
        result = {
            "nominal": self.nominal,
            "estimate": self.estimate,
            "sd": self.sd,
            "covariance": self.covariance,
            "singular_values": self.singular_values,
            "estimate_history": self.estimate_history,
            "cost_history": self.cost_history,
            "weight": self.weight,
            "local_estimate": self.local.estimate,
            "local_sd": self.local.sd,
            "local_start": self.local.start,
            **self.posterior.arrays(),
            **({} if self.latent is None else self.latent.arrays()),
        }
        for i, r in enumerate(self.residuals):
            result[f"residual_{i}_{r.kind}"] = r.raw
            result[f"whitened_{i}_{r.kind}"] = r.whitened
            result |= {f"{name}_{i}_{r.kind}": values for name, values in r.context.items()}
        return result


def _uncertainty(half: float) -> tuple[int, str]:
    """Decimals that an uncertainty leaves, and the uncertainty to two digits in words or figures."""
    if np.isnan(half):
        return 6, "not given"
    if np.isinf(half):
        return 6, "unknown"
    if half == 0.0:
        return 6, "0"
    decimals = int(np.clip(1 - np.floor(np.log10(half)), 0, 12))
    return decimals, f"{half:.{decimals}f}"
