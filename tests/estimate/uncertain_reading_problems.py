# SPDX-License-Identifier: Apache-2.0
"""Robots and dense reference solutions for uncertain readings: every pose and reading is an
explicit unknown of scipy.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import simulate
from loopcal.mechanism.assembly import LinearMap
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.gough import Gough
from loopcal.mechanism.families.placement import PoseRecord as HomePose
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.parameters import ParameterTable
from tests import zoo
from tests.estimate.problems import UM, hexapod_poses, noise, with_tolerance

DIFFERENCE_STEP = 1e-2
"""Of the differences, in spreads and sigmas: what is left of third order is 1e-4 of what
closure's curvature does.
"""


def build_hexapod_with_seven_legs(sigma: float = 2 * UM) -> Mechanism:
    """Build the hexapod with a seventh driven leg from the middle of its base: 49 parameters."""
    assembly = zoo.hexapod().assembly
    foot, corner = zoo.place((0.01, 0.005, 0.0)), zoo.place((0.02, 0.03, 0.0))
    length = float(np.linalg.norm((assembly.home @ corner)[:3, 3] - foot[:3, 3]))
    last = assembly.limbs[-1]
    first, end = replace(last.links[0], transform=foot), replace(last.attachment, transform=corner)
    leg = replace(last, name="leg7", actuator="q7", length=length, links=(first,), attachment=end)
    more = [p for p in assembly.parameters if p.name.startswith("leg6.")]
    parameters = tuple(replace(p, name=p.name.replace("leg6.", "leg7.")) for p in more)
    maps = tuple(
        replace(
            m,
            parameter=m.parameter.replace("leg6.", "leg7."),
            address=replace(m.address, owner="leg7"),
        )
        for m in assembly.maps
        if isinstance(m, LinearMap) and m.parameter.startswith("leg6.")
    )
    actuators = tuple(
        replace(a, sigma=sigma)
        for a in (*assembly.actuators, replace(assembly.actuators[-1], name="q7"))
    )
    limbs, every = (*assembly.limbs, leg), (*assembly.parameters, *parameters)
    made = replace(
        assembly, limbs=limbs, actuators=actuators, parameters=every, maps=(*assembly.maps, *maps)
    )
    return with_tolerance(build(made), 0.035e-3)


def free_only(robot: Mechanism, names: tuple[str, ...]) -> Mechanism:
    """Return the robot with only these parameters free."""
    entries = tuple(replace(p, free=p.name.endswith(names)) for p in robot.parameters.entries)
    return replace(robot, parameters=ParameterTable(entries))


def build_ups_hexapod() -> Mechanism:
    """Build the hexapod with joints in its legs, for joint sensors."""
    base, platform = (
        tuple(map(tuple, (a * zoo.MM).tolist())) for a in (zoo.HEXAPOD_BASE, zoo.HEXAPOD_PLATFORM)
    )
    record = Gough(
        name="ups",
        base=base,
        platform=platform,
        lengths=zoo.HEXAPOD_LENGTH * zoo.MM,
        home=HomePose(z=0.2),
        legs="ups",
    )
    return with_tolerance(build(record.expand(), record=record), 0.035e-3)


def simulate_hexapod(
    n: int, sigma: ArrayLike | None, seed: int = 0, sensors: tuple[Sensor, ...] = ()
) -> Measurements:
    """Simulate the true hexapod at n poses with noisy readings, by a tracker or `sensors`."""
    truth = zoo.hexapod().with_values(zoo.hexapod_truth())
    tracker = (Sensor(Pose(), noise(*[5e-6] * 3, *[UM] * 3)),)
    return simulate(
        truth, hexapod_poses(n, seed), Instrument(sensors or tracker), seed, reading_sigma=sigma
    )


def solve_dense(
    robot: Mechanism, data: Measurements, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate and covariance [SI] of the free parameters, every true reading an unknown beside
    them (as many actuators as freedoms); poses by forward kinematics, derivatives by differences,
    covariance by the whole problem's.
    """
    free = np.flatnonzero(robot.parameters.free)
    unit = robot.parameters.tolerance[free]
    start = np.where(np.isnan(data.readings), np.nanmean(data.readings, axis=0), data.readings)
    scale = np.where(np.isfinite(sigma), sigma, 1e-4)
    moving = scale > 0.0
    p = len(free)

    seen = np.isfinite(sigma) & moving

    def rows(x):  # (t, p + readings) -> (t, rows)
        values = np.tile(robot.values, (len(x), 1))
        values[:, free] = robot.parameters.nominal[free] + unit * x[:, :p]
        q = np.tile(start, (len(x), 1, 1))
        q[:, moving] += scale[moving] * x[:, p:]
        T = forward_trials(robot, values, q).T
        parts = [
            (o.whitener @ o.evaluate(T).residual[..., None]).reshape(len(x), -1)
            for o in data.observations
        ]
        return np.concatenate([*parts, (q - data.readings)[:, seen] / sigma[seen]], axis=1)

    def jacobian(x):
        moved = np.concatenate(
            [x + DIFFERENCE_STEP * np.eye(len(x)), x - DIFFERENCE_STEP * np.eye(len(x))]
        )
        plus, minus = np.split(rows(moved), 2)
        return ((plus - minus) / (2 * DIFFERENCE_STEP)).T

    x = np.zeros(p + int(moving.sum()))
    fit = least_squares(
        lambda x: rows(x[None])[0],
        x,
        jac=jacobian,  # type: ignore[arg-type]
        method="lm",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    _, R = np.linalg.qr(fit.jac)
    inverse = np.linalg.inv(R)
    covariance = (inverse @ inverse.T)[:p, :p] * unit[:, None] * unit
    return robot.parameters.nominal[free] + unit * fit.x[:p], covariance
