# SPDX-License-Identifier: Apache-2.0
"""Setup parameters (frames, targets, surfaces), linked poses and joint sensors in the fit. Frames
of the measurements, as arrays of a run folder.
"""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import loopcal as lc
import loopcal.estimate.pose_rows as blocks_module
import loopcal.estimate.problem as problem_module
from loopcal import geometry
from loopcal.apply.validation import validate
from loopcal.cli.entry_point import main
from loopcal.diagnose.outliers import find_outliers
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.information import observe_poses, observe_rows
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.posterior import FrameKnowledge, InstrumentFrame, frames_from_arrays
from loopcal.estimate.problem import problem_of
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.distance import Separation
from loopcal.measure.kinds.joints import JointSensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.nuisance import collect_nuisance_parameters
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.workspace import sample_workspace
from tests import zoo
from tests.estimate.problems import hexapod, hexapod_data, hexapod_poses, tracker

UM = 1e-6
POINT = np.array([[0.03, -0.02, 0.05]])
THREE = np.array([[0.1, 0.0, 0.02], [-0.06, 0.1, 0.03], [-0.05, -0.1, 0.01]])
NAMES = ("frame", "a", "b", "c")
STATION = geometry.make_pose(np.eye(3), np.array([-2.5, -1.8, 0.1]))
TRACKER = Position(targets=("a", "b", "c"), places=THREE, unknown=("frame", "targets"))
TRUE = {
    "frame.rx": 0.3, "frame.ry": -0.2, "frame.rz": 1.0, "frame.x": 0.4, "frame.y": -0.7, "anchor.x": 0.5, "anchor.y": -0.9,  # noqa: E501
    "anchor.z": 0.1, "distance.offset": 1e-3, "separation.offset": 2e-3, "a.x": 0.11, "b.z": 0.04,
}  # fmt: skip


class NoNoise(Gaussian):
    """Noise of a stated sigma whose draws are zero."""

    def draw(self, generator, n):
        return np.zeros((n, len(self.sd)))


def make_sensor(kind, noise: type[Gaussian] = NoNoise, sigma=UM):
    return Sensor(kind, noise(np.full(len(kind.noise_columns), sigma)))


def true_setup_values(*kinds):
    names = {parameter.name for kind in kinds for parameter in kind.nuisance_parameters}
    return {name: value for name, value in TRUE.items() if name in names}


def make_machine(name, n):
    """Return a nominal robot, true values within its spreads, and poses."""
    if name == "hexapod":
        return hexapod(), zoo.hexapod_truth(), hexapod_poses(n)
    robot = lc.load_robot(name)
    return robot, sample_truth(robot, 1, 3)[0], sample_workspace(robot, n, 5).coordinates


def largest_error(errors, size):
    """Return the largest error, lengths as a share of the robot's size."""
    result = [
        np.abs(values[np.isfinite(values)])
        for values in (errors.position / size, errors.orientation)
    ]
    return float(np.concatenate(result).max())


def simulate_mixed_data(seed=1, noise: type[Gaussian] = Gaussian):
    """Simulate poses in a known frame and targets in an unknown one."""
    instrument = Instrument((make_sensor(Pose(), noise), make_sensor(TRACKER, noise)))
    truth = hexapod().with_values(zoo.hexapod_truth())
    return simulate(
        truth, hexapod_poses(30), instrument, seed, nuisance_values=true_setup_values(TRACKER)
    )


def test_solution_after_elimination_equals_the_joint_solution():
    data, free = simulate_mixed_data(), select_free_parameters(hexapod())
    problem = problem_of(free, data)
    z = free.deviation(hexapod().values[None])
    linearized = problem.linearize(z, problem.start(z))
    factor, nuisance = linearized.factor, linearized.nuisance
    assert nuisance is not None
    projected = -np.linalg.solve(factor[0, :-1, :-1], factor[0, :-1, -1])
    local = collect_nuisance_parameters(data.observations, data.labels)
    stacked = observe_rows(observe_poses(free, data.readings), data, local, nuisance.values[0])[0]
    scale = np.linalg.norm(stacked[:, :-1], axis=0)
    joint = -np.linalg.lstsq(stacked[:, :-1] / scale, stacked[:, -1], rcond=None)[0] / scale
    assert_allclose(projected, joint[len(local) :], rtol=0, atol=1e-12 * np.abs(projected).max())
    done = nuisance.elimination
    assert_allclose(
        done.shift[0] + done.slope[0] @ projected, joint[: len(local)], rtol=0, atol=1e-11
    )
    assert linearized.equations[0] == len(stacked) - len(local)


@pytest.mark.parametrize("stated", [1.0, 5.0])
def test_standard_deviations_equal_those_of_the_joint_problem(stated):
    """Residuals below the stated noise say nothing about priors of the setup."""
    data = simulate_mixed_data()
    rows = tuple(replace(o, covariance=stated**2 * o.covariance) for o in data.observations)
    data = replace(data, observations=rows)
    local = collect_nuisance_parameters(data.observations, data.labels)
    known = local.with_nominal(local.values(true_setup_values(TRACKER))).with_prior("frame.*", UM)
    options = {1.0: FitOptions(sigma_uncertainty=0.0, nuisance=local),
               5.0: FitOptions(noise="estimated", nuisance=known)}[stated]  # fmt: skip
    fit = identify(hexapod(), data, LeastSquares(), options=options)
    free = select_free_parameters(fit.robot)
    at = observe_poses(free, data.readings)
    rows = observe_rows(at, data, local, fit.nuisance.estimate)[0, :, :-1]
    scale = np.linalg.norm(rows, axis=0)
    by_rows, by_prior = (rows / scale).T @ (rows / scale), np.zeros(len(scale))
    assert options.nuisance is not None
    tolerance = options.nuisance.table.tolerance
    by_prior[: len(local)] = np.where(np.isnan(tolerance), 0.0, tolerance**-2.0)
    by_prior = np.diag(by_prior / scale**2)
    inverse = np.linalg.inv(by_rows + by_prior)
    noise = fit.residual_test.sigma_scale**2
    sd = np.sqrt(np.diag(inverse @ (noise * by_rows + by_prior) @ inverse)) / scale
    assert_allclose(fit.nuisance.sd, sd[: len(fit.nuisance)], rtol=1e-3)
    assert_allclose(fit.standard_deviations, sd[len(fit.nuisance) :] * free.tolerance, rtol=1e-3)


def test_fit_in_an_unknown_frame_equals_that_in_a_known_frame_up_to_its_gauge():
    truth = hexapod().with_values(zoo.hexapod_truth())
    unknown = simulate(
        truth,
        hexapod_poses(40),
        Instrument((make_sensor(TRACKER),)),
        1,
        nuisance_values=true_setup_values(TRACKER),
    )
    first = identify(hexapod(), unknown, LeastSquares())
    known = simulate(truth, hexapod_poses(40), Instrument((make_sensor(Pose()),)), 1)
    second = identify(hexapod(), known, LeastSquares())
    assert (first.rank, second.rank) == (30, 42)
    others = simulate(
        truth,
        hexapod_poses(12, seed=7),
        Instrument((make_sensor(TRACKER),)),
        2,
        nuisance_values=true_setup_values(TRACKER),
    )
    assert largest_error(validate(first, others).after, 0.2) < 1e-9
    assert largest_error(validate(second.robot, others).after, 0.2) < 1e-9
    assert_allclose(second.estimate, truth.values, rtol=0, atol=1e-9 * 0.2)
    assert all({"frame", "a", "b", "c"} & set(c.nuisance) for c in first.unidentifiable)
    assert np.isinf(first.nuisance.sd).all()
    (kept,) = validate(first, others).findings
    assert (kept.code, tuple(kept.data["names"])) == ("validation.setup-kept", NAMES)
    assert validate(second.robot, others).findings[0].code == "validation.setup-fitted"


@pytest.mark.evidence
def test_intervals_of_robot_and_frame_contain_the_truth():
    robot = lc.load_robot("linear-delta")
    kind = Position(places=POINT, unknown=("frame", "targets"))
    truths, fits = sample_truth(robot, 24, 11), []
    inside = []
    for i, truth in enumerate(truths):
        instrument = Instrument((make_sensor(kind, Gaussian, 20 * UM),))
        data = simulate(
            robot.with_values(truth),
            sample_workspace(robot, 30, i).coordinates,
            instrument,
            i,
            nuisance_values=true_setup_values(kind),
        )
        fit = identify(robot, data, MAP())
        fits.append(fit)
        true = [
            TRUE.get(name, nominal)
            for name, nominal in zip(fit.nuisance.names, fit.nuisance.table.nominal, strict=True)
        ]
        off = np.concatenate(
            [
                fit.estimate - truth[select_free_parameters(robot).places],
                fit.nuisance.estimate - np.array(true),
            ]
        )
        sd = np.concatenate([fit.standard_deviations, fit.nuisance.sd])
        inside.append((np.abs(off) < 1.96 * sd)[np.isfinite(sd)])
        # the delta does not turn: where the target sits and where the frame begins are one and the
        # same
        assert np.isinf(sd).sum() == 6
        (finding,) = fit.nuisance.report_unobservable()
        assert finding.code == "setup.common-displacement"
        assert finding.data["names"] == ["frame", "target"]
    assert all(fit.converged for fit in fits)
    # intervals of one fit are correlated: the band is that of as many draws as there are fits, at
    # four standard deviations
    assert np.mean(inside) == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / len(fits)))


def fit_targets(name, unknown, drop=()):
    """Return the codes of findings on the setup of a robot with two targets in a tracker frame."""
    robot, _, poses = make_machine(name, 25)
    places = np.array([[0.06, 0.0, 0.01], [-0.03, 0.05, 0.02]])
    kind = lc.Position(targets=("a", "b"), places=places, unknown=unknown, frame="tracker")
    instrument = Instrument((make_sensor(kind, Gaussian, 20 * UM),))
    data = simulate(robot, poses, instrument, 1)
    if drop:
        (rows,) = data.observations
        measured = rows.measured.copy()
        measured[:, list(drop)] = np.nan
        data = replace(data, observations=(replace(rows, measured=measured),))
    return [f.code for f in identify(robot, data, MAP()).nuisance.report_unobservable()]


@pytest.mark.parametrize("name", ["rotary-delta", "five-bar", "3-rrr"])
def test_displacements_that_no_pose_shows_are_harmless(name):
    assert fit_targets(name, ("frame", "targets")) == ["setup.common-displacement"]


def test_a_target_that_is_never_measured_is_not_harmless():
    assert fit_targets("rotary-delta", ("targets",), (3, 4, 5)) == ["setup.unobservable"]
    both = fit_targets("rotary-delta", ("frame", "targets"), (3, 4, 5))
    assert both == ["setup.unobservable"]


@pytest.mark.parametrize("block", [16, 512])
def test_linked_poses_and_joint_sensors_are_fitted_with_any_block_size(monkeypatch, block):
    monkeypatch.setattr(blocks_module, "EXACT_BLOCK", block)
    robot, truth, poses = make_machine("3-prs", 40)
    passive = lc.inverse(robot, poses[:1]).passive_names[0]
    far = Sensor(
        Separation(places=POINT),
        Gaussian(np.full(1, UM)),
        rows=np.stack([np.arange(20), np.arange(20, 40)], axis=1),
    )
    joint = make_sensor(
        JointSensor(joints=(passive,), measures="angle", unknown=("offset",)), Gaussian
    )
    instrument = Instrument((far, joint, make_sensor(Pose(unknown=("frame",)), Gaussian)))
    data = simulate(
        robot.with_values(truth),
        poses,
        instrument,
        2,
        nuisance_values={**true_setup_values(Pose(unknown=("frame",))), f"{passive}.joint": 0.01},
    )
    fit = identify(robot, data)
    assert fit.converged
    assert fit.residual_test.p_value > 1e-4
    assert fit.nuisance.values[f"{passive}.joint"] == pytest.approx(
        0.01, abs=5 * fit.nuisance.sd[fit.nuisance.names.index(f"{passive}.joint")]
    )
    assert (
        len({tuple(poses) for poses in find_outliers(fit, data).poses}) == 20
    )  # linked poses are one block


def test_each_session_has_its_own_frame_and_elimination_cluster():
    truth = hexapod().with_values(zoo.hexapod_truth())
    day = np.repeat([f"day{i}" for i in range(8)], 10)
    kind = Pose(unknown=("frame",))
    sensor = Sensor(kind, Gaussian(np.full(6, UM)), session=day)
    moved = {f"day{i}.frame.{axis}": 0.1 * i for i in range(8) for axis in ("x", "rz")}
    data = simulate(truth, hexapod_poses(80), Instrument((sensor,)), 1, nuisance_values=moved)
    nuisance = problem_of(select_free_parameters(hexapod()), data).nuisance
    assert nuisance is not None
    assert np.bincount(nuisance.tree.cluster).tolist() == [6] * 8
    fit = identify(hexapod(), data)
    assert fit.converged
    assert fit.residual_test.p_value > 1e-4
    assert fit.nuisance.values["day3.frame.rz"] == pytest.approx(0.3, abs=1e-3)
    assert fit.rank == 36


@pytest.mark.slow
def test_memory_hardly_grows_with_the_number_of_sessions(monkeypatch):
    monkeypatch.setattr(blocks_module, "EXACT_BLOCK", 128)  # poses, those of 16 sessions

    def peak(sessions):
        day = np.repeat([f"day{i}" for i in range(sessions)], 8)
        sensor = Sensor(Pose(unknown=("frame",)), Gaussian(np.full(6, UM)), session=day)
        truth = hexapod().with_values(zoo.hexapod_truth())
        data = simulate(truth, hexapod_poses(8 * sessions), Instrument((sensor,)), 1)
        tracemalloc.start()
        try:
            assert identify(hexapod(), data, LeastSquares()).rank == 36
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    # blocks of 128 poses either way; per session there is a factor of 49 columns and little else
    peak(8)  # modules that are imported at the first fit count for none
    assert peak(32) < 1.5 * peak(16) + 32 * 49**2 * 8


def test_priors_and_fixed_setup_parameters_are_respected():
    data = simulate_mixed_data()
    local = collect_nuisance_parameters(data.observations, data.labels)
    true = local.values(true_setup_values(TRACKER))
    fixed = identify(
        hexapod(), data, options=FitOptions(nuisance=local.with_nominal(true).with_fixed("*"))
    )
    assert (fixed.nuisance.estimate == true).all()
    assert (fixed.nuisance.sd == 0.0).all()
    near = identify(
        hexapod(), data, options=FitOptions(nuisance=local.with_nominal(true).with_prior("*", 1e-9))
    )
    assert_allclose(near.estimate, fixed.estimate, rtol=0, atol=1e-8)
    wide = identify(
        hexapod(), data, options=FitOptions(nuisance=local.with_nominal(true).with_prior("*", 10.0))
    )
    assert_allclose(wide.estimate, identify(hexapod(), data).estimate, rtol=0, atol=1e-9)
    assert wide.residual_test.degrees == identify(hexapod(), data).residual_test.degrees + len(
        local
    )


def test_noise_is_estimated_in_an_unknown_frame():
    truth = hexapod().with_values(zoo.hexapod_truth())
    data = simulate(
        truth,
        hexapod_poses(40),
        Instrument((make_sensor(TRACKER, Gaussian),)),
        1,
        nuisance_values=true_setup_values(TRACKER),
    )
    fit = identify(hexapod(), data, options=FitOptions(noise="estimated"))
    assert fit.converged
    # 315 degrees of freedom: sd of the ratio is 4 %
    assert fit.residual_test.sigma_scale == pytest.approx(1.0, abs=0.16)


def test_trials_with_unknown_frames_equal_single_fits():
    robot = hexapod()
    instrument = Instrument((make_sensor(TRACKER, Gaussian),))
    truths = np.stack(
        [zoo.hexapod_truth(), robot.values + 0.5 * (zoo.hexapod_truth() - robot.values)]
    )
    trials = simulate_trials(
        robot, truths, hexapod_poses(30), instrument, 3, nuisance_values=true_setup_values(TRACKER)
    )
    result = identify_trials(robot, trials, MAP())
    for i in range(2):
        alone = identify(robot, trials.trial(i), MAP())
        assert result.converged[i]
        assert_allclose(result.values[i], alone.robot.values, rtol=0, atol=1e-10)


def test_setup_start_values_are_computed_once_for_all_trials(monkeypatch):
    sought = []
    begin = problem_module.guess_nuisance_values
    monkeypatch.setattr(
        problem_module,
        "guess_nuisance_values",
        lambda data, *rest: (sought.append(data), begin(data, *rest))[1],
    )
    robot = lc.load_robot("linear-delta")
    kind = Position(places=POINT, unknown=("frame",))
    trials = simulate_trials(
        robot, sample_truth(robot, 5, 1), sample_workspace(robot, 20, 1).coordinates, Instrument((make_sensor(kind, Gaussian),)), 1,  # noqa: E501
        nuisance_values=true_setup_values(kind),
    )  # fmt: skip
    assert identify_trials(robot, trials, MAP()).converged.all()
    assert len(sought) == 1


def test_instrument_in_a_known_frame_has_no_setup_parameters():
    fit = identify(hexapod(), hexapod_data(20, instrument=tracker()))
    assert len(fit.nuisance) == 0
    assert fit.to_dict()["local"] == []


def test_command_line_calibrates_with_a_tracker_in_an_unknown_frame(tmp_path):
    robot = lc.load_robot("hexapod-42")
    truth = robot.with_values(sample_truth(robot, 1, 3)[0])
    data = simulate(
        truth,
        sample_workspace(robot, 40, 5).coordinates,
        Instrument((make_sensor(TRACKER, Gaussian),)),
        1,
        nuisance_values=true_setup_values(TRACKER),
    )
    path = tmp_path / "tracker.csv"
    lc.save_measurements(data, path, robot)
    assert (
        main(
            [
                "calibrate",
                "hexapod-42",
                str(path),
                "-o",
                str(tmp_path / "run"),
                "--hold-out",
                "0.25",
            ]
        )
        == 0
    )
    assert "frame.rz" in (tmp_path / "run" / "result.json").read_text(encoding="utf-8")


@pytest.mark.parametrize("count", [0, 1, 3])
def test_arrays_of_a_run_folder_return_the_frames(count):
    """An inclinometer has no frame; its run could not be written."""
    rng = np.random.default_rng(count)
    instruments = {
        f"tracker{i}": InstrumentFrame(np.eye(4), rng.standard_normal((6, 5)), np.eye(6))
        for i in range(count)
    }
    frames = FrameKnowledge(rng.standard_normal((12, 2)), rng.standard_normal((7, 3)), instruments)
    restored = frames_from_arrays(frames.arrays())
    assert restored is not None
    assert np.array_equal(restored.unfixed, frames.unfixed)
    assert list(restored.instruments) == list(instruments)
    for name, frame in instruments.items():
        assert np.array_equal(restored.instruments[name].by_parameters, frame.by_parameters)
