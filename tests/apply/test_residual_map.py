# SPDX-License-Identifier: Apache-2.0
"""The map of the residuals corrects poses where held-out regions prove a gain, and states what it
leaves.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.compensation import Compensation, compensate
from loopcal.cli.entry_point import main
from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty
from loopcal.errors import EstimationError
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.result import Identification
from loopcal.io.runs.run_folder import load_run, save_run
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.workspace import sample_workspace
from tests.diagnose.test_model_discrepancy import (
    UM,
    bend,
    delta,
    displaced,
    measure,
    places,
    repeat_poses,
    touch_uneven_bed,
)

SIZE = 60 * UM


@cache
def bent(name: str, seed: int, poses: int = 60) -> tuple[Mechanism, Measurements, Identification]:
    """Return a true machine, the data of its smooth errors, and the fit that states them."""
    robot = lc.load_robot(name)
    machine = robot.with_values(sample_truth(robot, 1, seed)[0])
    data = measure(robot, poses, seed)
    at = places(machine, data.readings)
    data = displaced(data, bend(at, at, SIZE, seed))
    return machine, data, adjust_uncertainty(identify(robot, data), data)


def measure_errors(name: str, seed: int, result: Compensation) -> np.ndarray:
    """Return the true errors (n, 3) [m] of the tool against the poses that a result states."""
    machine, data, _ = bent(name, seed)
    true = places(machine, result.readings)
    true = true + bend(true, places(machine, data.readings), SIZE, seed)
    return np.abs(true - (result.reached @ machine.tool)[:, :3, 3])


@pytest.mark.parametrize(
    "name", ["linear-delta", pytest.param("3-prs", marks=pytest.mark.evidence)]
)
def test_errors_at_fresh_poses_fall_and_their_uncertainty_contains_them(name):
    targets = sample_workspace(lc.load_robot(name), 30, 8).coordinates
    before, after, covered = [], [], []
    for seed in range(3):
        fit = bent(name, seed)[2]
        plain = compensate(fit, targets, frame="base")
        mapped = compensate(fit, targets, frame="base", residual_map=True)
        errors = measure_errors(name, seed, mapped)
        before.append((measure_errors(name, seed, plain) ** 2).mean())
        after.append((errors**2).mean())
        assert plain.uncertainty is not None
        assert mapped.uncertainty is not None
        covered.append((errors <= mapped.uncertainty.expanded[:, 3:]).mean())
        ratio = mapped.uncertainty.sd[:, 3:] / plain.uncertainty.sd[:, 3:]
        assert np.median(ratio) < 0.7
        assert mapped.residual_map is not None
        assert mapped.residual_map.data["lowest"] > 0.0
    assert np.sqrt(np.mean(after)) < 0.5 * np.sqrt(np.mean(before))
    assert np.mean(covered) > 0.93


def test_targets_are_reached_with_the_map_by_readings_and_by_commands():
    fit = bent("linear-delta", 0)[2]
    targets = sample_workspace(delta(), 10, 8).coordinates
    readings = compensate(fit, targets, residual_map=True)
    commands = compensate(fit, targets, "commands", steps=6, residual_map=True)
    for result in (readings, commands):
        assert result.usable.all()
        # [m]; the map changes by below 1 % over its own correction, three steps of it
        assert np.abs(result.remaining[:, 3:]).max() < 1e-9
    np.testing.assert_allclose(commands.readings, readings.readings, rtol=0.0, atol=1e-8)  # [m]
    plain = compensate(fit, targets)
    assert 5 * UM < np.abs(readings.readings - plain.readings).max() < 300 * UM


def test_outside_of_the_measured_poses_the_map_fades_to_nothing_and_all_uncertainty_remains():
    fit = bent("linear-delta", 2)[2]
    own = fit.posterior.discrepancy
    assert own is not None
    inside = forward(fit.robot, bent("linear-delta", 2)[1].readings).T[:5]
    far = inside.copy()
    far[:, :3, 3] += 20.0 * own.errors.length[3:]  # twenty correlation lengths
    D = np.random.default_rng(1).standard_normal((5, 6, len(fit.names)))
    assert np.abs(own.correct(inside, np.zeros_like(D))[:, 3:]).max() > 5 * UM
    assert np.abs(own.correct(far, D)).max() == 0.0
    corrected = replace(own, is_corrected=True)
    without, with_map = (np.linalg.norm(each.twists(far, D), axis=2) for each in (own, corrected))
    np.testing.assert_allclose(with_map, without, rtol=1e-9)  # rounding
    rest = own.errors.rest(far)[:, 3:]
    np.testing.assert_allclose(
        np.linalg.norm(rest, axis=2),
        np.tile(np.linalg.norm(own.errors.amplitude[3:], axis=1), (5, 1)),
        rtol=1e-12,  # rounding
    )


def refuse(fit: object) -> str:
    """Return the code with which a map is refused."""
    with pytest.raises(EstimationError) as error:
        compensate(fit, sample_workspace(delta(), 3, 8).coordinates, residual_map=True)  # type: ignore[arg-type]
    assert error.value.code is not None
    return error.value.code


def test_maps_that_are_no_proven_gain_are_refused():
    clean = measure(delta(), 30, 2)
    fit = adjust_uncertainty(identify(delta(), clean), clean)
    assert refuse(fit) == "compensation.map-not-tested"
    assert refuse(delta()) == "compensation.map-needs-run"
    rough = repeat_poses(3, 60 * UM)  # errors that each pose has by itself
    fit = adjust_uncertainty(identify(delta(), rough), rough)
    assert fit.posterior.discrepancy is not None
    assert refuse(fit) in ("compensation.map-not-tested", "compensation.map-no-gain")


def test_clean_data_hardly_ever_get_a_map():
    for seed in range(10):
        data = measure(delta(), 30, 300 + seed)
        own = adjust_uncertainty(identify(delta(), data), data).posterior.discrepancy
        # 2.5 % show errors, and 2.5 % of these a gain: one of 10 has a probability of 0.6 %
        assert own is None or not len(own.mean)


def test_the_map_of_an_uneven_bed_removes_its_bumps_in_held_out_regions():
    data = touch_uneven_bed(3)
    fit = identify(delta(), data, options=FitOptions(noise="estimated"))
    own = adjust_uncertainty(fit, data).posterior.discrepancy
    assert own is not None
    before, after, lowest, regions = own.test
    assert regions >= 8
    assert lowest > 0.0
    assert after < 0.8 * before


def test_a_run_keeps_its_map_and_the_command_line_uses_it(tmp_path, capsys):
    robot, data = delta(), bent("linear-delta", 0)[1]
    report = lc.calibrate(robot, data)
    save_run(report, tmp_path / "run")
    targets = sample_workspace(robot, 4, 8).coordinates
    stored = load_run(tmp_path / "run").load_posterior()
    first, second = (
        compensate(source, targets, residual_map=True) for source in (report.identification, stored)
    )
    np.testing.assert_allclose(first.readings, second.readings, rtol=0.0, atol=1e-12)  # [m]
    lines = [",".join(f"{name} [mm]" for name in robot.controlled)]
    lines += [",".join(f"{1e3 * x:.6f}" for x in row) for row in targets]
    (tmp_path / "targets.csv").write_text("\n".join(lines) + "\n")
    words = ["compensate", str(tmp_path / "run"), str(tmp_path / "targets.csv"), "--residual-map"]
    # slow errors explain the residuals above the stated noise: no failure
    assert main([*words, "-o", str(tmp_path / "out.csv")]) == 0
    assert "held-out regions" in " ".join(capsys.readouterr().out.split())
    assert (tmp_path / "out.csv").exists()
