# SPDX-License-Identifier: Apache-2.0
"""Columns of measurement files are read exactly as saved.

Sessions, groups, stated unknowns, noise of readings, times and temperatures.
"""

import numpy as np
import pytest

from loopcal.errors import DataError, LoopcalError
from loopcal.io.data.measurement_file import format_data_sheet, load_measurements, save_measurements
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Component
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.nuisance import StatedValue
from loopcal.measure.observations import Observations

LABELS = ("a", "b,1", 'say "c"', "#d", "λ")
UNKNOWNS = (
    '{monday.tracker.x: {start: 12 mm, sd: 1 mm}, "*.tracker.r?": {sd: 2 mrad}, ball.x: fixed}'
)
HEADER = ",".join(["pose,session"] + [f"q{i} [mm]" for i in range(1, 7)] + ["x [mm],y [mm],z [mm]"])
TEXT = f"""# kind: position
# targets: [ball]
# unknown: [frame, targets]
# frame: tracker
# noise: {{x: 5 um, y: 5 um, z: 5 um}}
# unknowns: {UNKNOWNS}
{HEADER}
a,monday,0,0,0,0,0,0,1,2,200
b,monday,1,1,1,1,1,1,1,2,201
c,tuesday,2,2,2,2,2,2,1,2,202
"""


def write(folder, text: str):
    path = folder / "data.csv"
    path.write_text(text)
    return path


def draw_measurements(robot, seed: int) -> Measurements:
    """Return measurements with everything that a file can contain; numbers use all bits."""
    draw = np.random.default_rng(seed)
    tracker = Position(targets=("ball",), unknown=("frame", "targets"), frame="tracker").with_tool(
        robot.tool
    )
    height = Component(("z",)).with_tool(robot.tool)
    days = np.array(["monday", "monday", "tuesday", "day, 3", ""])
    first = Observations.from_sigma(
        tracker, np.arange(5), draw.normal(size=(5, 3)), 5e-6, session=days
    )
    second = Observations.from_sigma(
        height, np.arange(4), draw.normal(size=(4, 1)), 1e-6, group=np.array(list("xxyy"))
    )
    time = np.array([1.7e9 + 1 / 3, np.nan, *draw.uniform(0, 1e5, 3)])
    first = Observations(first.kind, first.rows, first.measured, first.covariance, session=first.session,  # noqa: E501
                         context={"time": time, "temperature.frame": 20 + draw.normal(size=5)})  # fmt: skip  # noqa: E501
    readings, sigma = (
        draw.uniform(-0.05, 0.05, (5, 6)),
        np.tile([0.0, 5e-6, 0.0, 0.0, 1e-5 / 3, 0.0], (5, 1)),
    )
    sigma[:, 2] = draw.uniform(1e-6, 2e-6, 5)
    sigma[1, 3] = sigma[2, 5] = sigma[2, 3] = np.inf
    readings[1, 3] = np.nan
    known = (
        StatedValue("monday.tracker.x", 1e-3 / 3, 0.1 + 0.2),
        StatedValue("tuesday.tracker.rz"),
        StatedValue("ball.y", 0.0, 1 / 7),
    )
    return Measurements(
        robot.name,
        readings,
        (first, second),
        labels=LABELS,
        reading_sigma=sigma,
        stated_values=known,
    )


@pytest.mark.parametrize("seed", range(5))
def test_every_column_is_read_exactly_as_saved(tmp_path, robot, seed) -> None:
    data = draw_measurements(robot, seed)
    save_measurements(data, tmp_path / "data.csv", robot)
    again = load_measurements(tmp_path / "data.csv", robot)
    assert again.labels == data.labels
    assert again.stated_values == data.stated_values
    np.testing.assert_array_equal(again.readings, data.readings)
    assert again.reading_sigma is not None
    np.testing.assert_array_equal(again.reading_sigma, data.reading_sigma)
    for old, new in zip(data.observations, again.observations, strict=True):
        np.testing.assert_array_equal(new.measured, old.measured)
        assert new.session.tolist() == old.session.tolist()
        assert new.group.tolist() == old.group.tolist()
        assert list(new.context) == list(old.context)
        for name, values in old.context.items():
            np.testing.assert_array_equal(new.context[name], values)
    save_measurements(again, tmp_path / "again.csv", robot)
    assert (tmp_path / "again.csv").read_text() == (tmp_path / "data.csv").read_text()


def test_stated_unknowns_match_patterns_and_are_kept_in_subsets(tmp_path, robot) -> None:
    data = load_measurements(write(tmp_path, TEXT), robot)
    table = data.take([0, 1]).nuisance_parameters.table
    entry = {e.name: e for e in table.entries}
    assert (entry["monday.tracker.x"].nominal, entry["monday.tracker.x"].tolerance) == (
        0.012,
        0.001,
    )
    assert entry["monday.tracker.rx"].tolerance == 0.002
    assert entry["monday.tracker.y"].tolerance is None
    assert not entry["monday.ball.x"].free
    assert "tuesday.tracker.rx" not in entry
    assert {e.name: e for e in data.nuisance_parameters.table.entries}[
        "tuesday.tracker.rz"
    ].tolerance == 0.002


READINGS = """# kind: component
# components: [z]
# noise: {z: 1 um}
# reading_noise: {q1: 5 um, q2: 0 mm}
pose,q1 [mm],q2 [mm],q3 [mm],q4 [mm],q5 [mm],q6 [mm],sigma.q6 [um],z [mm]
a,0,0,0,0,0,0,7,200
b,1,1,1,1,1,,,201.1
c,2,2,2,2,2,2,inf,202.2
"""


def test_noise_of_readings_is_read_and_an_empty_cell_is_a_missing_reading(tmp_path, robot) -> None:
    data = load_measurements(write(tmp_path, READINGS), robot)
    assert data.reading_sigma is not None
    np.testing.assert_allclose(
        data.reading_sigma[:, 0], 5e-6, rtol=1e-15
    )  # one rounding of 5 * 1e-6
    np.testing.assert_array_equal(
        data.reading_sigma[:, 1:5], 0.0
    )  # stated as parse_exact, and not stated
    assert data.reading_sigma[:, 5].tolist() == [7e-6, np.inf, np.inf]
    assert np.isnan(data.readings).tolist() == [[False] * 6, [False] * 5 + [True], [False] * 6]
    kept = data.take([2, 1])
    assert kept.reading_sigma is not None
    assert kept.reading_sigma[:, 5].tolist() == [np.inf, np.inf]


def test_patterns_state_the_noise_of_several_readings(tmp_path, robot) -> None:
    stated = READINGS.replace("{q1: 5 um, q2: 0 mm}", '{"q*": 5 um, "q[23]": 1 um}')
    data = load_measurements(write(tmp_path, stated), robot)
    assert data.reading_sigma is not None
    expected = np.array([5e-6, 1e-6, 1e-6, 5e-6, 5e-6])
    np.testing.assert_allclose(data.reading_sigma[0, :5], expected, rtol=1e-15)  # one rounding


CONTEXT = """# kind: component
# components: [z]
# noise: {z: 1 um}
pose,time,temperature [degC],temperature.frame [K],q1 [mm],q2 [mm],q3 [mm],q4 [mm],q5 [mm],q6 [mm],z [mm]
a,2026-05-04T10:22:31.5,20.5,293.15,0,0,0,0,0,0,200
a,2026-05-04T12:22:32+02:00,21.5,,,,,,,,200.1
b,,,,1,1,1,1,1,1,201.1
"""  # noqa: E501


def test_times_and_temperatures_are_kept_in_subsets(tmp_path, robot) -> None:
    data = load_measurements(write(tmp_path, CONTEXT), robot)
    np.testing.assert_array_equal(
        data.observations[0].context["time"], [1777890151.5, 1777890152.0, np.nan]
    )  # UTC
    np.testing.assert_array_equal(data.observations[0].context["temperature"], [20.5, 21.5, np.nan])
    np.testing.assert_array_equal(data.context["temperature"], [21.0, np.nan])
    np.testing.assert_array_equal(data.context["temperature.frame"], [20.0, np.nan])
    np.testing.assert_array_equal(
        data.take([0]).observations[0].context["temperature"], [20.5, 21.5]
    )
    assert data.split(hold_out=0.5, seed=1)[0].observations[0].context.keys() == {
        "time",
        "temperature",
        "temperature.frame",
    }


def test_temperature_of_a_pose_applies_to_its_rows_in_other_files(tmp_path, robot) -> None:
    rows = "\n".join(
        f"{name},{t},{q},{q},{q},{q},{q},{q}"
        for name, t, q in (("a", 20, 0), ("b", 22, 1), ("c", "", 2))
    )
    (tmp_path / "poses.csv").write_text(
        f"pose,temperature [degC],{','.join(f'q{i} [mm]' for i in range(1, 7))}\n{rows}\n"
    )
    text = "# kind: separation\n# noise: {separation: 2 um}\n# poses: poses.csv\npose,separation [mm]\na;b,1.2\nb;c,1.3\n"  # noqa: E501
    data = load_measurements(write(tmp_path, text), robot)
    np.testing.assert_array_equal(data.observations[0].context["temperature"], [21.0, np.nan])


STATEMENTS = (
    ("ball.x: fixed", "ball.q: fixed", "no setup parameter 'ball.q'; it has monday.tracker.rx"),
    ("sd: 1 mm", "sd: 1", "'1' has no unit"),
    ("start: 12 mm", "start: 12 mrad", "start': 'mrad' is a unit of angle"),
    ("sd: 1 mm", "sd: 0 mm", "the standard deviation is 0 mm"),
    ("start: 12 mm, sd: 1 mm", "start: 12 mm", "give either 'sd' or 'fixed"),
    ("sd: 1 mm", "sd: 1 mm, fixed: true", "give either 'sd' or 'fixed"),
    ("ball.x: fixed", "ball.x: free", "'free' gives no knowledge.*write 'fixed'"),
    ("sd: 1 mm", "sd: 1 mm, stat: 3 mm", "unknown key 'stat'.*did you mean 'start'"),
    ("tracker.r?", "tracker.*", "matches lengths and angles"),
    (UNKNOWNS, "[ball.x]", "'unknowns' must name"),
)
REFUSED = {
    TEXT: [(old, new, 6, message) for old, new, message in STATEMENTS]
    + [("a,monday", '"a,monday', 8, "not valid CSV.*quotes")],
    READINGS: [
        ("5 um", "5", 4, "'reading_noise.q1': '5' has no unit"),
        ("5 um", "-5 um", 4, "the noise of readings is -5 um"),
        ("q1: 5 um", "q9: 5 um", 4, "unknown key 'q9' in 'reading_noise'"),
        ("{q1: 5 um, q2: 0 mm}", "5 deg", 4, "'reading_noise': 'deg' is a unit of angle"),
        (",7,", ",-7,", 6, "column 'sigma.q6' is negative"),
        ("sigma.q6 [um]", "sigma.q6", 5, "column 'sigma.q6' has no unit"),
        (",7,", ",,", 6, "column 'sigma.q6' is empty, and this reading has no other noise"),
    ],
    CONTEXT: [
        ("[degC]", "[mm]", 4, "'temperature': 'mm' is a unit of length, .* Allowed: degC, K, degF"),
        (" [degC]", "", 4, "column 'temperature' has no unit"),
        (
            "2026-05-04T10:22:31.5",
            "4.5.2026 10:22",
            5,
            "'time' is '4.5.2026 10:22', but must be a date",
        ),
        ("temperature.frame", "temperature.", 4, "column 'temperature.' is unknown"),
        (",20.5,", ",warm,", 5, "column 'temperature' is 'warm', but must be a number"),
    ],
}
CASES = [(text, *case) for text, cases in REFUSED.items() for case in cases]


@pytest.mark.parametrize(("text", "old", "new", "line", "message"), CASES)
def test_invalid_file_is_refused_with_its_line(tmp_path, robot, text, old, new, line, message):
    assert old in text
    with pytest.raises(LoopcalError, match=message) as caught:
        load_measurements(write(tmp_path, text.replace(old, new, 1)), robot)
    assert str(caught.value).startswith(f"{tmp_path / 'data.csv'}:{line}: ")


@pytest.mark.parametrize("name", ["a;b", "two\nlines", " a", ""])
def test_pose_name_that_cannot_be_written_is_refused_before_writing(tmp_path, robot, name) -> None:
    data = Measurements(robot.name, np.zeros((1, 6)), (), labels=(name,))
    with pytest.raises(DataError, match=r"cannot write the .*: names|contains U\+000A"):
        save_measurements(data, tmp_path / "data.csv", robot)
    twice = Measurements(robot.name, np.zeros((2, 6)), (), labels=("a", "a"))
    with pytest.raises(DataError, match="two poses have the name 'a'"):
        save_measurements(twice, tmp_path / "data.csv", robot)
    assert not (tmp_path / "data.csv").exists()


def test_filled_in_data_sheet_is_read_as_measurements(tmp_path, robot) -> None:
    readings = np.random.default_rng(4).uniform(-0.02, 0.02, (3, 6))
    tracker = Sensor(Position(), Gaussian(np.full(3, 5e-6)), session=np.array("monday"))
    text = format_data_sheet(robot, Instrument((tracker,)), readings, ("p1", "p2", "p3"))
    empty = load_measurements(write(tmp_path, text), robot)
    assert empty.n_rows == 0
    np.testing.assert_array_equal(empty.readings, readings)
    lines = text.rstrip("\n").split("\n")
    filled = [
        line.removesuffix(",,,") + f",1{i},20,200" if line.endswith(",,,") else line
        for i, line in enumerate(lines)
    ]
    data = load_measurements(write(tmp_path, "\n".join(filled)), robot)
    assert data.n_rows == 9
    assert set(data.observations[0].session.tolist()) == {"monday"}
