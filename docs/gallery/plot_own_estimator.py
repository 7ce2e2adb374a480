# SPDX-License-Identifier: Apache-2.0
"""
My own loss, my own rule, my own estimator
==========================================

Researchers want to compare their method with others on the same robot and data. There are three
ways, from little to much of your own: a loss for outliers, a rule that chooses the regularization,
or a complete estimator with scipy, for which loopcal supplies poses and derivatives.
"""

# %%
# The data: a five-bar robot, 40 measured positions, and three of them wrong by 0.3 mm.

# sphinx_gallery_thumbnail_path = "docs/pictures/thumbnails/own_estimator.png"
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

import loopcal as lc

robot = lc.load_robot("five-bar")
truth = lc.sample_truth(robot, 1, seed=5)[0]
noise = lc.Gaussian(np.full(2, 20e-6))
camera = lc.Instrument((lc.Sensor(lc.Component(("x", "y")), noise),))
poses = lc.sample_workspace(robot, 40, seed=1).coordinates
clean = lc.simulate(robot.with_values(truth), poses, camera, seed=2)
(rows,) = clean.observations
wrong = rows.measured.copy()
wrong[[4, 17, 30]] += 0.3e-3
data = replace(clean, observations=(replace(rows, measured=wrong),))


def describe(name, fit):
    """Print how far a fit is from the truth, in standard deviations of a fit to clean data."""
    errors = (fit.estimate - truth) / reference.standard_deviations
    print(f"{name:<22} rms error {np.sqrt(np.mean(errors**2)):5.2f} sd")


reference = lc.identify(robot, clean)
describe("clean data", reference)
describe("no loss", lc.identify(robot, data))
describe("Huber's loss", lc.identify(robot, data, loss=lc.Huber()))
describe("Tukey's loss", lc.identify(robot, data, loss=lc.Tukey()))

# %%
# **Your own loss** is a class with a function ``weight``. It gets the distance of each pose from
# the fit, in standard deviations, and how many numbers were measured there. This is Cauchy's
# loss.


class Cauchy:
    """Weight 1 / (1 + (d / 2.4)^2)."""

    def weight(self, distance, degrees):
        """Return the weight of each pose."""
        return 1.0 / (1.0 + (distance / 2.4) ** 2 / degrees)


robust = lc.identify(robot, data, loss=Cauchy())
describe("my loss", robust)
robust.plot.residuals()

# %%
# **Your own rule** chooses how strongly ridge regression pulls to the drawing. It gets a singular
# value decomposition of all rows. This is Morozov's: as much as the noise allows.


def morozov(decomposition):
    """Return the largest lam whose residuals do not exceed the noise, for each of t fits."""
    s, c = decomposition.singular_values, decomposition.projections
    lams = np.logspace(-6, 4, 200)[:, None, None]
    squares = decomposition.outside + ((lams * c / (s**2 + lams)) ** 2).sum(axis=-1)
    is_fine = squares <= decomposition.rows
    return np.where(is_fine, lams[..., 0], lams.min()).max(axis=0)


ridge = lc.identify(robot, clean, lc.Ridge(morozov))
describe("my rule, clean data", ridge)
print(ridge.regularization)

# %%
# **Your own estimator.** ``lc.forward`` and ``lc.jacobian`` are all that an optimizer needs. This
# one minimizes absolute values, nearly. Without a loss, it agrees with loopcal's least squares.
# Neither knows the expected spreads, so both are further from the truth than the fits above.

sigma = 20e-6


def residual(values, measured):
    """Return predicted minus measured positions over sigma, for these parameter values."""
    solution = lc.forward(robot.with_values(values), data.readings)
    return ((solution.T[:, :2, 3] - measured) / sigma).ravel()


def derivative(values, measured):
    """Return the derivatives: rows x and y of the twist of the platform."""
    twist = lc.jacobian(robot.with_values(values), data.readings).parameters
    return (twist[:, 3:5] / sigma).reshape(-1, len(values))


settings = {"x_scale": robot.parameters.tolerance, "xtol": 1e-12, "ftol": 1e-12}
tries = {"linear": rows.measured, "soft_l1": wrong}
for loss, measured in tries.items():
    result = least_squares(
        residual, robot.values, derivative, loss=loss, args=(measured,), **settings
    )
    errors = (result.x - truth) / reference.standard_deviations
    print(f"scipy, loss {loss}: rms error {np.sqrt(np.mean(errors**2)):.2f} sd")
    if loss == "linear":
        own = lc.identify(robot, clean, lc.LeastSquares())
        print(f"  largest difference from loopcal: {np.abs(result.x - own.estimate).max():.1e}")
