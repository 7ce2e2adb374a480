# SPDX-License-Identifier: Apache-2.0
"""The column `use` has the same meaning in every file, and files without values change nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.calibration_options import split_data
from loopcal.errors import DataError, FileError
from loopcal.io.data.measurement_file import (
    list_unfilled_files,
    load_measurements,
    read_tables,
    save_measurements,
)
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import simulate
from loopcal.mechanism.workspace import sample_workspace
from tests.findings.expectations import expect_refusal

POSES = 24
HELD_OUT = ("3", "7", "11", "19", "20")
FAR = {"tracker.x": 0.8, "tracker.y": -1.5, "tracker.z": 0.6,
       "tracker.rx": 0.5, "tracker.ry": -1.9, "tracker.rz": 1.2}  # fmt: skip


@pytest.fixture(scope="module")
def data(robot) -> Measurements:
    """Return positions in a tracker frame far from the base, five poses held out."""
    kind = Position(unknown=("frame",), frame="tracker")
    instrument = Instrument((Sensor(kind, Gaussian(np.full(3, 5e-6))),))
    poses = sample_workspace(robot, POSES, 3).coordinates
    seen = simulate(robot, poses, instrument, seed=4, nuisance_values=FAR)
    return replace(seen, is_held_out=[label in HELD_OUT for label in seen.labels])


@pytest.fixture
def files(tmp_path, monkeypatch, robot, data):
    """Write one file with everything (all.csv), and its poses and values apart."""
    monkeypatch.chdir(tmp_path)
    save_measurements(data, "all.csv", robot)
    lines = Path("all.csv").read_text().splitlines()
    front = [line for line in lines if line.startswith("#")]
    rows = [line.split(",") for line in lines if not line.startswith("#")]
    write("poses.csv", rows, ("pose", "use", "q"))
    write("plain.csv", rows, ("pose", "q"))
    for name, more in (("values.csv", []), ("named.csv", ["# poses: poses.csv"])):
        write(name, rows, ("pose", "x", "y", "z"), [*front, *more])
    write("used.csv", rows, ("pose", "use", "x", "y", "z"), front)
    empty = [[*row[:-3], "", "", ""] if i else row for i, row in enumerate(rows)]
    write("sheet.csv", empty, ("pose", "use", "q", "x", "y", "z"), front)
    return tmp_path


def write(name: str, rows: list[list[str]], columns: tuple[str, ...], front=()) -> None:
    """Write the columns whose names begin so."""
    kept = [i for i, cell in enumerate(rows[0]) if cell.startswith(columns)]
    lines = [*front, *(",".join(row[i] for i in kept) for row in rows)]
    Path(name).write_text("\n".join(lines) + "\n", encoding="utf-8")


def label_held_out(data: Measurements) -> tuple[str, ...]:
    """Return the names of the held-out poses."""
    return tuple(sorted(np.array(data.labels)[data.is_held_out].tolist(), key=int))


@pytest.mark.parametrize(
    "paths",
    [
        ["all.csv"],
        ["poses.csv", "values.csv"],
        ["values.csv", "poses.csv"],
        ["named.csv"],
        ["plain.csv", "used.csv"],
        ["poses.csv", "used.csv"],
        ["sheet.csv", "values.csv"],
        ["all.csv", "sheet.csv"],
    ],
)
def test_use_has_the_same_meaning_in_every_file(files, robot, paths):
    data = load_measurements(paths, robot)
    assert label_held_out(data) == HELD_OUT
    split = split_data(data)
    assert split.held_out is not None
    assert sorted(split.held_out.labels, key=int) == list(HELD_OUT)
    assert not set(HELD_OUT) & set(split.fitted.labels)


def test_contradicting_uses_are_refused_with_both_places(files, robot):
    lines = Path("used.csv").read_text().splitlines()
    line = next(i for i, text in enumerate(lines) if text.startswith("7,held-out"))
    lines[line] = lines[line].replace("held-out", "fit")
    Path("used.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(FileError) as refused:
        load_measurements(["poses.csv", "used.csv"], robot)
    assert refused.value.code == "data.use-contradicted"
    assert str(refused.value).startswith(f"used.csv:{line + 1}: pose '7' is 'fit'")
    assert "'held-out' in poses.csv:8" in str(refused.value)


def test_empty_cell_does_not_contradict(files, robot):
    text = Path("used.csv").read_text().replace(",held-out,", ",,").replace(",fit,", ",,")
    Path("used.csv").write_text(text)
    assert label_held_out(load_measurements(["used.csv", "poses.csv"], robot)) == HELD_OUT
    assert label_held_out(load_measurements(["used.csv", "plain.csv"], robot)) == ()


def test_use_survives_saving_and_taking(files, robot, data):
    again = load_measurements("all.csv", robot)
    save_measurements(again, "again.csv", robot)
    assert Path("again.csv").read_text() == Path("all.csv").read_text()
    taken = again.take([2, 0, 6])
    assert taken.is_held_out.tolist() == [True, False, True]
    assert again.fitted.n_poses == POSES - len(HELD_OUT)


def test_held_out_poses_are_never_fitted(files, robot):
    data = load_measurements("all.csv", robot)
    with expect_refusal("data.held-out-fitted", DataError):
        lc.identify(robot, data)
    assert lc.identify(robot, data.fitted).converged


@pytest.mark.parametrize(
    "options", [{"hold_out": 0.25}, {"held_out": ("1",)}, {"held_out": HELD_OUT[:3]}]
)
def test_second_choice_of_held_out_poses_is_refused(files, robot, options):
    data = load_measurements("named.csv", robot)
    with expect_refusal("data.held-out-twice", DataError):
        lc.calibrate(robot, data, lc.CalibrationOptions(**options))


def test_naming_the_same_held_out_poses_again_is_accepted(files, robot):
    split = split_data(load_measurements("named.csv", robot), held_out=HELD_OUT[::-1])
    assert split.held_out is not None
    assert split.held_out.n_poses == len(HELD_OUT)


def test_row_that_compares_poses_states_the_use_of_both(tmp_path, robot):
    q = ",".join(f"q{i} [mm]" for i in range(1, 7))
    text = (
        f"# kind: separation\n# noise: {{separation: 1 um}}\npose,use,{q},separation [mm]\n"
        "a,,0,0,0,0,0,0,\nb,,1,1,1,1,1,1,\nc,fit,2,2,2,2,2,2,\na;b,held-out,,,,,,,12\n"
    )
    path = tmp_path / "pairs.csv"
    path.write_text(text)
    assert load_measurements(path, robot).is_held_out.tolist() == [True, True, False]
    path.write_text(text + "b;c,fit,,,,,,,13\n")
    with pytest.raises(FileError, match=r"pairs\.csv:8: pose 'b' is 'fit'.*pairs\.csv:7"):
        load_measurements(path, robot)


def test_partly_held_out_block_is_refused(files, robot, data):
    with expect_refusal("data.block-partly-held-out", DataError):
        replace(data, block=np.arange(POSES) // 2)


def test_joined_empty_sheet_does_not_change_the_errors_before(files, robot):
    alone = lc.calibrate(robot, load_measurements(["poses.csv", "values.csv"], robot))
    assert alone.validation is not None
    for paths in (["sheet.csv", "values.csv"], ["values.csv", "sheet.csv"]):
        data = load_measurements(paths, robot)
        assert list_unfilled_files(read_tables(paths), data) == (Path("sheet.csv"),)
        assert len(data.observations) == 1
        joined = lc.calibrate(robot, data)
        assert joined.validation is not None
        before, after = joined.validation.before, joined.validation.after
        for mine, other in ((before, alone.validation.before), (after, alone.validation.after)):
            # [m] relative: the order of the poses changes sums by rounding, amplified by the fit
            rms = [errors.statistics("position").rms for errors in (mine, other)]
            np.testing.assert_allclose(rms[0], rms[1], rtol=1e-6)


def test_poses_that_only_an_empty_sheet_names_are_ignored(files, robot):
    """Their uses would hold out poses without any value, and their readings are planned ones."""
    text = Path("sheet.csv").read_text().splitlines()
    first = next(i for i, line in enumerate(text) if line.startswith("pose,")) + 1
    Path("other.csv").write_text(
        "\n".join([*text[:first], *(f"planned{line}" for line in text[first:])]) + "\n"
    )
    alone = load_measurements("all.csv", robot)
    for paths in (["all.csv", "other.csv"], ["other.csv", "all.csv"]):
        data = load_measurements(paths, robot)
        assert sorted(data.labels) == sorted(alone.labels)
        assert data.is_held_out.sum() == len(HELD_OUT)
        assert list_unfilled_files(read_tables(paths), data) == (Path("other.csv"),)
    report = lc.calibrate(robot, data)
    assert report.headline.endswith(f"from {POSES - len(HELD_OUT)} poses.")


def test_headline_counts_the_poses_that_are_measured(files, robot, data):
    """A sheet that is not filled in to the end."""
    rows = data.observations[0]
    measured = rows.measured.copy()
    measured[:2] = np.nan
    half = replace(data, observations=(replace(rows, measured=measured),))
    fitted = [label for label in data.labels[2:] if label not in HELD_OUT]
    assert f"from {len(fitted)} poses." in lc.calibrate(robot, half).headline
    dropped = lc.CalibrationOptions(fit=lc.FitOptions(excluded_poses=(fitted[0],)))
    assert f"from {len(fitted) - 1} poses." in lc.calibrate(robot, half, dropped).headline


def test_few_rows_of_a_first_file_do_not_start_a_shared_frame(files, robot, data):
    """Two positions do not determine a frame; the other file does."""
    observations = data.observations[0]
    few, rest = observations.take(np.arange(2)), observations.take(np.arange(2, POSES))
    plain = replace(data, is_held_out=np.zeros(POSES, dtype=bool))
    starts = [
        lc.identify(robot, replace(plain, observations=rows)).nuisance.starts
        for rows in ((few, rest), (rest, few))
    ]
    for name, value in FAR.items():
        for start in starts:
            # [m], [rad]: the nominal robot is the true one; 5 um of noise over 0.3 m
            assert abs(start[name] - value) < 1e-4


def test_data_without_any_value_are_refused_with_a_code(files, robot):
    Path("second.csv").write_text(Path("sheet.csv").read_text())
    for paths in (["sheet.csv"], ["sheet.csv", "second.csv"]):  # empty rows repeat nothing
        with expect_refusal("data.no-measured-value", DataError):
            lc.calibrate(robot, load_measurements(paths, robot))


def test_held_out_poses_without_any_value_are_refused_with_a_code(files, robot):
    lines = Path("all.csv").read_text().splitlines()
    lines = [
        ",".join(line.split(",")[:-3]) + ",,," if ",held-out," in line else line for line in lines
    ]
    Path("all.csv").write_text("\n".join(lines) + "\n")
    with expect_refusal("data.no-held-out-value", DataError):
        lc.calibrate(robot, load_measurements("all.csv", robot))


def test_files_without_any_value_keep_their_kinds(files, robot):
    """A sheet that is to be filled in by a simulation has no value yet."""
    data = load_measurements("sheet.csv", robot)
    assert data.n_rows == 0
    assert len(data.observations) == 1
