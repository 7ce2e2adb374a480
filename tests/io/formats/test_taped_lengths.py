# SPDX-License-Identifier: Apache-2.0
"""Lengths that were measured by hand are prior knowledge with a stated standard deviation."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.errors import FileError
from loopcal.io.formats import hangprinter
from loopcal.io.formats.import_export import build_imported_robot
from loopcal.io.formats.program_format import ImportOptions
from loopcal.io.robot.robot_file import load_robot
from tests.cable_robot import (
    LINE,
    NAMES,
    POSITION,
    TRUTH,
    format_samples,
    load_real_samples,
    simulate_example,
    solve_reference,
)

TAPED = "line_lengths_when_at_origin"
LENGTHS = [NAMES.index(f"{line}.length") for line in "ABCD"]
ANCHORS = [i for i, name in enumerate(NAMES) if "anchor" in name]
PRIOR = np.array([200.0, 200, 200, 5] * 4 + [3.0] + [0.3] * 4)
"""Tolerances of the robot file with a tape of 5 mm [mm]."""

PUBLISHED = [
    *(16.83, -1584.86, -113.17, 1290.18, 1229.19, -157.45),
    *(-1409.88, 742.61, -151.80, 21.85, -0.16, 2343.67),
]
"""Anchors of the real machine [mm]."""


def read(folder: Path, samples: dict[str, Any], **options: Any):
    """Return the robot and the import of some samples."""
    path = folder / "samples.json"
    path.write_text(format_samples(samples), "utf-8")
    imported = hangprinter.read(path, ImportOptions("printer", **options))
    return build_imported_robot(path, imported), imported


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


def test_tape_without_a_stated_sigma_is_assumed_and_said_so(tmp_path) -> None:
    robot, imported = read(tmp_path, tape(3))
    np.testing.assert_allclose(robot.parameters.tolerance[LENGTHS], 0.01, rtol=1e-12)
    assert any("standard deviation of 10 mm (assumed)" in str(f) for f in imported.findings)


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


@pytest.mark.parametrize(
    "lengths", ["many", 1500, [1500] * 3, [1500] * 5, [1500, 1, 1, -2], [[1, 2, 3, 4]], ["1"] * 4,
                [True, 1, 1, 1]]
)  # fmt: skip
def test_wrong_lengths_are_refused_in_one_sentence(tmp_path, lengths) -> None:
    with pytest.raises(FileError) as refused:
        read(tmp_path, simulate_example() | {TAPED: lengths})
    assert refused.value.code == "files.taped-lengths"
    assert "a list of 4 lengths in mm is needed" in str(refused.value)


@pytest.mark.parametrize("length", [float("inf"), float("nan")])
def test_lengths_that_are_not_finite_are_no_numbers_of_json(tmp_path, length) -> None:
    with pytest.raises(FileError, match="is not finite"):
        read(tmp_path, simulate_example() | {TAPED: [length, 1, 1, 1]})


@pytest.mark.parametrize("factor", [1e-3, 1 / 25.4, 10 / 0.9])
def test_tape_in_another_unit_is_refused(tmp_path, factor) -> None:
    samples = tape(3)
    samples[TAPED] = [length * factor for length in samples[TAPED]]
    with pytest.raises(FileError) as refused:
        read(tmp_path, samples)
    assert refused.value.code == "files.taped-length-far-off"
    assert "line A was taped at" in str(refused.value)


def test_estimate_is_that_of_least_squares_updated_with_the_tape(tmp_path) -> None:
    """The reference shares no code: dense least squares, then the conditional normal distribution
    given the tolerances. The problem is not linear, so the two differ by a share of the sd.
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
    assert (round(before, 1), round(after, 1)) == (18.7, 12.7)  # [mm], the numbers of the page


def test_tape_reduces_the_uncertainty_of_the_anchors_along_their_lines_to_a_quarter(
    tmp_path, data_folder, root
) -> None:
    samples = load_real_samples(data_folder)
    names = ("A.anchor.y", "B.anchor.x", "C.anchor.x", "D.anchor.z")
    page = (root / "docs" / "cable-robots.md").read_text("utf-8")
    for what, found in (
        ("none", {key: value for key, value in samples.items() if key != TAPED}),
        ("5 mm", samples),
    ):
        fit = fit_samples(tmp_path, found, 1.0, sigma_tape=5e-3)
        half = [1e3 * fit.plus_minus[NAMES.index(name)] for name in names]  # [mm]
        cells = " | ".join(f"{value:.0f} mm" for value in half)
        assert f"| {what} | {cells} |" in page


def test_stated_anchors_are_prior_knowledge_only_with_their_sigma(tmp_path) -> None:
    anchors = TRUTH[ANCHORS].reshape(4, 3).round(0).tolist()
    for options, sd in (({}, 0.2), ({"sigma_anchor": 0.012}, 0.012)):
        robot, _ = read(tmp_path, simulate_example() | {"anchors": anchors}, **options)
        np.testing.assert_allclose(robot.parameters.tolerance[ANCHORS], sd, rtol=1e-12)
    robot, _ = read(tmp_path, simulate_example(), sigma_anchor=0.012)  # nobody stated any
    np.testing.assert_allclose(robot.parameters.tolerance[ANCHORS], 0.2, rtol=1e-12)


PRINTER = """[printer]
kinematics: delta
delta_radius: 130.25
[stepper_a]
step_distance: 0.0125
position_endstop: 250
arm_length: 269
[stepper_b]
step_distance: 0.0125
[stepper_c]
step_distance: 0.0125
"""
GCODE = "M665 L269 R130 H250 X0 Y0 Z0\nM666 X0 Y0 Z0\n"


@pytest.mark.parametrize(
    ("name", "text"), [("printer.cfg", PRINTER), ("printer.g", GCODE), ("printer.gcode", GCODE)]
)
def test_arms_of_a_delta_are_prior_knowledge_where_their_sigma_is_stated(
    tmp_path, monkeypatch, name, text
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(name).write_text(text)
    arms = [f"arm{k}.length" for k in (1, 2, 3)]
    for words, is_free in (("", False), ("--sigma-tape 0.3mm", True)):
        assert main(["import", name, "-o", "r.yaml", "--force", *words.split()]) == 0
        table = load_robot("r.yaml").parameters
        index = [table.index(arm) for arm in arms]
        assert table.free[index].all() == is_free
        if is_free:
            np.testing.assert_allclose(table.tolerance[index], 0.3e-3, rtol=1e-12)


def test_joint_centers_of_a_hexapod_are_prior_knowledge(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", "hexapod-42", "--format", "linuxcnc", "-o", "h.hal"]) == 0
    words = "import h.hal --unit mm --home-z 200mm -o h.yaml --sigma-tape 0.5mm"
    assert main(words.split()) == 0
    table = load_robot("h.yaml").parameters
    centers = [i for i, name in enumerate(table.names) if ".base." in name or ".platform." in name]
    assert len(centers) == 36
    np.testing.assert_allclose(table.tolerance[centers], 0.5e-3, rtol=1e-12)


def test_option_of_another_format_is_refused(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("printer.cfg").write_text(PRINTER)
    assert main(["import", "printer.cfg", "-o", "r.yaml", "--sigma-anchor", "1mm"]) == 1
    assert "--sigma-anchor does not belong to the format klipper" in capsys.readouterr().err
