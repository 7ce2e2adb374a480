# SPDX-License-Identifier: Apache-2.0
"""Instruments of measurement files: read strictly, written back, in results; dates are checked."""

import json
from dataclasses import replace

import numpy as np
import pytest

import loopcal as lc
from loopcal.cli.entry_point import main
from loopcal.errors import DataError, FileError
from loopcal.io.data.measurement_file import format_measurements
from loopcal.measure.observations import check_instruments

FACTS = {
    "name": "AT960",
    "manufacturer": "Leica",
    "model": "AT960-MR",
    "serial_number": "0750123",
    "certificate": "D-K-15123-01",
    "laboratory": "Metrology <Ltd> & Söhne",
    "standard": "ISO 10360-10",
    "calibrated": "2025-01-15",
    "due": "2026-01-15",
    "measured": "2025-06-01",
}


@pytest.fixture(scope="module")
def robot():
    return lc.load_robot("five-bar")


@pytest.fixture(scope="module")
def data(robot):
    """Return positions of the five-bar at 24 poses with noise of 10 um."""
    noise = lc.Gaussian(np.array([1e-5, 1e-5]))
    instrument = lc.Instrument((lc.Sensor(lc.Component(("x", "y")), noise),))
    points = np.random.default_rng(0).uniform([-0.1, 0.28], [0.1, 0.38], (24, 2))
    return lc.simulate(robot, points, instrument, seed=1)


def with_instrument(data, facts):
    """Return measurements whose rows state an instrument."""
    record = lc.InstrumentRecord(**facts)
    rows = tuple(replace(o, instrument=record) for o in data.observations)
    return replace(data, observations=rows)


def read(folder, robot, data, setting):
    """Write a measurement file with a line for the instrument, and read it."""
    lines = format_measurements(data, robot).split("\n")
    path = folder / "data.csv"
    path.write_text("\n".join([*lines[:2], *setting.split("\n"), *lines[2:]]), "utf-8")
    return lc.load_measurements(path, robot)


def test_facts_survive_writing_and_reading(tmp_path, robot, data) -> None:
    path = tmp_path / "data.csv"
    lc.save_measurements(with_instrument(data, FACTS), path, robot)
    (rows,) = lc.load_measurements(path, robot).observations
    assert rows.instrument == lc.InstrumentRecord(**FACTS)


def test_name_alone_stays_a_name(tmp_path, robot, data) -> None:
    read_data = read(tmp_path, robot, data, "# instrument: AT960")
    assert read_data.observations[0].instrument == lc.InstrumentRecord(name="AT960")
    assert "# instrument: AT960\n" in format_measurements(read_data, robot)


def test_kinds_have_instruments_of_their_own(tmp_path, robot) -> None:
    text = """# format: 1
# instrument: camera
# kinds:
#   place: {kind: component, components: [x, y], noise: {"*": 5 um}}
#   rod: {kind: distance, anchor: [0 mm, 0 mm, 0 mm], noise: {"*": 5 um},
#     instrument: {serial_number: "07"}}
pose,kind,left [deg],right [deg],x [mm],y [mm],distance [mm]
1,place,140,40,0,330,
1,rod,140,40,,,330
"""
    (tmp_path / "data.csv").write_text(text, "utf-8")
    data = lc.load_measurements(tmp_path / "data.csv", robot)
    names = {o.kind.name: str(o.instrument) for o in data.observations}
    assert names == {"component": "camera", "distance": "serial number 07"}


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("{serial: '7'}", r"data.csv:3: .*serial.*serial_number"),
        (
            "{serial_number: 0750123}",
            r"data.csv:3: .*'instrument.serial_number' is the number 750123",
        ),
        (
            "{due: 31.5.2026}",
            r"data.csv:3: 'instrument.due' is '31.5.2026'. Write a date as 2026-05-31",
        ),
        ("{due: '2026-13-01'}", "Write a date as 2026-05-31"),
        ("{calibrated: 2026-02-01, due: 2026-01-01}", "which is before calibrated"),
        ("[AT960]", "Write its name, or"),
        ("{}", "Write its name, or"),
        ("12", "Write its name, or"),
    ],
)
def test_wrong_facts_are_refused_at_their_line(tmp_path, robot, data, setting, message) -> None:
    with pytest.raises(FileError, match=message):
        read(tmp_path, robot, data, f"# instrument: {setting}")


def test_dates_are_checked_in_python() -> None:
    with pytest.raises(DataError, match="Write a date"):
        lc.InstrumentRecord(measured="20260531")


def test_results_and_findings_have_the_instrument(robot, data) -> None:
    late = with_instrument(data, FACTS | {"measured": "2026-02-01"})
    report = lc.calibrate(robot, late, lc.CalibrationOptions(hold_out=0.25))
    assert report.verdict is lc.Verdict.RESERVATIONS
    (found,) = (f for f in report.findings if f.code == "data.instrument-past-due")
    assert "instrument AT960, serial number 0750123 measured on 2026-02-01, after" in str(found)
    (stored,) = json.loads(json.dumps(report.to_dict()))["instruments"]
    assert stored == FACTS | {"measured": "2026-02-01"}


@pytest.mark.parametrize(
    ("changed", "code"),
    [
        ({}, None),
        ({"measured": "2025-01-14"}, "data.instrument-calibrated-later"),
        ({"measured": ""}, "data.instrument-not-dated"),
        ({"measured": "", "due": ""}, None),
        ({"measured": "2026-01-15"}, None),
    ],
)
def test_dates_decide_which_finding(data, changed, code) -> None:
    findings = check_instruments(with_instrument(data, FACTS | changed).observations)
    assert [f.code for f in findings] == ([] if code is None else [code])


def test_validation_as_json_has_the_findings_of_instruments(tmp_path, robot, data, capsys) -> None:
    lc.save_robot(robot, tmp_path / "robot.yaml")
    measured = with_instrument(data, FACTS | {"due": "2025-02-01"})
    lc.save_measurements(measured, tmp_path / "data.csv", robot)
    words = ["validate", str(tmp_path / "robot.yaml"), str(tmp_path / "data.csv"), "--json"]
    assert main(words) == 0
    printed = capsys.readouterr()
    document = json.loads(printed.out)
    assert "data.instrument-past-due" in {finding["code"] for finding in document["findings"]}
    assert any("2025-02-01" in note for note in document["notes"])
    assert "2025-02-01" in printed.err
