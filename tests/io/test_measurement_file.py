# SPDX-License-Identifier: Apache-2.0
"""Measurement files of every kind are read as saved; errors are reported with their line."""

import numpy as np
import pytest

from loopcal.errors import DataError, LoopcalError
from loopcal.io.data.kind_settings import list_kind_settings
from loopcal.io.data.measurement_file import (
    format_template,
    load_measurements,
    load_poses,
    save_measurements,
)
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds import KINDS
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.simulation import simulate
from loopcal.mechanism.solutions import inverse

EXAMPLES = [kind for cls in KINDS.values() for kind in cls.examples() if kind.columns]
IDS = [f"{kind.name}-{i}" for i, kind in enumerate(EXAMPLES)]


@pytest.fixture(scope="module")
def poses():
    generator = np.random.default_rng(5)
    low, high = np.array([-20, -20, 185, -8, -8, -8]), np.array([20, 20, 215, 8, 8, 8])
    return generator.uniform(low, high, (6, 6)) * np.repeat([1e-3, np.pi / 180], 3)


def build_sensor(kind) -> Sensor:
    return Sensor(kind, Gaussian(np.linspace(1e-6, 2e-6, len(kind.noise_columns))))


def assert_same(data, again) -> None:
    np.testing.assert_allclose(
        again.readings, data.readings, rtol=1e-15, atol=0
    )  # one rounding in and out of the unit
    assert again.block.tolist() == data.block.tolist()
    assert again.labels == data.labels
    for old, new in zip(data.observations, again.observations, strict=True):
        assert (old.kind.name, old.kind.columns) == (new.kind.name, new.kind.columns)
        assert old.rows.tolist() == new.rows.tolist()
        np.testing.assert_allclose(new.measured, old.measured, rtol=1e-15, atol=0)
        scale = np.sqrt(np.einsum("rii,rjj->rij", old.covariance, old.covariance))
        np.testing.assert_allclose(
            new.covariance / scale, old.covariance / scale, atol=1e-9
        )  # the writer's EQUAL


def make_measurements(robot, poses, kind) -> Measurements:
    """Return rows of a kind with values that it accepts, one for each pose or pair of neighbors."""
    generator = np.random.default_rng(11)
    links = np.arange(len(poses) - kind.poses_per_row + 1)[:, None] + np.arange(kind.poses_per_row)
    values = generator.uniform(0.1, 0.2, (len(links), len(kind.columns)))
    for names in (("qw", "qx", "qy", "qz"), ("i", "j", "k")):
        places = [i for i, column in enumerate(kind.columns) if column.name in names]
        if places:
            values[:, places] /= np.linalg.norm(values[:, places], axis=1, keepdims=True)
    values[:, : kind.label_count] = kind.list_labels(len(values))
    seen = links if kind.poses_per_row > 1 else links[:, 0]
    sigma = np.linspace(1e-6, 2e-6, len(kind.noise_columns))
    rows = Observations.from_sigma(kind.with_tool(robot.tool), seen, values, sigma)
    return Measurements(robot.name, inverse(robot, poses).q, (rows,))


@pytest.mark.slow
@pytest.mark.parametrize("kind", EXAMPLES, ids=IDS)
def test_measurements_of_every_kind_are_read_as_saved(tmp_path, robot, poses, kind) -> None:
    data = make_measurements(robot, poses, kind)
    save_measurements(data, tmp_path / "data.csv", robot, "a test")
    loaded = load_measurements(tmp_path / "data.csv", robot)
    assert_same(data, loaded)
    for field in list_kind_settings(type(kind)):
        old, new = (getattr(d.observations[0].kind, field) for d in (data, loaded))
        same = (
            old == new
            if isinstance(old, (str, tuple, type(None)))
            else np.allclose(old, new, rtol=1e-15, atol=1e-15)
        )
        assert same, field


def test_several_kinds_in_one_file_are_read_as_saved(tmp_path, robot, poses) -> None:
    instrument = Instrument(
        (
            build_sensor(Component(("z",))),
            build_sensor(Pose("quaternion")),
            build_sensor(Component(("x", "z"))),
        )
    )
    data = simulate(robot, poses, instrument, seed=1)
    save_measurements(data, tmp_path / "data.csv", robot)
    assert_same(data, load_measurements(tmp_path / "data.csv", robot))


def test_frame_tool_repeats_gaps_and_correlated_noise_are_read_as_saved(
    tmp_path, robot, poses
) -> None:
    frame = np.array([[0, -1, 0, 0.1], [1, 0, 0, -0.2], [0, 0, 1, 0.03], [0, 0, 0, 1.0]])
    kind = Pose("euler-ZYX", T_base_frame=frame, T_platform_tool=np.linalg.inv(frame))
    data = simulate(robot, poses, Instrument((Sensor(kind, Gaussian(np.full(6, 1e-6))),)), seed=1)
    rows = data.observations[0]
    root = np.random.default_rng(7).normal(size=(6, 6, 6)) * 1e-6
    covariance = root @ np.swapaxes(root, 1, 2) + np.eye(6) * 1e-12
    measured = rows.measured.copy()
    measured[2, 4] = np.nan
    again = np.concatenate([rows.rows, [3]])
    repeated = np.concatenate([measured, measured[3:4] + 1e-7])
    several = Observations(rows.kind, again, repeated, np.concatenate([covariance, covariance[:1]]))
    data = type(data)(
        robot.name, data.readings, (several,), np.array([0, 0, 1, 1, 2, 3]), tuple("abcdef")
    )
    save_measurements(data, tmp_path / "data.csv", robot)
    loaded = load_measurements(tmp_path / "data.csv", robot)
    assert_same(data, loaded)
    assert loaded.observations[0].present.tolist() == several.present.tolist()
    read = loaded.observations[0].kind
    assert isinstance(read, Pose)
    np.testing.assert_allclose(read.T_base_frame, frame, atol=1e-15)
    assert read.T_platform_tool is not None
    np.testing.assert_allclose(read.T_platform_tool, np.linalg.inv(frame), atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("kind", EXAMPLES, ids=IDS)
def test_template_lacks_only_rows(tmp_path, robot, poses, kind) -> None:
    path = tmp_path / "data.csv"
    instrument = Instrument(
        (
            Sensor(
                kind.with_tool(robot.tool),
                Gaussian(np.linspace(1e-6, 2e-6, len(kind.noise_columns))),
            ),
        )
    )
    path.write_text(format_template(robot, instrument))
    with pytest.raises(LoopcalError, match="a header but no rows"):
        load_measurements(path, robot)
    save_measurements(make_measurements(robot, poses, kind), tmp_path / "full.csv", robot)
    full, template = (tmp_path / "full.csv").read_text(), path.read_text()
    head = template[: template.index("\n# Add one row") + 1]
    assert full.startswith(head)
    assert "session, group" in template[len(head) :]
    assert full.count("\n") == head.count("\n") + 6 + (5 if kind.poses_per_row > 1 else 0)
    (tmp_path / "filled.csv").write_text(template + full[len(head) :])
    assert_same(*(load_measurements(tmp_path / name, robot) for name in ("full.csv", "filled.csv")))


HEADER = "pose,q1 [mm],q2 [mm],q3 [mm],q4 [mm],q5 [mm],q6 [mm],z [mm]"
GOOD = f"""# kind: component
# components: [z]
# noise: {{z: 1 um}}
{HEADER}
a,0,0,0,0,0,0,200
b,1,1,1,1,1,1,201.1
"""


def write(folder, text: str):
    path = folder / "data.csv"
    path.write_text(text)
    return path


def test_commanded_coordinates_are_converted_by_the_controller(tmp_path, robot) -> None:
    names = "commanded.x [mm],commanded.y [mm],commanded.z [mm],commanded.roll [deg],commanded.pitch [deg],commanded.yaw [deg]"  # noqa: E501
    text = GOOD.replace(HEADER, f"pose,{names},z [mm]").replace("a,0,0,0,0,0,0", "a,0,0,200,0,0,0")
    text = text.replace("b,1,1,1,1,1,1", "b,0,0,200,0,0,5")
    data = load_measurements(write(tmp_path, text), robot.with_values(robot.values + 1e-3))
    np.testing.assert_allclose(
        data.readings[0], 0, atol=1e-8
    )  # [m]: the file's numbers have eight digits
    controller = robot.record.text.replace("lengths: 233.238076", "lengths: 223.238076")
    (tmp_path / "controller.yaml").write_text(controller)
    data = load_measurements(write(tmp_path, "# controller: controller.yaml\n" + text), robot)
    np.testing.assert_allclose(data.readings[0], 0.01, atol=1e-8)  # [m]


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        (
            "# kind: component\n",
            "",
            None,
            "the kind of measurement is missing; write '# kind: pose'",
        ),
        (
            "component\n",
            "komponent\n",
            1,
            "'komponent' is not a kind of measurement .did you mean 'component'",
        ),
        ("[z]", "[q]", 2, "component 'q' does not exist"),
        ("[z]", "[3]", 2, "'components entry 1' is the number 3"),
        ("# components", "# componets", 2, "unknown key 'componets' .did you mean 'components'"),
        ("1 um", "1", 3, "'noise.z': '1' has no unit. Add one of m, mm, um"),
        ("1 um", "1 urad", 3, "'noise.z': 'urad' is a unit of angle"),
        ("1 um", "-1 um", 3, "the noise of 'z' is -1 um"),
        ("z: 1 um", "zz: 1 um", 3, "unknown key 'zz' in 'noise'"),
        ("# noise: {z: 1 um}\n", "", None, "the noise of 'z' is missing"),
        ("# kind", "# format: 9\n# kind", 1, "has format 9"),
        ("z [mm]", "z", 4, "column 'z' has no unit"),
        ("z [mm]", "zz [mm]", 4, "column 'zz' is unknown .did you mean 'z'"),
        ("q3 [mm]", "note [mm]", 4, "no column 'q3'.*the reading of an actuator of hexapod-42"),
        ("z [mm]", "commanded.z [mm]", 4, "has readings .'q1'. and commanded coordinates"),
        ("b,1,", "a,1,", 6, "pose 'a' has other readings in line 5"),
        ("b,1,", ",1,", 6, "column 'pose' is empty"),
        ("b,1,", "b,,", 6, "column 'q1' is empty"),
        ("201.1", "201,1", 6, "this row has 9 cells, but the header has 8 columns"),
        ("201.1", "nan", 6, "column 'z' is 'nan', which is not finite"),
    ],
)
def test_invalid_file_is_refused_in_one_sentence_with_its_line(
    tmp_path, robot, old, new, line, message
) -> None:
    path = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(LoopcalError, match=message) as caught:
        load_measurements(path, robot)
    assert str(caught.value).startswith(f"{path}:{line}: " if line else f"{path}: ")
    assert "\n" not in str(caught.value)


def test_readings_outside_the_stroke_and_duplicates_are_refused_by_default(tmp_path, robot) -> None:
    path = write(tmp_path, GOOD.replace("b,1,", "b,90,"))
    with pytest.raises(
        DataError, match=r"pose 'b' \(.*data.csv:6\): q1 reads 90 mm, 15 mm outside"
    ):
        load_measurements(path, robot)
    assert load_measurements(path, robot, allow_outside_stroke=True).n_poses == 2
    digits = "0,0,0,0,0,0,200.0012345"
    path = write(tmp_path, f"{GOOD.replace('0,0,0,0,0,0,200', digits)}c,{digits}\n")
    with pytest.raises(DataError, match=r"'a' and 'c' \(.*:5 and .*:7\) have equal"):
        load_measurements(path, robot)
    assert load_measurements(path, robot, allow_duplicates=True).n_poses == 3


def test_sigma_columns_override_the_noise_of_the_settings(tmp_path, robot) -> None:
    text = (
        GOOD.replace("z [mm]", "z [mm],sigma.z [um]")
        .replace("200\n", "200,\n")
        .replace("201.1", "201.1,3")
    )
    data = load_measurements(write(tmp_path, text), robot)
    np.testing.assert_allclose(
        np.sqrt(data.observations[0].covariance[:, 0, 0]), [1e-6, 3e-6], rtol=1e-15
    )


def test_poses_are_read_in_the_order_of_the_robots_coordinates(tmp_path, robot) -> None:
    path = write(tmp_path, "yaw [deg],x [mm],y [mm],z [mm],roll [deg],pitch [deg]\n180,1,2,3,0,0\n")
    np.testing.assert_allclose(
        load_poses(path, robot), [[1e-3, 2e-3, 3e-3, 0, 0, np.pi]], rtol=1e-15
    )


def test_last_matching_noise_pattern_applies_to_a_column(tmp_path, robot) -> None:
    text = (
        GOOD.replace("[z]", "[z, x]")
        .replace("z: 1 um", '"*": 2 um, z: 1 um')
        .replace("z [mm]", "z [mm],x [mm]")
    )
    data = load_measurements(
        write(tmp_path, text.replace("200\n", "200,0\n").replace("201.1\n", "201.1,0\n")), robot
    )
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(data.observations[0].covariance[0])), [1e-6, 2e-6], rtol=1e-15
    )
    with pytest.raises(LoopcalError, match=r"data.csv:3: unknown key 'y\*' in 'noise'"):
        load_measurements(write(tmp_path, GOOD.replace("z: 1 um", '"y*": 1 um')), robot)


def test_a_noise_of_a_column_of_every_target_is_answered_by_its_pattern(tmp_path, robot) -> None:
    text = GOOD.replace("kind: component", "kind: position\n# targets: [a, b]")
    text = "\n".join(line for line in text.splitlines() if "components" not in line) + "\n"
    with pytest.raises(LoopcalError, match=r"unknown key 'x' in 'noise'.* \*\.x, a\.x"):
        load_measurements(write(tmp_path, text.replace("z: 1 um", "x: 1 um")), robot)
