# SPDX-License-Identifier: Apache-2.0
"""The cases: robots with their instruments, and the assumptions that are broken one by one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SMOOTH_ERROR = 15e-6
"""Root mean square [m] of each coordinate of the smooth model error."""

NOISE = ("noise.residuals-too-large", "noise.doubtful")
PRIOR = ("prior.tolerances", "prior.components")
TAILS = "residuals.heavy-tailed"
OUTLIERS = ("outliers.some", "outliers.pose", "outliers.conflict", "outliers.ambiguous")
TIME = (
    "residuals.drift", "residuals.trend", "residuals.sessions", "residuals.correlated",
    "residuals.shared",
)  # fmt: skip
POSE = ("residuals.model-discrepancy", "residuals.depend-on-reading")
"""Beginnings of the codes of the findings that explain a case: they name what is wrong."""


@dataclass(frozen=True)
class Setup:
    """A robot and its measurement.

    Attributes
    ----------
    columns : what is measured: coordinates, or nothing for full poses.
    poses : measured. few : poses that leave 6 degrees of freedom.
    sigma : (length [m], angle [rad]) of the instrument. coarse : the same of an instrument with
        which the spreads matter.
    group : end of the names of the parameters that a batch shifts together.
    """

    robot: str
    columns: tuple[str, ...]
    poses: int
    few: int
    sigma: tuple[float, float]
    coarse: tuple[float, float]
    group: str


SETUPS = {
    "linear-delta": Setup(
        "linear-delta", ("x", "y", "z"), 30, 5, (1e-5, 0.0), (5e-5, 0.0), ".length"
    ),
    "five-bar": Setup("five-bar", ("x", "y"), 30, 8, (5e-6, 0.0), (3e-5, 0.0), ".length"),
    "hexapod-42": Setup("hexapod-42", (), 25, 8, (1e-5, 5e-5), (5e-5, 2.5e-4), ".length"),
}


@dataclass(frozen=True)
class Case:
    """One broken assumption. The defaults break none.

    Attributes
    ----------
    explaining : beginnings of the codes of the findings that explain the case.
    noise : standard deviation of the noise, in stated sigmas. correlation : of the noise of a pose
        with that of the pose before. degrees : of Student's t; infinite for normal noise.
    outliers : share of the poses that are 20 sigma off. drift, jump : displacement of the
        instrument from the first to the last pose, or from the first session to the second, in
        sigma. smooth : model error over the workspace [m].
    tolerance : true errors over stated spreads. single, group : deviation of one parameter, or
        of the parameters of a batch, in spreads.
    is_coarse : whether the instrument is the coarse one. is_few : whether the poses leave 6 degrees
        of freedom. estimated : whether the noise is estimated. least_squares : the method.
    """

    name: str
    explaining: tuple[str, ...] = ()
    noise: float = 1.0
    correlation: float = 0.0
    degrees: float = np.inf
    outliers: float = 0.0
    drift: float = 0.0
    jump: float = 0.0
    smooth: float = 0.0
    tolerance: float = 1.0
    single: float = 0.0
    group: float = 0.0
    is_coarse: bool = False
    is_few: bool = False
    estimated: bool = False
    least_squares: bool = False

    @property
    def is_clean(self) -> bool:
        """Whether every assumption holds, with many degrees of freedom."""
        return not self.explaining and not self.is_few


def list_cases() -> tuple[Case, ...]:
    """Return all cases."""
    few = (
        Case("6 degrees of freedom", is_few=True),
        Case("6 degrees of freedom, noise estimated", is_few=True, estimated=True),
        Case(
            "6 degrees of freedom, noise estimated, least squares",
            is_few=True,
            estimated=True,
            least_squares=True,
        ),
    )
    return (
        Case("clean"),
        Case("clean, least squares", least_squares=True),
        Case("clean, coarse instrument", is_coarse=True),
        *few,
        Case("drift of 5 sigma", TIME, drift=5.0),
        Case("jump of 4 sigma between two sessions", TIME, jump=4.0),
        Case("AR(1) noise, 0.6", TIME, correlation=0.6),
        Case("AR(1) noise, 0.9", TIME, correlation=0.9),
        *(Case(f"noise {k} times sigma", NOISE, noise=k) for k in (1.15, 1.3, 2.0)),
        *(
            Case(f"errors {k} times the spreads", PRIOR, tolerance=k, is_coarse=True)
            for k in (1.2, 1.4, 1.7, 3.0)
        ),
        *(
            Case(f"one parameter {k} spreads off", PRIOR, single=k, is_coarse=True)
            for k in (5.0, 10.0, 20.0)
        ),
        *(Case(f"a batch {k} spreads off", PRIOR, group=k, is_coarse=True) for k in (4.0, 6.0)),
        Case("5 % of the poses 20 sigma off", (*OUTLIERS, *NOISE), outliers=0.05),
        Case("noise of Student's t, 3 degrees", (*OUTLIERS, *NOISE, TAILS), degrees=3.0),
        Case("smooth model error of 15 um", POSE, smooth=SMOOTH_ERROR),
    )
