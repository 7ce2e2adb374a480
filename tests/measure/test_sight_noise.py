# SPDX-License-Identifier: Apache-2.0
"""Noise of a tracker by range and angle, in simulation, plans and the sheets that they write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.measure.simulation import simulate_trials

PLACE = np.eye(4)
PLACE[:3, 3] = [2.6, -1.5, 0.3]
SIGHT = {"range": 20e-6, "angle": 5e-6}
HEAD = """# kind: position
# targets: [a, b, c]
# places: [[100 mm, 0 mm, 20 mm], [-50 mm, 80 mm, 20 mm], [-50 mm, -80 mm, 20 mm]]
# unknown: [frame, targets]
# frame: tracker
# noise: {range: {U: 40 um, k: 2}, angle: 5 urad}
"""
WHERE = "# T_base_frame: {x: 2600 mm, y: -1500 mm, z: 300 mm}\n"


def make_instrument(sight) -> lc.Instrument:
    kind = lc.Position(targets=("a", "b"), places=0.1 * np.eye(3)[:2], T_base_frame=PLACE)
    return lc.Instrument((lc.Sensor(kind, lc.Gaussian(np.zeros(6), sight)),))


def test_simulated_points_scatter_along_and_across_the_line_of_sight() -> None:
    """The standard deviation of 3000 draws is known to 1.3 %; four of these are allowed."""
    robot, count = lc.load_robot("hexapod-42"), 3000
    poses = np.array([[0.0, 0.0, 0.2, 0.0, 0.0, 0.0]])
    values = np.tile(robot.values, (count, 1))
    (measured,) = simulate_trials(robot, values, poses, make_instrument(SIGHT), 1).measured
    center = measured.mean(axis=0).reshape(2, 3)
    length = np.linalg.norm(center, axis=1)
    error = measured.reshape(count, 2, 3) - center
    along = np.einsum("tki,ki->tk", error, center / length[:, None])
    across = error - along[..., None] * (center / length[:, None])
    np.testing.assert_allclose(along.std(axis=0), SIGHT["range"], rtol=0.052)
    rms = np.sqrt(0.5 * np.einsum("tki,tki->k", across, across) / count)
    np.testing.assert_allclose(rms, SIGHT["angle"] * length, rtol=0.052)


def test_a_plan_and_its_sheet_know_range_and_angle(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    robot, columns = lc.load_robot("hexapod-42"), ["pose", *(f"q{k} [mm]" for k in range(1, 7))]
    header = ",".join([*columns, *(f"{t}.{x} [mm]" for t in "abc" for x in "xyz")])
    Path("nowhere.csv").write_text(HEAD + header + "\n")
    Path("tracker.csv").write_text(HEAD + WHERE + header + "\n")
    words = "plan hexapod-42 --poses 12 --candidates 30 --hold-out 0 -o"
    assert main([*words.split(), "nowhere", "--like", "nowhere.csv"]) == 1
    assert "need the place of the instrument" in " ".join(capsys.readouterr().err.split())
    assert main([*words.split(), "plan", "--like", "tracker.csv"]) == 0
    sheet = Path("plan/measurements.csv").read_text()
    assert "# noise: {range: 20 um, angle: 5 urad}" in sheet
    words = "simulate hexapod-42 --fill plan/measurements.csv -o filled.csv"
    assert main(words.split()) == 0
    filled = lc.load_measurements("filled.csv", robot).observations[0]
    spread = filled.kind.spread_sight_noise(filled.measured)
    wanted = sum(sd**2 * spread[name] for name, sd in SIGHT.items())
    np.testing.assert_allclose(filled.covariance, wanted, rtol=1e-12, atol=0.0)
    assert [part.name for part in filled.noise_parts] == ["range", "angle"]
    lc.save_measurements(lc.load_measurements("filled.csv", robot), "again.csv", robot)
    again = lc.load_measurements("again.csv", robot).observations[0]
    np.testing.assert_array_equal(again.covariance, filled.covariance)
    assert "cov." not in Path("again.csv").read_text()


@pytest.mark.parametrize(("name", "factor"), [("range", 2.0), ("angle", 2.0)])
def test_a_fit_of_trials_weights_them_as_the_calibration_does(name, factor) -> None:
    robot = lc.load_robot("hexapod-42")
    instrument = make_instrument(SIGHT | {name: factor * SIGHT[name]})
    poses = np.tile([0.0, 0.0, 0.2, 0.0, 0.0, 0.0], (3, 1))
    poses[:, 0] = [-0.02, 0.0, 0.02]
    trials = simulate_trials(robot, robot.values[None], poses, instrument, 2)
    from loopcal.estimate.problem import _compute_whiteners

    (white,) = _compute_whiteners(trials.instrument.sensors[0], trials.measured[0])
    np.testing.assert_allclose(white, trials.trial(0).observations[0].whitener, rtol=1e-9)


def test_a_noise_of_zero_needs_range_or_angle() -> None:
    with pytest.raises(lc.DataError, match="the sigma of the noise contains 0"):
        lc.Gaussian(np.zeros(3))
    with pytest.raises(lc.DataError, match="the sigma of the noise contains -1"):
        lc.Gaussian(np.zeros(3), {"range": -1.0})
