# SPDX-License-Identifier: Apache-2.0
"""Calibrate a machine again: keep what the earlier calibration knew, and say whether the machine is
still the same.

Two fits of the new rows and the earlier posterior tell: one that keeps all parameters as they were,
one that says nothing about those in question. If nothing moved, the fall of chi-square from the
first to the second has a chi-square distribution with as many degrees of freedom as directions were
set free and seen: it is the chi-square of the change against its predicted covariance. See
docs/theory/uncertainty.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.inference.posterior import Posterior
from loopcal.estimate.inference.prior import Prior, limb_parameters, prior_from
from loopcal.estimate.inference.residual_test import DOUBT
from loopcal.estimate.methods.penalties import LeastSquares
from loopcal.estimate.result import Identification
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray

MOST = 60
"""Parameters up to which each is tried alone as the explanation of a change."""

EXPLAINED = 0.5
"""Share of the chi-square without a change below which a single parameter explains most of it."""


@dataclass(frozen=True, eq=False)
class Change:
    """Whether parameters moved between two calibrations.

    Attributes
    ----------
    what : a limb, or "the machine". names : the parameters in question.
    change : (k,) new estimate without the earlier one, minus the earlier one [SI].
    chi_square, degrees, p_value : of the change; p_value is NaN where the new rows see none of
        these parameters.
    moved : None where it cannot be said. sentence : what this means.
    """

    what: str
    names: tuple[str, ...]
    change: FloatArray
    chi_square: float
    degrees: float
    p_value: float
    moved: bool | None
    sentence: str

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes by name for JSON, SI."""
        return dict(vars(self))


def recalibrate(
    robot: Mechanism,
    data: Measurements,
    earlier: Posterior,
    free_limb: str | None = None,
    noise: Literal["given", "estimated"] = "given",
) -> tuple[Identification, Change]:
    """Identify a robot from new measurements and an earlier calibration.

    Parameters
    ----------
    robot : its table says what is nominal and tolerated. data : the new measurements.
    earlier : `Identification.posterior`, or that of a run folder.
    free_limb : a limb that was repaired: its parameters get the tolerance of the robot's file about
        nominal again, the others keep what the earlier calibration knew of them.
    noise : see `identify`. The method is least squares: the prior stands in the place of the
        tolerances.

    Returns
    -------
    fit, change : the identification, and whether the limb (or without one, anything) moved since.

    Raises
    ------
    EstimationError
        An unknown limb, other parameters, or an earlier calibration without uncertainty.
    """
    prior = prior_from(earlier)
    _check_names(robot, prior)
    names = prior.names if free_limb is None else limb_parameters(robot, free_limb)
    change = change_since(
        robot, data, prior, names, "the machine" if free_limb is None else free_limb
    )
    fit = identify(
        robot, data, LeastSquares(), noise=noise, prior=_used(robot, prior, free_limb, names)
    )
    return replace(fit, notes=(*fit.notes, change.sentence)), change


def change_since(
    robot: Mechanism, data: Measurements, prior: Prior, names: tuple[str, ...], what: str
) -> Change:
    """Test whether these parameters are still what an earlier calibration found.

    Parameters
    ----------
    robot, data : as for `identify`, noise as stated. prior : the earlier calibration.
    names : the parameters in question. what : their common name in the sentence.
    """
    kept = identify(robot, data, LeastSquares(), prior=prior)
    opened = identify(robot, data, LeastSquares(), prior=prior.without(names))
    of_prior, of_fit = ([table.index(n) for n in names] for table in (prior.names, opened.names))
    change = opened.estimate[of_fit] - prior.mean[of_prior]
    degrees = kept.check.degrees - opened.check.degrees
    gain = max(kept.chi_square - opened.chi_square, 0.0)
    if degrees < 1.0 or not (kept.converged and opened.converged):
        why = "see none of its parameters" if degrees < 1.0 else "led to no converged fit"
        sentence = (
            f"whether {what} moved since the earlier calibration cannot be said: the new rows {why}"
        )
        return Change(what, names, change, gain, degrees, np.nan, None, sentence)
    from scipy.special import chdtrc

    p_value = float(chdtrc(degrees, gain))
    moved = p_value < DOUBT
    sentence = f"the change has chi-square {gain:.4g} where {degrees:.0f} is expected of noise"
    if moved:
        alone = _alone(robot, data, prior, names, kept.chi_square) if len(names) <= MOST else ""
        sentence = f"{what} HAS moved since the earlier calibration: {sentence}{alone}"
    else:
        sentence = (
            f"{what} has not moved beyond the noise since the earlier calibration: {sentence}"
        )
    return Change(what, names, change, gain, degrees, p_value, moved, sentence)


def _alone(
    robot: Mechanism, data: Measurements, prior: Prior, names: tuple[str, ...], kept: float
) -> str:
    """Say which single parameter explains most of the change, if it explains most of it."""
    fits = [identify(robot, data, LeastSquares(), prior=prior.without((name,))) for name in names]
    values = [fit.chi_square if fit.converged else np.inf for fit in fits]
    best = int(np.argmin(values))
    fit, name = fits[best], names[best]
    if not values[best] < EXPLAINED * kept:
        return ", and no single parameter explains it"
    i = fit.names.index(name)
    factor, symbols = fit.unknowns.display()
    by = (fit.estimate[i] - prior.mean[prior.names.index(name)]) / factor[i]
    return f"; a change of {name} alone, by {by:+.3g} {symbols[i]}, explains most of it"


def _used(robot: Mechanism, prior: Prior, limb: str | None, names: tuple[str, ...]) -> Prior:
    """Return the prior of the fit: all of it, or with a freed limb back at its tolerances."""
    if limb is None:
        return prior
    free = select_free_parameters(robot)
    places = [free.names.index(name) for name in names]
    return prior.without(names).toleranced(names, free.nominal[places], free.tolerance[places])


def _check_names(robot: Mechanism, prior: Prior) -> None:
    """Refuse a prior of another robot."""
    free = select_free_parameters(robot).names
    for name in (*prior.names, *free):
        if name not in prior.names or name not in free:
            where = "the earlier run" if name in prior.names else "the robot file"
            raise EstimationError(
                f"{name!r} is free in {where} alone, so the two do not describe the same robot; "
                "free the same parameters in"
                " both"
            )
