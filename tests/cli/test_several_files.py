# SPDX-License-Identifier: Apache-2.0
"""Commands read several measurement files, with the unknowns and priors that the files state."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc

SD = "tracker.x: {start: 0 mm, sd: 1 mm}"


@pytest.fixture(scope="module")
def data() -> lc.Measurements:
    """Measurements of 20 poses by a tracker with unknown frame on two days, and an inclinometer."""
    robot = lc.load_robot("hexapod-42")
    poses = lc.sample_workspace(robot, 20, 3).coordinates
    days = np.array(["monday"] * 11 + ["tuesday"] * 9)
    tracker = lc.Sensor(
        lc.Pose(unknown=("frame",), frame="tracker"),
        lc.Gaussian(np.repeat([2e-6, 1e-6], 3)),
        session=days,
    )
    truth = robot.with_values(lc.sample_truth(robot, 1, 5)[0])
    seen = lc.simulate(
        truth,
        poses,
        lc.Instrument((tracker, lc.Sensor(lc.Inclination(), lc.Gaussian(np.full(2, 5e-6))))),
        seed=4,
    )
    warm = 20 + 0.1 * np.arange(20.0)
    return replace(
        seen,
        observations=(
            replace(seen.observations[0], context={"temperature": warm}),
            seen.observations[1],
        ),
    )


@pytest.fixture
def folder(tmp_path, monkeypatch, data):
    """Write the measurements as one file, as one file per instrument, and with separate poses."""
    monkeypatch.chdir(tmp_path)
    robot = lc.load_robot("hexapod-42")
    lc.save_measurements(data, "both.csv", robot)
    for name, rows in zip(("tracker", "tilts"), data.observations, strict=True):
        lc.save_measurements(replace(data, observations=(rows,)), f"{name}.csv", robot)
    lines = [
        line.split(",")
        for line in Path("tilts.csv").read_text().splitlines()
        if not line.startswith("#")
    ]
    front = [line for line in Path("tilts.csv").read_text().splitlines() if line.startswith("#")]
    Path("poses.csv").write_text("\n".join(",".join(cells[:7]) for cells in lines) + "\n")
    Path("values.csv").write_text(
        "\n".join([*front, *(",".join([cells[0], *cells[7:]]) for cells in lines)]) + "\n"
    )
    return tmp_path


@pytest.mark.slow
def test_splitting_data_into_several_files_gives_the_same_calibration(loopcal, folder) -> None:
    runs = {}
    for files in ("both.csv", "tracker.csv tilts.csv", "values.csv poses.csv tracker.csv"):
        output = files.split(".")[0]
        found = loopcal(f"calibrate hexapod-42 {files} -o {output} --json").json
        runs[files] = np.array([p["estimate"] for p in found["fit"]["parameters"]])
    one, two, three = runs.values()
    np.testing.assert_allclose(
        two, one, atol=1e-6
    )  # [mm], a thousandth of the noise: rows are folded in another order
    np.testing.assert_allclose(three, one, atol=1e-6)
    made_by = json.loads((folder / "values" / "result.json").read_text())["made_by"]["inputs"]
    assert {role: Path(file["path"]).name for role, file in made_by.items() if role != "robot"} == {
        "data": "values.csv", "poses": "poses.csv", "data-2": "tracker.csv"}  # fmt: skip
    with np.load(folder / "both" / "arrays.npz") as arrays:
        np.testing.assert_array_equal(arrays["temperature_0_pose"], 20 + 0.1 * np.arange(20.0))
    loopcal("validate values poses.csv tracker.csv", "The calibration used 20 of 20 rows", code=1)
    loopcal("validate both poses.csv values.csv", "The calibration used 20 of 20 rows", code=1)
    loopcal("validate both poses.csv values.csv --allow-fitted-data")


def test_unknowns_stated_in_a_file_change_the_rank(loopcal, folder) -> None:
    def rank(**changed: str) -> int:
        text = Path("tracker.csv").read_text()
        for unknowns in changed.values():
            text = text.replace("# kind: pose", f"# unknowns: {{{unknowns}}}\n# kind: pose", 1)
        Path("changed.csv").write_text(text)
        return loopcal("identifiability hexapod-42 changed.csv --json").json["rank"]

    assert rank() == 36
    assert rank(known='"tracker.*": fixed') == 42
    assert rank(known='"monday.tracker.*": fixed') == 42  # one known session shows the base
    assert rank(known="monday.tracker.x: fixed") == 37
    assert rank(known=f"monday.{SD}") == 37


@pytest.mark.slow
def test_priors_stated_in_a_file_are_used_with_held_out_poses(loopcal, folder) -> None:
    text = (
        Path("tracker.csv")
        .read_text()
        .replace("# kind: pose", f'# unknowns: {{{SD}, "*.tracker.z": fixed}}\n# kind: pose', 1)
    )
    Path("changed.csv").write_text(text)
    words = "calibrate hexapod-42 changed.csv tilts.csv -o run --hold-out 0.25 --json"
    found = loopcal(words).json
    local = {row["name"]: row for row in found["fit"]["local"]}
    for day in ("monday", "tuesday"):
        assert local[f"{day}.tracker.x"]["tolerance"] == pytest.approx(1.0)  # [mm]
        assert not local[f"{day}.tracker.z"]["free"]
        assert local[f"{day}.tracker.z"]["sd"] == 0.0
    assert found["validation"]["poses"]


def test_stated_values_survive_split_take_and_save(data, tmp_path) -> None:
    robot = lc.load_robot("hexapod-42")
    known = replace(
        data,
        stated_values=(
            lc.StatedValue("monday.tracker.x", 1e-3),
            lc.StatedValue("tuesday.tracker.rz"),
        ),
    )
    fit, held_out = known.split(hold_out=0.5, seed=2)
    assert fit.stated_values == held_out.stated_values == known.stated_values
    lc.save_measurements(known.take(np.arange(11)), tmp_path / "monday.csv", robot)
    assert "# unknowns: {monday.tracker.x: {sd: 1 mm}}" in (tmp_path / "monday.csv").read_text()
