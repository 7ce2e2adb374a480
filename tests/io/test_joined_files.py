# SPDX-License-Identifier: Apache-2.0
"""Several measurement files are joined by the names of poses.

Each file has its own units, settings and noise.
"""

import numpy as np
import pytest

from loopcal.errors import LoopcalError
from loopcal.io.data.measurement_file import (
    list_measurement_files,
    load_measurements,
    save_measurements,
)
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.directions import Inclination
from loopcal.measure.kinds.poses import Component
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import simulate

Q = ",".join(f"q{i} [mm]" for i in range(1, 7))
POSES = f'pose,{Q}\na,0,0,0,0,0,0\nb,1,1,1,1,1,1\n"c, ""third"" #1",2,2,2,2,2,2\nλ1,3,3,3,3,3,3\n'
HEIGHTS = """# kind: component
# components: [z]
# noise: {z: 1 um}
pose,z [um]
b,201100
a,200000
"c, ""third"" #1",202200
λ1,203300
"""
TILTS = f"""# kind: inclination
# noise: {{tilt_x: 5 urad, tilt_y: 5 urad}}
pose,{Q.replace("mm", "m")},tilt_x [arcsec],tilt_y [mrad]
b,.001,.001,.001,.001,.001,.001,10,0.1
d,.004,.004,.004,.004,.004,.004,20,0.2
"""


def test_table_of_poses_and_files_of_two_instruments_are_joined(write_files, robot) -> None:
    data = load_measurements(write_files(poses=POSES, heights=HEIGHTS, tilts=TILTS), robot)
    assert data.labels == ("a", "b", 'c, "third" #1', "λ1", "d")
    np.testing.assert_array_equal(data.readings[:, 0], [0.0, 0.001, 0.002, 0.003, 0.004])
    heights, tilts = data.observations
    assert heights.rows.tolist() == [1, 0, 2, 3]
    np.testing.assert_array_equal(heights.measured[:, 0], [0.2011, 0.2, 0.2022, 0.2033])
    assert tilts.rows.tolist() == [1, 4]
    np.testing.assert_allclose(
        tilts.measured[:, 0], np.array([10, 20]) * np.pi / 648000, rtol=1e-15
    )
    np.testing.assert_array_equal(tilts.measured[:, 1], [1e-4, 2e-4])


def test_order_of_files_changes_only_the_order_of_poses(write_files, robot) -> None:
    paths = write_files(poses=POSES, heights=HEIGHTS, tilts=TILTS)
    one, other = (load_measurements(order, robot) for order in (paths, paths[::-1]))
    assert sorted(one.labels) == sorted(other.labels)
    for a, b in zip(one.observations, other.observations[::-1], strict=True):
        assert [one.labels[i] for i in a.rows] == [other.labels[i] for i in b.rows]
        np.testing.assert_array_equal(a.measured, b.measured)
        np.testing.assert_array_equal(one.readings[a.rows], other.readings[b.rows])


def test_file_names_its_table_of_poses(write_files, robot) -> None:
    _, heights = write_files(poses=POSES, heights="# poses: poses.csv\n" + HEIGHTS)
    assert load_measurements(heights, robot).n_poses == 4
    assert list(list_measurement_files(heights)) == ["data", "poses"]


def test_commanded_poses_are_read_from_another_file_in_other_units(write_files, robot) -> None:
    names = [
        f"commanded.{name}"
        for name in ("x [mm]", "y [mm]", "z [m]", "roll [deg]", "pitch [deg]", "yaw [mrad]")
    ]
    poses = f"pose,{','.join(names)}\na,0,0,0.2,0,0,0\nb,0,0,0.2011,0,0,0\n"
    again = poses.replace("z [m]", "z [mm]").replace("0.2011", "201.1").replace("0.2,", "200,")
    heights = HEIGHTS.split('"c', maxsplit=1)[0]
    data = load_measurements(write_files(poses=poses, heights=heights, again=again), robot)
    assert data.labels == ("a", "b")
    np.testing.assert_allclose(
        data.readings[0], 0, atol=1e-8
    )  # [m]: the robot file's numbers have eight digits
    with pytest.raises(
        LoopcalError, match=r"again.csv:3: pose 'b' has other readings here than in .*poses.csv:3"
    ):
        load_measurements(
            write_files(poses=poses, heights=heights, again=again.replace("201.1", "201.2")), robot
        )


def test_rows_that_compare_poses_are_read_from_another_file(write_files, robot) -> None:
    lengths = (
        "# kind: separation\n# noise: {separation: 2 um}\npose,separation [mm]\na;b,1.2\nb;λ1,2.4\n"
    )
    data = load_measurements(write_files(poses=POSES, lengths=lengths), robot)
    assert data.observations[0].rows.tolist() == [[0, 1], [1, 3]]


def test_two_files_of_two_instruments_equal_one_file(tmp_path, robot) -> None:
    poses = np.random.default_rng(3).uniform([-20, -20, 190], [20, 20, 210], (5, 3)) * 1e-3
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, 3] = poses
    sensors = (
        Sensor(Component(("z",)), Gaussian(np.array([1e-6]))),
        Sensor(Inclination(), Gaussian(np.full(2, 5e-6))),
    )
    data = simulate(robot, T, Instrument(sensors), seed=2)
    for i, rows in enumerate(data.observations):
        save_measurements(
            Measurements(robot.name, data.readings, (rows,)), tmp_path / f"{i}.csv", robot
        )
    save_measurements(data, tmp_path / "both.csv", robot)
    one, two = (
        load_measurements(p, robot)
        for p in (tmp_path / "both.csv", [tmp_path / "0.csv", tmp_path / "1.csv"])
    )
    np.testing.assert_array_equal(one.readings, two.readings)
    for a, b, original in zip(one.observations, two.observations, data.observations, strict=True):
        np.testing.assert_array_equal(a.measured, b.measured)
        np.testing.assert_array_equal(a.measured, original.measured)
        np.testing.assert_array_equal(a.covariance, b.covariance)


SPLIT = """# session: {}
# kind: component
# components: [z]
# unknown: [frame]
# frame: tracker
# noise: {{z: 1 um}}
pose,z [mm]
"""
IN_BLOCKS = {
    "poses": POSES.replace("pose,", "block,pose,").replace("\n", "\n1,", 4),
    "tilts": TILTS.replace("pose,", "block,pose,")
    .replace("\nb,", "\n2,b,")
    .replace("\nd", "\n2,d"),
}
NO_POSES = {"heights": "# poses: p.csv\n" + HEIGHTS}
REFUSED = {
    "other readings": (
        {"poses": POSES, "tilts": TILTS.replace("b,.001", "b,.0011")},
        (r"tilts.csv:4: pose 'b' has other readings here than in .*poses.csv:3"),
    ),
    "no readings of a pose": ({"poses": POSES, "heights": HEIGHTS.replace("λ1", "e")}, (r"heights.csv:8: "  # noqa: E501
                                                                                  r"unknown pose "
                                                                                  r"'e'")),
    "no names": ({"poses": POSES, "heights": HEIGHTS.replace("pose,z", "note,z")}, ("this file "
                                                                                   "has none")),
    "no kind at all": ({"poses": POSES, "more": POSES.replace("a,0", "f,0")}, ("no file has a "
                                                                              "kind")),
    "no kind for measured columns": (
        {"poses": POSES, "heights": HEIGHTS.replace("# kind: component\n# components: [z]\n# "
                                                    "noise: {z: 1 um}\n", "")},
        (r"heights.csv:1: column 'z' is unknown.*has no kind"),
    ),
    "settings of a kind in a table of poses": (
        {"poses": "# noise: {z: 1 um}\n" + POSES, "heights": HEIGHTS},
        r"poses.csv:1: unknown key 'noise'",
    ),
    "the unit of a reading": (
        {"poses": POSES.replace("q3 [mm]", "q3 [deg]"), "heights": HEIGHTS},
        r"poses.csv:1: column 'q3': 'deg' is a unit of angle, not of a length",
    ),
    "another unit of readings by mistake": (
        {"poses": POSES, "tilts": TILTS.replace(" [m]", " [mm]")},
        r"tilts.csv:4: pose 'b' has other readings here than in",
    ),
    "an empty cell of the readings": (
        {"poses": POSES.replace("b,1,", "b,,"), "heights": HEIGHTS},
        ("poses.csv:3: column 'q1' is empty. Write its value, or give 'reading_noise'"),
    ),
    "another block": (IN_BLOCKS, (r"tilts.csv:4: pose 'b' is in block '2' here and '1' in "
                                  r".*poses.csv:3")),
    "other noise of readings": (
        {"poses": "# reading_noise: 5 um\n" + POSES, "tilts": "# reading_noise: 6 um\n" + TILTS},
        r"tilts.csv:5: pose 'b' has other sigma here than in .*poses.csv:4",
    ),
    "an empty file": ({"poses": POSES, "heights": "\n"}, ("heights.csv: this measurement file is "
                                                         "empty")),
    "a header alone": ({"poses": POSES, "heights": HEIGHTS[: HEIGHTS.index("b,")]}, "heights.csv:4: .* a header but no rows"),  # noqa: E501
    "a missing table of poses": (NO_POSES, (r"heights.csv:1: 'poses' names .*p.csv")),
    "a frame stated twice": (
        {"poses": POSES,
         "mo": SPLIT.format("x").replace("# frame", "# unknowns: {x.tracker.x: fixed}\n# frame") + "a,200\nb,201\n",  # noqa: E501
         "tu": SPLIT.format("x").replace("# frame", "# unknowns: {x.tracker.x: {sd: 1 mm}}\n# frame") + "λ1,203.3\n"},  # noqa: E501
        r"tu.csv:5: parameter 'x.tracker.x' differs from .*mo.csv:5",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_inconsistent_files_are_refused_with_their_lines(write_files, robot, case) -> None:
    texts, message = REFUSED[case]
    with pytest.raises(LoopcalError, match=message) as caught:
        load_measurements(write_files(**texts), robot)
    assert "\n" not in str(caught.value)


def test_file_given_twice_is_refused(write_files, robot) -> None:
    (path,) = write_files(data=HEIGHTS)
    with pytest.raises(LoopcalError, match="this file occurs twice"):
        load_measurements([path, path.parent / "." / path.name], robot)
    with pytest.raises(LoopcalError, match="the list of measurement files is empty"):
        load_measurements([], robot)


def test_names_are_joined_in_any_unicode_form_and_line_end(write_files, robot) -> None:
    poses, heights = write_files(poses=POSES.replace("λ1", "é"), heights=HEIGHTS)
    heights.write_bytes(
        b"\xef\xbb\xbf" + HEIGHTS.replace("λ1", "e\u0301").replace("\n", "\r\n").encode()
    )
    data = load_measurements([poses, heights], robot)
    assert data.labels[-1] == "é"
    assert data.observations[0].rows.tolist() == [1, 0, 2, 3]


def test_setting_session_applies_to_the_whole_file(write_files, robot) -> None:
    monday, tuesday = (
        SPLIT.format("monday") + "a,200\nb,201\n",
        SPLIT.format("tuesday") + "λ1,203\n",
    )
    data = load_measurements(write_files(poses=POSES, mo=monday, tu=tuesday), robot)
    assert [set(rows.session.tolist()) for rows in data.observations] == [{"monday"}, {"tuesday"}]
    assert {name.split(".")[0] for name in data.nuisance_parameters.table.names} == {
        "monday",
        "tuesday",
    }
    assert isinstance(data.observations[0], Observations)
