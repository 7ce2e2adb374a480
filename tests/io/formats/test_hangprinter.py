# SPDX-License-Identifier: Apache-2.0
"""Samples of a hanging printer: anchors, spools, known poses, taped lengths, refusals."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import loopcal as lc
from loopcal import forward, inverse
from loopcal.diagnose.identifiable_parameters import identifiability
from loopcal.errors import FileError
from loopcal.io.data.measurement_file import load_measurements, save_measurements
from loopcal.io.formats import hangprinter
from loopcal.io.formats.import_export import build_imported_robot
from loopcal.io.formats.program_format import ImportOptions
from tests.cable_robot import (
    LINE,
    NAMES,
    POSITION,
    TRUTH,
    compute_paid_out,
    format_samples,
    load_real_samples,
    simulate_example,
    solve_reference,
)

TAPED = "line_lengths_when_at_origin"
LENGTHS = [NAMES.index(f"{line}.length") for line in "ABCD"]
ANCHORS = [i for i, name in enumerate(NAMES) if "anchor" in name]
PRIOR = np.array([200.0, 200, 200, 5] * 4 + [3.0] + [0.3] * 4)
"""Spreads of the robot file with a tape of 5 mm [mm]."""

WRONG_LENGTHS = ["many", 1500, [1500] * 3, [1500] * 5, [1500, 1, 1, -2], [[1, 2, 3, 4]], ["1"] * 4]
WRONG_LENGTHS += [[True, 1, 1, 1]]

PUBLISHED = [
    *(16.83, -1584.86, -113.17, 1290.18, 1229.19, -157.45),
    *(-1409.88, 742.61, -151.80, 21.85, -0.16, 2343.67),
]
"""Anchors of the real machine [mm]."""


def read(folder, found: dict, **reading: Any):
    path = folder / "samples.json"
    path.write_text(format_samples(found), "utf-8")
    imported = hangprinter.read(path, ImportOptions("printer", **reading))
    return build_imported_robot(path, imported), imported


def test_robot_has_four_anchors_lengths_and_buildups_and_one_spool_radius(tmp_path) -> None:
    robot, _ = read(tmp_path, simulate_example())
    assert robot.parameters.names == NAMES
    assert robot.parameters.free.all()
    assert not np.isnan(robot.parameters.tolerance).any()


def test_spool_with_another_radius_has_its_own_parameter(tmp_path) -> None:
    robot, _ = read(
        tmp_path, simulate_example() | {"spool_r_in_origin_first_guess": [60, 60, 60, 50]}
    )
    assert {"spoolA-B-C.radius", "spoolD.radius"} <= set(robot.parameters.names)


def test_known_poses_become_rows_and_all_poses_keep_their_readings(tmp_path) -> None:
    found = simulate_example()
    _, imported = read(tmp_path, found, sigma_position=0.6e-3)
    data = imported.measurements
    assert data is not None
    np.testing.assert_allclose(np.degrees(data.readings), found["motor_pos_samp"], rtol=1e-14)
    (seen,) = data.observations
    np.testing.assert_array_equal(seen.rows, np.arange(9))
    np.testing.assert_allclose(seen.measured * 1e3, found["xyz_of_samp"], rtol=1e-14)
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(seen.covariance, axis1=1, axis2=2)), 0.6e-3, rtol=1e-14
    )
    assert data.labels[8:10] == ("known9", "sample10")


def test_sigma_of_a_line_is_converted_to_its_motor(tmp_path) -> None:
    robot, _ = read(tmp_path, simulate_example(), sigma_line=0.6e-3)
    gear = 18 / 240
    expected = 0.6e-3 / (60e-3 * gear * np.array([0.5, 0.5, 0.5, 0.25]))  # [rad]
    found = [actuator.sigma or np.nan for actuator in robot.assembly.actuators]
    np.testing.assert_allclose(found, expected, rtol=1e-6)  # seven digits are written


def test_inverse_kinematics_agree_with_the_closed_form_of_the_spools(tmp_path) -> None:
    """Compute line lengths from the readings by the closed form and from the poses."""
    found = simulate_example()
    robot, _ = read(tmp_path, found)
    true = robot.with_values(TRUTH * 1e-3)
    targets = np.zeros((12, 3))
    targets[:, 2] = np.linspace(0.05, 1.2, 12)
    targets[:, 0] = np.linspace(-0.4, 0.4, 12)
    at = inverse(true, targets)
    limbs = TRUTH[:16].reshape(4, 4)
    length = np.linalg.norm(targets[:, None] * 1e3 - limbs[:, :3], axis=2)
    paid = compute_paid_out(found | {"motor_pos_samp": np.degrees(at.q)}, TRUTH[16], TRUTH[17:])
    np.testing.assert_allclose(limbs[:, 3] + paid, length, rtol=0, atol=1e-7)  # [mm]
    np.testing.assert_allclose(forward(true, at.q).T[:, :3, 3], targets, rtol=0, atol=1e-9)  # [m]


def test_estimated_anchors_are_exact_without_noise_and_buildup(tmp_path) -> None:
    found = simulate_example()
    anchors = np.array([[10.0, -1500, -90], [1200, 700, -120], [-1250, 650, -100], [5, 5, 2200]])
    known = np.array(found["xyz_of_samp"])
    moved = np.linalg.norm(known[:, None] - anchors, axis=2) - np.linalg.norm(anchors, axis=1)
    gain = 60 * 18 / 240 * np.array([0.5, 0.5, 0.5, 0.25])
    path = tmp_path / "samples.json"
    path.write_text(json.dumps(found | {"motor_pos_samp": np.degrees(moved / gain).tolist()}))
    made = hangprinter.estimate_anchors(hangprinter.parse(path), path)
    np.testing.assert_allclose(
        made, anchors, rtol=0, atol=1e-6
    )  # [mm], condition 1e3 of lengths of 1e3 mm


def test_stated_anchors_are_used_and_need_no_known_pose(tmp_path) -> None:
    anchors = [[0, -1500, -90], [1200, 700, -120], [-1250, 650, -100], [0, 0, 2200]]
    robot, _ = read(tmp_path, simulate_example() | {"anchors": anchors, "xyz_of_samp": [[0, 0, 0]]})
    np.testing.assert_allclose(
        robot.values[:16].reshape(4, 4)[:, :3] * 1e3, anchors, rtol=0, atol=1e-9
    )
    robot, imported = read(tmp_path, simulate_example() | {"anchors": anchors, "xyz_of_samp": []})
    assert imported.measurements is not None
    assert imported.measurements.n_rows == 0
    save_measurements(imported.measurements, tmp_path / "samples.csv", robot, "")
    again = load_measurements(tmp_path / "samples.csv", robot)
    assert again.n_poses == 45
    assert again.n_rows == 0
    assert again.labels[0] == "sample1"
    assert "45 poses of 4 motor angles, 0 of them known" in str(imported.findings[0])
    assert (
        identifiability(robot, imported.measurements).rank == 14
    )  # 21 less six of the frame and one of the scale


def test_workspace_of_a_small_machine_is_not_rounded_to_nothing(tmp_path) -> None:
    anchors = [[0, -1.5, -0.1], [1.2, 0.7, -0.1], [-1.2, 0.6, -0.1], [0, 0, 0.9]]
    _, imported = read(tmp_path, simulate_example() | {"anchors": anchors, "xyz_of_samp": []})
    assert (
        "workspace: {x: [-0.225, 0.225], y: [-0.225, 0.225], z: [0, 0.45]}" in imported.robot_text
    )


def test_keys_that_are_not_read_are_reported(tmp_path) -> None:
    more = {
        "springKPerUnitLength": 2e4,
        "mover_weight": 2.0,
        "force_samp": [[1, 2, 3, 4]] * 41,
        "colour": "red",
    }
    _, imported = read(tmp_path, simulate_example() | more)
    notes = " | ".join(map(str, imported.findings))
    assert "does not read 41 rows of line forces" in notes
    assert "with 45 rows of motor angles" in notes
    for words in ("stiffness", "weight", "the unknown key 'colour'"):
        assert words in notes
    assert "Noise of a line: 1 mm (assumed: enter yours)" in notes


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"motor_pos_samp": None}, "'motor_pos_samp' is not a list of rows of numbers"),
        (
            {"motor_pos_samp": [[1, 2, 3, 4], [1, 2, 3]]},
            "row 2 of 'motor_pos_samp' has 3 numbers instead of 4",
        ),
        ({"motor_pos_samp": [[1, 2, 3, "x"]]}, "'motor_pos_samp' is not a list of rows of numbers"),
        ({"motor_pos_samp": [[1, 2]]}, "has 2 motors in a row"),
        (
            {"motor_pos_samp": [[1, 2, 3, 4]]},
            "'xyz_of_samp' has 9 poses, but 'motor_pos_samp' only 1",
        ),
        ({"xyz_of_samp": [[1, 2]]}, "row 1 of 'xyz_of_samp' has 2 numbers instead of 3"),
        ({"xyz_of_samp": [[1, 2, float("inf")]]}, "the number Infinity is not finite"),
        (
            {"mechanical_advantage": [2, 2, 2]},
            "'mechanical_advantage' is not a list of numbers, 4 in all",
        ),
        ({"mechanical_advantage": [2, 2, 2, 0]}, "Write positive numbers"),
        ({"spool_gear_teeth": "many"}, "'spool_gear_teeth' is not a number"),
        ({"anchors": [[1, 2, 3]]}, "'anchors' has 1 rows, but there are 4 lines"),
        ({"xyz_of_samp": []}, "the samples give no pose. Add known poses"),
        ({"xyz_of_samp": [[0, 0, 0]]}, "the 1 known poses do not determine the anchor of line A"),
        *(({TAPED: lengths}, "must be a list of 4 lengths in mm") for lengths in WRONG_LENGTHS),
        *(({TAPED: [v, 1, 1, 1]}, "is not finite") for v in (float("inf"), float("nan"))),
    ],
)
def test_invalid_samples_are_refused_in_one_sentence(tmp_path, change, sentence) -> None:
    with pytest.raises(FileError) as refused:
        read(tmp_path, simulate_example() | change)
    assert sentence in str(refused.value)


def test_known_poses_in_one_plane_are_refused_with_a_suggestion(tmp_path) -> None:
    found = simulate_example()
    flat = [[x, y, 0.0] for x, y, _ in found["xyz_of_samp"][:8]]
    with pytest.raises(FileError, match=r"poses at several heights .*or add the key 'anchors'"):
        read(tmp_path, found | {"xyz_of_samp": flat})


@pytest.mark.parametrize(
    ("text", "sentence"),
    [("{\n  [", r"samples.json:2: not valid JSON"), ("[1]", "'motor_pos_samp'")],
)
def test_file_without_samples_is_refused(tmp_path, text, sentence) -> None:
    path = tmp_path / "samples.json"
    path.write_text(text)
    with pytest.raises(FileError, match=sentence):
        hangprinter.read(path, ImportOptions("printer"))


# Lengths that were measured by hand are prior knowledge with a stated standard deviation.


def tape(seed: int, sigma: float = 5.0) -> dict[str, Any]:
    """Return samples of the example's machine with taped lengths; sigma in mm."""
    lengths = TRUTH[LENGTHS] + sigma * np.random.default_rng(seed).standard_normal(4)
    return simulate_example(seed) | {TAPED: lengths.round(1).tolist()}


def fit_samples(folder: Path, samples: dict[str, Any], sigma: float, **options: Any):
    """Return the fit of some samples; sigma of lines and positions in mm."""
    noise = {"sigma_line": sigma * 1e-3, "sigma_position": sigma * 1e-3}
    robot, imported = read(folder, samples, **noise, **options)
    assert imported.measurements is not None
    return lc.identify(robot, imported.measurements)


def measure_error(fit: lc.Identification, truth: Any) -> float:
    """Return the rms distance of the anchors from others [mm]."""
    apart = 1e3 * fit.robot.values[ANCHORS] - np.asarray(truth)
    return float(np.sqrt((apart.reshape(4, 3) ** 2).sum(axis=1).mean()))


def test_taped_lengths_are_nominal_values_with_the_tolerance_of_the_tape(tmp_path) -> None:
    robot, imported = read(tmp_path, tape(3), sigma_tape=7e-3)
    table = robot.parameters
    np.testing.assert_allclose(table.nominal[LENGTHS] * 1e3, tape(3)[TAPED], rtol=1e-12)
    np.testing.assert_allclose(table.tolerance[LENGTHS], 7e-3, rtol=1e-12)
    np.testing.assert_allclose(table.tolerance[ANCHORS], 0.2, rtol=1e-12)
    apart = np.linalg.norm(table.nominal[ANCHORS].reshape(4, 3), axis=1)
    np.testing.assert_allclose(apart, table.nominal[LENGTHS], rtol=1e-9)
    (finding,) = [f for f in imported.findings if f.code == "files.taped-prior"]
    assert "4 lengths" in str(finding)
    assert "standard deviation of 7 mm" in str(finding)
    assert "assumed" not in str(finding)
    robot, imported = read(tmp_path, tape(3))  # no sigma is stated
    np.testing.assert_allclose(robot.parameters.tolerance[LENGTHS], 0.01, rtol=1e-12)
    assert any("of 10 mm (assumed: enter yours)" in str(f) for f in imported.findings)


@pytest.mark.parametrize("empty", [None, 0])
def test_line_that_was_not_taped_is_left_to_the_data(tmp_path, empty) -> None:
    samples = tape(3)
    samples[TAPED][1] = empty
    robot, imported = read(tmp_path, samples, sigma_tape=5e-3)
    np.testing.assert_allclose(
        robot.parameters.tolerance[LENGTHS], [5e-3, 0.2, 5e-3, 5e-3], rtol=1e-12
    )
    assert any(f.code == "files.taped-prior" and f.data["count"] == 3 for f in imported.findings)
    samples[TAPED] = [empty] * 4
    without, _ = read(tmp_path, {k: v for k, v in samples.items() if k != TAPED})
    robot, imported = read(tmp_path, samples)
    np.testing.assert_array_equal(robot.values, without.values)
    assert not any(f.code == "files.taped-prior" for f in imported.findings)


@pytest.mark.parametrize("factor", [1e-3, 1 / 25.4, 10 / 0.9])
def test_tape_in_another_unit_is_refused(tmp_path, factor) -> None:
    samples = tape(3)
    samples[TAPED] = [length * factor for length in samples[TAPED]]
    with pytest.raises(FileError) as refused:
        read(tmp_path, samples)
    assert refused.value.code == "files.taped-length-far-off"
    assert "line A has the taped length" in str(refused.value)


def test_estimate_is_that_of_least_squares_updated_with_the_tape(tmp_path) -> None:
    """The reference shares no code: dense least squares, then the conditional normal distribution
    given the spreads. The problem is not linear, so the two differ by a share of the sd.
    """
    samples = tape(5)
    fit = fit_samples(tmp_path, samples, LINE, sigma_tape=5e-3)
    reference = solve_reference(samples, LINE, POSITION, TRUTH)
    nominal = 1e3 * fit.initial.values
    gain = reference.covariance @ np.linalg.inv(reference.covariance + np.diag(PRIOR**2))
    updated = reference.values + gain @ (nominal - reference.values)
    sd = np.sqrt(np.diag(reference.covariance - gain @ reference.covariance))
    assert (np.abs(1e3 * fit.robot.values - updated) < 0.15 * sd).all()
    mine = 1e3 * np.sqrt(np.diag(fit.covariance))
    np.testing.assert_allclose(mine, sd, rtol=0.1)
    assert sd[LENGTHS].max() < 0.5 * reference.sd[LENGTHS].max()


@pytest.mark.evidence
def test_taped_lengths_improve_the_anchors_of_simulated_machines(tmp_path) -> None:
    errors = []
    for seed in range(4):
        samples = tape(seed + 20)
        plain = {key: value for key, value in samples.items() if key != TAPED}
        fits = (
            fit_samples(tmp_path, plain, LINE),
            fit_samples(tmp_path, samples, LINE, sigma_tape=5e-3),
        )
        errors.append([measure_error(fit, TRUTH[ANCHORS]) for fit in fits])
    before, after = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    assert after < 0.7 * before
    assert after < 10.0  # [mm]


def test_taped_lengths_bring_a_real_machine_closer_to_its_published_anchors(
    tmp_path, data_folder
) -> None:
    samples = load_real_samples(data_folder)
    plain = {key: value for key, value in samples.items() if key != TAPED}
    before = measure_error(fit_samples(tmp_path, plain, 0.6), PUBLISHED)
    fit = fit_samples(tmp_path, samples, 0.6, sigma_tape=10e-3)
    assert fit.converged
    assert fit.prior_conflict is not None
    assert not fit.prior_conflict.conflict
    after = measure_error(fit, PUBLISHED)
    assert (round(before, 1), round(after, 1)) == (18.7, 12.7)  # [mm]


def test_tape_reduces_the_uncertainty_of_the_anchors_along_their_lines_to_a_third(
    tmp_path, data_folder
) -> None:
    samples = load_real_samples(data_folder)
    names = ("A.anchor.y", "B.anchor.x", "C.anchor.x", "D.anchor.z")
    for stated, found in (
        ([20, 23, 22, 28], {key: value for key, value in samples.items() if key != TAPED}),
        ([9, 7, 8, 9], samples),
    ):
        fit = fit_samples(tmp_path, found, 1.0, sigma_tape=5e-3)
        half = [1e3 * fit.plus_minus[NAMES.index(name)] for name in names]  # [mm]
        assert [round(value) for value in half] == stated


def test_stated_anchors_are_prior_knowledge_only_with_their_sigma(tmp_path) -> None:
    anchors = TRUTH[ANCHORS].reshape(4, 3).round(0).tolist()
    for options, sd in (({}, 0.2), ({"sigma_anchor": 0.012}, 0.012)):
        robot, _ = read(tmp_path, simulate_example() | {"anchors": anchors}, **options)
        np.testing.assert_allclose(robot.parameters.tolerance[ANCHORS], sd, rtol=1e-12)
    robot, _ = read(tmp_path, simulate_example(), sigma_anchor=0.012)  # nobody stated any
    np.testing.assert_allclose(robot.parameters.tolerance[ANCHORS], 0.2, rtol=1e-12)
