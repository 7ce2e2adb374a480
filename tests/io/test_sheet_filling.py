# SPDX-License-Identifier: Apache-2.0
"""Sheets of a plan are filled in from exports in the formats of the shipped profiles.

The exports are written here as the profiles describe them: the points of a simulated hexapod in the
frame of a tracker that stands two meters away.
"""

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from loopcal import geometry
from loopcal.apply.simulated_measurements import (
    InstrumentDescription,
    build_instrument,
    place_targets,
    simulate_measurements,
)
from loopcal.cli.entry_point import main
from loopcal.diagnose.conventions.convention_check import check_conventions
from loopcal.diagnose.measured_points import examine_points
from loopcal.errors import DataError, FileError
from loopcal.io.data.measurement_file import format_data_sheet, load_measurements
from loopcal.io.exports.conversion import fill_sheet, read_sheet, save_converted
from loopcal.io.exports.growing_export import GrowingExport, read_new_rows
from loopcal.io.exports.profile import find_profile_file, read_profile, with_local_settings
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.position import Position
from tests.findings.expectations import expect_refusal

TARGETS = ("SMR1", "SMR2", "SMR3")
N = 14
Points = Sequence[tuple[str, np.ndarray]]


@pytest.fixture(scope="module")
def instrument(robot):
    description = InstrumentDescription(
        ("position",), sigma_position=15e-6, unknown_frames=("base",), targets=TARGETS
    )
    return place_targets(build_instrument(description), robot)


@pytest.fixture(scope="module")
def simulated(robot, instrument):
    return simulate_measurements(robot, instrument, poses=N, draw_errors=True, seed=3).data


@pytest.fixture(scope="module")
def points(simulated) -> Points:
    """The points of all poses in the tracker's frame [mm], by name."""
    rows = simulated.observations[0]
    R = geometry.exp_so3(np.array([0.05, -0.03, 0.7]))
    measured = rows.measured.reshape(N, 3, 3) @ R.T + [2.5, -0.3, -0.7]
    return [
        (f"{simulated.labels[i]}_{target}", measured[i, k] * 1e3)
        for i in range(N)
        for k, target in enumerate(TARGETS)
    ]


@pytest.fixture
def sheet(robot, instrument, simulated, tmp_path) -> Path:
    path = tmp_path / "sheet.csv"
    text = format_data_sheet(
        robot, instrument, simulated.readings, simulated.labels, np.arange(N) >= N - 3
    )
    path.write_text(text)
    return path


def write_spatial_analyzer(path: Path, points: Points, end: str = "\n", scale: float = 1.0) -> Path:
    lines = ["// SpatialAnalyzer 2023.2.0621.4", "// Working frame: A::WORLD"]
    lines += ["// Collection,  Group,  Point,  X,  Y,  Z", ""]
    for name, xyz in points:
        lines.append(f"A,  Hexapod,  {name},  " + ",  ".join(f"{v * scale:.6f}" for v in xyz))
    path.write_bytes((end.join(lines) + end).encode())
    return path


def write_leica(path: Path, points: Points) -> Path:
    """Write blanks and decimal commas, with a comment and further columns."""
    lines = ["# Punkt X Y Z sX sY sZ"]
    for name, xyz in points:
        numbers = " ".join(f"{v:12.4f}".replace(".", ",") for v in (*xyz, 0.006, 0.006, 0.009))
        lines.append(f"P{name:10} {numbers}")
    path.write_text("\r\n".join(lines) + "\r\n", encoding="utf-8-sig")
    return path


def write_wide(path: Path, points: Points) -> Path:
    """Write a line for each pose, with the columns of all targets."""
    poses: dict[str, list[str]] = {}
    names = [name.split("_")[1] for name, _ in points[:3]]
    for name, xyz in points:
        poses.setdefault(name.split("_")[0], []).extend(f"{v:.5f}" for v in xyz)
    head = ["Name", *(f"{name} {axis}" for name in names for axis in "XYZ")]
    path.write_text("\n".join(map(",".join, [head, *([p, *v] for p, v in poses.items())])))
    return path


def write_faro(path: Path, points: Points, separator: str = ",") -> Path:
    """Write a header below two lines, and columns in another order."""
    lines = ["CAM2 Measure", "", separator.join(["Label", "Name", "Z", "Y", "X", "RMS"])]
    for name, (x, y, z) in points:
        cells = ["SMR", name, *(f"{v:.5f}" for v in (z, y, x)), "0.004"]
        mark = "." if separator == "," else ","
        lines.append(separator.join(cell.replace(".", mark) for cell in cells))
    path.write_text("\n".join(lines) + "\n")
    return path


def fill(robot, sheet: Path, *exports: Path, profile: str = "spatial-analyzer", **options):
    unit, comma = options.pop("unit", None), options.pop("comma", False)
    read = with_local_settings(read_profile(find_profile_file(profile)), unit, comma)
    return fill_sheet(robot, sheet, exports, read, **options)


def examine(robot, sheet: Path, *exports: Path, **options):
    """Fill in a sheet and examine its points."""
    filled = fill(robot, sheet, *exports, **options)
    return examine_points(robot, filled.data, filled.unit)


def list_codes(filled) -> list[str]:
    return [finding.code for finding in filled.findings]


def tabulate(filled) -> list[list[str]]:
    return list(csv.reader(line for line in filled.text.splitlines() if line[0] != "#"))


def rename(points: Points, names: dict[str, str]) -> Points:
    return [(names.get(name, name), xyz) for name, xyz in points]


@pytest.mark.parametrize("name", ["faro", "leica", "spatial-analyzer", "wide"])
def test_shipped_profile_reads_and_states_its_source(name) -> None:
    path = find_profile_file(name)
    assert read_profile(path).kind is not None
    assert "# Source: " in path.read_text()


def test_unknown_profile_is_refused_with_the_shipped_ones() -> None:
    with pytest.raises(
        FileError, match=r"did you mean 'faro'.*faro, leica, spatial-analyzer and wide"
    ):
        find_profile_file("farro")


@pytest.mark.parametrize("form", ["windows", "inches", "leica", "faro", "faro-comma", "wide"])
def test_every_format_fills_the_sheet_with_the_same_points(
    form, robot, sheet, points, tmp_path
) -> None:
    path = tmp_path / "export.txt"
    if form == "windows":
        filled = fill(robot, sheet, write_spatial_analyzer(path, points, "\r\n"))
    elif form == "inches":
        export = write_spatial_analyzer(path, points, scale=1 / 25.4)
        filled = fill(robot, sheet, export, unit="in")
    elif form == "leica":
        filled = fill(robot, sheet, write_leica(path, points), profile="leica", comma=True)
    elif form == "wide":
        filled = fill(robot, sheet, write_wide(path, points), profile="wide")
    else:
        export = write_faro(path, points, ";" if form == "faro-comma" else ",")
        filled = fill(robot, sheet, export, profile="faro", comma=form == "faro-comma")
    assert list_codes(filled) == ["sheet.filled"]
    assert examine_points(robot, filled.data, filled.unit) == ()
    assert not filled.misfits
    output = tmp_path / "measured.csv"
    save_converted(filled.text, output)
    data = load_measurements(output, robot)
    assert data.is_held_out.sum() == 3
    wanted = np.array([xyz for _, xyz in points]).reshape(N, 9) / 1e3
    np.testing.assert_allclose(data.observations[0].measured, wanted, atol=1e-7)  # [m], digits


def test_missing_unknown_and_repeated_points_are_listed(robot, sheet, points, tmp_path) -> None:
    again = [("3_SMR1", points[6][1] + 0.012)]
    exported = [*points[:9], *again, *points[10:], points[12], ("99_SMR1", points[0][1])]
    filled = fill(robot, sheet, write_spatial_analyzer(tmp_path / "e.txt", exported))
    found = {finding.code: finding for finding in filled.findings}
    assert found["sheet.points-missing"].data["names"] == ("4_SMR1",)
    assert found["sheet.points-repeated"].data["names"] == ("3_SMR1",)
    assert found["sheet.points-identical"].data["names"] == ("5_SMR1",)
    assert found["sheet.points-unknown"].data["names"] == ("99_SMR1",)
    rows = [row for row in tabulate(filled)[1:] if row[0] == "3"]
    assert len(rows) == 2
    assert f"{points[6][1][0] + 0.012:.6f}" in rows[1]


def test_a_sheet_with_a_pose_twice_is_refused(robot, sheet, points, tmp_path) -> None:
    """Both would get the same points, which no calibration takes."""
    export = write_spatial_analyzer(tmp_path / "points.txt", points)
    with sheet.open("a") as file:
        file.write(sheet.read_text().splitlines()[-1] + "\n")
    with pytest.raises(DataError, match=r"sheet.csv.*equal position values.*Remove the copies"):
        fill(robot, sheet, export)


@pytest.mark.parametrize("end", [b"\r\n", b"\r\r\n"])
def test_settings_stay_whole_whatever_ends_the_lines(end, robot, sheet, points, tmp_path) -> None:
    sheet.write_bytes(sheet.read_bytes().replace(b"\n", end))
    filled = fill(robot, sheet, write_spatial_analyzer(tmp_path / "e.txt", points))
    (tmp_path / "out.csv").write_text(filled.text)
    data = load_measurements(tmp_path / "out.csv", robot, allow_outside_stroke=True)
    assert data.n_poses == N


@pytest.mark.parametrize("by_order", [False, True])
def test_a_growing_export_gives_complete_sets_of_targets_once(
    robot, sheet, points, tmp_path, by_order
) -> None:
    lines = [f"{name} {x} {y} {z}\n" for name, (x, y, z) in points]
    entry = read_sheet(sheet, robot)[1]
    path = tmp_path / "points.txt"
    export = GrowingExport(path, read_profile(find_profile_file("leica")), entry, by_order)
    assert read_new_rows(export).rows == ()  # nothing is written yet
    found = []
    for text in ("".join(lines[:2]), "".join(lines[:4]), "".join(lines[:6]) + lines[6][:-3]):
        path.write_text(text)
        new = read_new_rows(export)
        export = new.export
        found.append([row.get("pose", "") for row in new.rows])
        assert all(row[f"{target}.z"] for row in new.rows for target in TARGETS)
    first, second = ("", "") if by_order else (points[0][0][:-5], points[3][0][:-5])
    assert found == [[], [first], [second]]
    path.write_text("".join(lines[3:6]))
    again = read_new_rows(export)
    assert [finding.code for finding in again.findings] == ["session.export-began-again"]
    assert len(again.rows) == 1


def test_a_followed_export_may_begin_with_its_header(robot, sheet, points, tmp_path) -> None:
    path, entry = tmp_path / "points.csv", read_sheet(sheet, robot)[1]
    export = GrowingExport(path, read_profile(find_profile_file("faro")), entry)
    header = "Name,X,Y,Z"
    path.write_text(header + "\n")
    begun = read_new_rows(export)
    assert (begun.rows, begun.findings) == ((), [])
    path.write_text(header + "\nnonsense\n")
    assert [f.code for f in read_new_rows(begun.export).findings] == ["session.no-line-matches"]


def test_points_sorted_by_target_come_to_their_poses(robot, sheet, points, tmp_path) -> None:
    by_target = sorted(points, key=lambda point: point[0].split("_")[1])
    filled = fill(robot, sheet, write_spatial_analyzer(tmp_path / "e.txt", by_target))
    assert list_codes(filled) == ["sheet.filled"]
    assert len(tabulate(filled)) == N + 1


def test_unknown_target_is_a_misfit_with_its_line(robot, sheet, points, tmp_path) -> None:
    export = write_spatial_analyzer(tmp_path / "e.txt", rename(points, {"2_SMR1": "2_SMR4"}))
    filled = fill(robot, sheet, export)
    assert filled.misfits == ((str(export), 8, "the target 'SMR4' is not one of SMR1, SMR2, SMR3"),)


def test_inches_without_the_unit_are_refused(robot, sheet, points, tmp_path) -> None:
    export = write_spatial_analyzer(tmp_path / "e.txt", points, scale=1 / 25.4)
    with pytest.raises(
        DataError, match=r"the unit `mm`, but with the unit `in` the points are closer"
    ):
        examine(robot, sheet, export)


@pytest.mark.slow
def test_mirrored_axes_are_refused_with_the_export(robot, sheet, points, tmp_path) -> None:
    mirrored = [(name, xyz * [1.0, -1.0, 1.0]) for name, xyz in points]
    data = fill(robot, sheet, write_spatial_analyzer(tmp_path / "left.txt", mirrored)).data
    with pytest.raises(DataError, match=r"left\.txt: .* opposite sign") as refused:
        check_conventions(robot, data)
    assert "sheet.csv" not in str(refused.value)


def test_swapped_poses_and_targets_are_refused_by_name(robot, sheet, points, tmp_path) -> None:
    names = {f"{a}_{t}": f"{b}_{t}" for a, b in ((4, 9), (9, 4)) for t in TARGETS}
    path = write_spatial_analyzer(tmp_path / "e.txt", rename(points, names))
    with pytest.raises(DataError, match=r"6 points .* wrong names: 4_SMR1 lies at 9_SMR1, "):
        examine(robot, sheet, path)
    swapped = rename(points, {"2_SMR2": "2_SMR3", "2_SMR3": "2_SMR2"})
    path = write_spatial_analyzer(tmp_path / "f.txt", swapped)
    with pytest.raises(DataError, match=r"2 points .*: 2_SMR2 lies at 2_SMR3, 2_SMR3 lies at 2_S"):
        examine(robot, sheet, path)


@pytest.mark.parametrize(("shift", "words"), [(1, "too early.* next pose"), (-1, "too late")])
def test_shifted_names_are_refused(shift, words, robot, sheet, points, tmp_path) -> None:
    places = [xyz for _, xyz in points]
    kept = points[: -3 * shift] if shift > 0 else points[3:]
    moved = places[3:] if shift > 0 else places[:-3]
    late = [(name, xyz) for (name, _), xyz in zip(kept, moved, strict=True)]
    with pytest.raises(DataError, match=words):
        examine(robot, sheet, write_spatial_analyzer(tmp_path / "e.txt", late))


@pytest.mark.parametrize(("first", "shift", "words"), [(4, -1, "early"), (9, 1, "late")])
def test_names_shifted_from_a_pose_on_are_refused(
    first, shift, words, robot, sheet, points, tmp_path
) -> None:
    """A pose was left out, or its number was used twice, and the numbers went on."""
    named = dict(points)
    labels = list(dict.fromkeys(name.split("_")[0] for name in named))
    shifted = []
    for i, label in enumerate(labels):
        place = i - shift * (i >= first)
        if place < N:
            shifted += [(f"{label}_{t}", named[f"{labels[place]}_{t}"]) for t in TARGETS]
    path = write_spatial_analyzer(tmp_path / "e.txt", shifted)
    with pytest.raises(DataError, match=f"from pose {labels[first]} on, .* one pose too {words}"):
        examine(robot, sheet, path)


def test_a_point_far_from_its_place_is_reported(robot, sheet, points, tmp_path) -> None:
    far = [(name, xyz + 20.0 * (name == "4_SMR2")) for name, xyz in points]
    (found,) = examine(robot, sheet, write_spatial_analyzer(tmp_path / "e.txt", far))
    assert found.code == "sheet.points-far"
    assert "4_SMR2 by 34.6 mm" in str(found)


def test_points_at_poses_that_the_robot_does_not_reach_are_not_examined(
    robot, sheet, points, tmp_path
) -> None:
    data = fill(robot, sheet, write_spatial_analyzer(tmp_path / "e.txt", points)).data
    away = replace(data, readings=data.readings + 1e3 * np.arange(1.0, 7.0))  # [m]
    assert examine_points(robot, away, "mm") == ()


def test_moved_tracker_is_refused_and_two_files_are_two_sessions(
    robot, sheet, points, tmp_path
) -> None:
    moved = [
        (name, xyz + np.array([3.0, 2.0, -1.0]) * (i >= 21)) for i, (name, xyz) in enumerate(points)
    ]
    whole = write_spatial_analyzer(tmp_path / "all.txt", moved)
    with pytest.raises(DataError, match="up to pose 7 and from pose 8 fit two positions"):
        examine(robot, sheet, whole)
    days = [
        write_spatial_analyzer(tmp_path / f"{day}.txt", some)
        for day, some in (("monday", moved[:21]), ("tuesday", moved[21:]))
    ]
    with pytest.raises(DataError, match="two positions"):
        examine(robot, sheet, *days, has_one_session=True)
    save_converted(fill(robot, sheet, *days).text, tmp_path / "measured.csv")
    rows = load_measurements(tmp_path / "measured.csv", robot).observations[0]
    assert rows.session.tolist() == ["monday"] * 7 + ["tuesday"] * 7


def test_small_move_of_the_tracker_is_reported(robot, sheet, points, tmp_path) -> None:
    """It is not far beyond the errors of the robot, but two positions fit much better."""
    moved = [
        (name, xyz + np.array([0.2, 0.1, -0.1]) * (i >= 21)) for i, (name, xyz) in enumerate(points)
    ]
    (found,) = examine(robot, sheet, write_spatial_analyzer(tmp_path / "e.txt", moved))
    assert found.code == "sheet.instrument-perhaps-moved"
    assert "up to pose 7 and from pose 8" in str(found)
    assert examine(robot, sheet, write_spatial_analyzer(tmp_path / "f.txt", points)) == ()


def test_points_without_matching_names_are_filled_by_order_or_refused(
    robot, sheet, points, tmp_path
) -> None:
    anonymous = [(f"A{i}", xyz) for i, (_, xyz) in enumerate(points)]
    path = write_spatial_analyzer(tmp_path / "e.txt", anonymous)
    with pytest.raises(FileError, match="first one: it names the pose 'A0', but no target"):
        fill(robot, sheet, path)
    wrong = [(f"A{name}", xyz) for name, xyz in points]
    with pytest.raises(FileError, match="no point of the export has the name of a pose"):
        fill(robot, sheet, write_spatial_analyzer(tmp_path / "f.txt", wrong))
    by_name = fill(robot, sheet, write_spatial_analyzer(tmp_path / "g.txt", points))
    assert fill(robot, sheet, path, by_order=True).text == by_name.text
    write_spatial_analyzer(path, anonymous[:-1])
    with pytest.raises(FileError, match=r"needs 42 points \(14 poses, 3 targets\).* has 41"):
        fill(robot, sheet, path, by_order=True)


def test_one_target_needs_no_name_of_a_target(robot, simulated, points, tmp_path) -> None:
    kind = Position(targets=("SMR",), unknown=("frame", "targets")).with_tool(robot.tool)
    one = Instrument((Sensor(kind, Gaussian(np.full(3, 15e-6))),))
    sheet = tmp_path / "sheet.csv"
    sheet.write_text(format_data_sheet(robot, one, simulated.readings, simulated.labels))
    single = [(name.split("_")[0], xyz) for name, xyz in points if name.endswith("SMR2")]
    filled = fill(robot, sheet, write_spatial_analyzer(tmp_path / "e.txt", single))
    assert list_codes(filled) == ["sheet.filled"]
    assert tabulate(filled)[0][-3:] == ["x [mm]", "y [mm]", "z [mm]"]


def test_filled_sheet_is_refused(robot, sheet, points, tmp_path) -> None:
    path = write_spatial_analyzer(tmp_path / "e.txt", points)
    save_converted(fill(robot, sheet, path).text, tmp_path / "measured.csv")
    with pytest.raises(FileError, match="this sheet already has measured values"):
        fill(robot, tmp_path / "measured.csv", path)


def test_a_sheet_of_several_corners_for_a_pose_is_not_called_filled(robot, tmp_path) -> None:
    settings = "kind: image", "corners: [3, 3]", "square: 20 mm", "size: [800, 600]"
    names = [f"{a.name} [mm]" for a in robot.actuators]
    lines = [f"# {line}" for line in (*settings, "unknown: [camera, board, focal, center]")]
    lines += [",".join(["pose", *names, "corner", "u [px]", "v [px]"])]
    lines += [",".join(["1", *["0"] * 6, str(corner), "", ""]) for corner in range(2)]
    (tmp_path / "sheet.csv").write_text("\n".join(lines) + "\n", "utf-8")
    with expect_refusal("sheet.kinds", FileError):
        read_sheet(tmp_path / "sheet.csv", robot)


def test_command_prints_what_is_filled_in_and_what_is_not(
    robot, sheet, points, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    write_spatial_analyzer(tmp_path / "points.txt", [*points[3:], ("floor", points[0][1])])
    words = "fill hexapod-42 sheet.csv points.txt --profile spatial-analyzer -o measured.csv"
    assert main(words.split()) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "measured.csv: wrote 39 points at 13 of 14 poses" in said
    assert "or check their names: 1_SMR1, 1_SMR2 and 1_SMR3" in said
    assert "points.txt:44 does not match: it names the pose 'floor', but no target" in said
    assert main([*words.split(), "--force", "--profile", "leicca"]) == 1
    assert "faro, leica, spatial-analyzer and wide" in capsys.readouterr().err


def test_import_takes_a_shipped_profile_and_a_unit(points, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    write_spatial_analyzer(tmp_path / "points.txt", points)
    words = "import points.txt --profile spatial-analyzer --unit in -o measured.csv"
    assert main(words.split()) == 0
    text = (tmp_path / "measured.csv").read_text()
    assert "SMR1.x [in]" in text
    assert len(list(csv.reader(line for line in text.splitlines() if line[0] != "#"))) == N + 1
    assert main(["import", "a.hal", "--unit", "mm", "--decimal", "comma", "-o", "r.yaml"]) == 1
    assert "--decimal has no effect without --profile" in capsys.readouterr().err
