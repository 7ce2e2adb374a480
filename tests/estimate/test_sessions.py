# SPDX-License-Identifier: Apache-2.0
"""Frames and offsets of sessions: drift, moved stations, priors, probes and tools; a wrong fixed
value is detected.

A single wrong frame leaves no trace if the robot's own frame is free. Each case here has data that
contradict it.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.testing import assert_allclose

import loopcal as lc
from loopcal import geometry
from loopcal.estimate import fit_analysis
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import LeastSquares
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds import setup_parameters
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Bearing, Position
from loopcal.measure.kinds.surfaces import Plane
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import collect_nuisance_parameters
from loopcal.measure.simulation import simulate
from loopcal.mechanism.workspace import sample_workspace
from tests import zoo
from tests.estimate.problems import hexapod, hexapod_poses

UM, URAD = 1e-6, 1e-6
SIGMA = 5 * UM
POINT = np.array([[0.03, -0.02, 0.05]])
REJECTED_P_VALUE, ACCEPTED_P_VALUE = 1e-6, 1e-3
"""p-values of a fit that is wrong, and of one that is right: one seed in a thousand would fail."""


def make_sensor(kind, **labels):
    sigma = [
        SIGMA if column.dimension.value == "length" else 5 * URAD for column in kind.noise_columns
    ]
    return Sensor(kind, Gaussian(np.array(sigma)), **labels)


def simulate_measurements(poses, *sensors, true):
    """Simulate measurements of the true hexapod."""
    return simulate(
        zoo.hexapod().with_values(zoo.hexapod_truth()),
        poses,
        Instrument(sensors),
        1,
        nuisance_values=true,
    )


def fix_setup(data: Measurements, pattern: str, values: Mapping[str, float] | None = None):
    """Return the setup parameters of the data, those of the pattern fixed at these values."""
    local = collect_nuisance_parameters(data.observations, data.labels)
    return local.with_nominal(local.values(values)).with_fixed(pattern)


def assert_explained(fit, true: Mapping[str, float]):
    """Assert that a fit explains the data, with these setup parameters within 5 sd."""
    assert fit.converged
    assert fit.residual_test.p_value > ACCEPTED_P_VALUE
    for name, value in true.items():
        i = fit.nuisance.names.index(name)
        assert np.isfinite(fit.nuisance.sd[i])
        assert abs(fit.nuisance.estimate[i] - value) < 5 * fit.nuisance.sd[i], name


def assert_contradicted(fit):
    """Assert that the residuals reject what was stated with exact sigmas."""
    assert fit.residual_test.exact_p_value < REJECTED_P_VALUE
    assert fit.residual_test.finding in fit.findings
    assert not fit.residual_test.intervals or fit.residual_test.sigma_scale > 1.0


def test_drift_of_the_base_is_estimated_for_every_session():
    day = np.repeat(["morning", "noon", "evening"], 20)
    poses, kind = hexapod_poses(60), Pose(unknown=("frame",))
    drift = {"noon.frame.x": 40 * UM, "evening.frame.x": 90 * UM, "evening.frame.ry": 100 * URAD}
    data = simulate_measurements(poses, make_sensor(kind, session=day), true=drift)
    # the first session says where the base is, the others how far it has drifted since
    first = {"morning.frame.x": 0.0, "morning.frame.ry": 0.0}
    fit = identify(
        hexapod(),
        data,
        LeastSquares(),
        options=FitOptions(nuisance=fix_setup(data, "morning.*", first)),
    )
    assert fit.rank == 42
    assert_explained(fit, drift)
    free = identify(hexapod(), data, LeastSquares())
    assert free.rank == 36
    frames = [
        setup_parameters.place_frame(
            np.eye(4),
            np.array(
                [
                    free.nuisance.values[f"{s}.frame.{a}"]
                    for a in setup_parameters.ROTATION_AXES + setup_parameters.POSITION_AXES
                ]
            ),
        )
        for s in ("morning", "evening")
    ]
    # the gauge moves all frames alike: what lies between two of them is known; [rad, m] at 5 um in
    # 20 poses, five times over
    moved = geometry.log_so3(frames[1][:3, :3] @ frames[0][:3, :3].T)
    assert_allclose(moved, [0.0, 100 * URAD, 0.0], atol=5 * 20 * URAD)
    assert_contradicted(
        identify(hexapod(), data, LeastSquares(), options=FitOptions(nuisance=fix_setup(data, "*")))
    )


def test_moved_station_needs_a_frame_for_each_session():
    day = np.repeat(["left", "right"], 50)
    station = geometry.make_pose(np.eye(3), np.array([-1.5, -0.8, 0.1]))
    theodolite = Bearing(places=POINT, T_base_frame=station, unknown=("frame",))
    poses = np.concatenate([hexapod_poses(50), hexapod_poses(50, 3)])
    moved = {"right.frame.x": 1.4, "right.frame.y": -1.1, "right.frame.rz": 2.0}
    known = Position(places=POINT)
    data = simulate_measurements(
        poses, make_sensor(theodolite, session=day), make_sensor(known), true=moved
    )
    fit = identify(hexapod(), data, LeastSquares())
    assert fit.rank == 39
    assert_explained(fit, moved | {"left.frame.x": -1.5})
    one = tuple(replace(o, session=np.full(len(o), "")) for o in data.observations)
    assert_contradicted(identify(hexapod(), replace(data, observations=one), LeastSquares()))


@cache
def simulate_delta():
    """Simulate a delta and a tracker; a delta has no base frame that could absorb a wrong one."""
    robot = lc.load_robot("linear-delta")
    truth = robot.with_values(
        robot.values
        + np.where(robot.parameters.free, 0.5, 0.0) * np.nan_to_num(robot.parameters.tolerance)
    )
    data = simulate(
        truth, sample_workspace(robot, 40, 5).coordinates, Instrument((make_sensor(Position(places=POINT, unknown=("frame",))),)), 1,  # noqa: E501
        nuisance_values={"frame.x": 60 * UM},
    )  # fmt: skip
    return robot, truth, data


def test_prior_on_a_frame_is_between_a_free_and_a_fixed_frame():
    robot, truth, data = simulate_delta()
    local = collect_nuisance_parameters(data.observations, data.labels)
    free, held, known = (
        identify(
            robot, data, LeastSquares(), options=FitOptions(nuisance=one, sigma_uncertainty=0.0)
        )
        for one in (
            local,
            local.with_prior("frame.*", 50 * UM),
            fix_setup(data, "*", {"frame.x": 60 * UM}),
        )
    )
    assert_explained(held, {"frame.x": 60 * UM})
    assert np.isinf(free.standard_deviations).any()
    assert np.isfinite(held.standard_deviations).all()
    assert (known.standard_deviations <= held.standard_deviations * (1 + 1e-9)).all()
    off = np.abs(held.estimate - truth.values[held.free_parameters.places])
    assert (off < 5 * held.standard_deviations).all()
    # 60 um are thirty standard deviations of this one: a prior is a row like others, and its
    # residual counts
    assert_contradicted(
        identify(
            robot,
            data,
            LeastSquares(),
            options=FitOptions(nuisance=local.with_prior("frame.*", 2 * UM)),
        )
    )


def test_wrong_fixed_frame_of_a_delta_is_detected():
    robot, _, data = simulate_delta()
    assert_explained(
        identify(
            robot,
            data,
            LeastSquares(),
            options=FitOptions(nuisance=fix_setup(data, "*", {"frame.x": 60 * UM})),
        ),
        {},
    )
    assert_contradicted(
        identify(robot, data, LeastSquares(), options=FitOptions(nuisance=fix_setup(data, "*")))
    )


def test_probe_offset_is_estimated_on_planes_and_a_wrong_one_is_detected():
    probe = Plane(
        unknown=("surface", "targets"), targets=("probe",), places=np.array([[0.0, 0.0, 0.06]])
    )
    group = np.array([f"plate{i % 3}" for i in range(60)])
    true = {"probe.x": 2e-3, "probe.y": -1e-3, "probe.z": 0.0615}
    data = simulate_measurements(
        hexapod_poses(60), make_sensor(Pose()), make_sensor(probe, group=group), true=true
    )
    fit = identify(hexapod(), data, LeastSquares())
    assert fit.rank == 42
    assert_explained(fit, true)
    assert_contradicted(
        identify(
            hexapod(),
            data,
            LeastSquares(),
            options=FitOptions(nuisance=fix_setup(data, "probe.*", true | {"probe.x": 2.2e-3})),
        )
    )


def test_tool_offset_is_estimated_and_a_wrong_one_is_detected():
    true = {"tool.z": 0.12, "tool.rx": 0.01, "tool.y": 1e-3}
    tool = Pose(
        unknown=("tool",), T_platform_tool=geometry.make_pose(np.eye(3), np.array([0.0, 0.0, 0.1]))
    )
    balls = Position(targets=("a", "b", "c"), places=0.1 * np.eye(3))
    data = simulate_measurements(
        hexapod_poses(40), make_sensor(tool), make_sensor(balls), true=true
    )
    fit = identify(hexapod(), data, LeastSquares())
    assert fit.rank == 42
    assert_explained(fit, true)
    assert_contradicted(
        identify(
            hexapod(),
            data,
            LeastSquares(),
            options=FitOptions(nuisance=fix_setup(data, "tool.*", true | {"tool.y": 1.1e-3})),
        )
    )


def test_a_covariance_needs_no_estimate_of_setup_without_stated_uncertainty(monkeypatch):
    kind = Position(places=POINT, unknown=("frame", "targets"))
    sensor = make_sensor(kind, session=np.repeat(["one", "two"], 20))
    data = simulate_measurements(hexapod_poses(40), sensor, true={})
    assert data.nuisance_parameters is data.nuisance_parameters  # collected once
    fit = identify(hexapod(), data, lc.MAP())
    monkeypatch.setattr(fit_analysis, "estimate_nuisance", None)
    assert np.isfinite(fit.covariance).all()
