# SPDX-License-Identifier: Apache-2.0
"""Real delta printers: the heights at which the nozzle touched the bed, against what the printers'
own firmware made.

The records and their origin are described beside them in LOOPCAL_DATA/delta_printers. The firmware
identifies radius, two tower angles and three end stops from heights alone, all of equal weight.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from loopcal.apply import validate
from loopcal.estimate import FitOptions, identify
from loopcal.measure import Component, Measurements, Observations
from loopcal.mechanism import Mechanism, PoseRecord, build
from loopcal.mechanism.families.linear_delta import LinearDelta

MM, DEG = 1e-3, np.pi / 180.0
PROBE = 0.02 * MM  # a usual probe's repeatability
FITTED = ("radius", "tower1.angle", "tower2.angle", "tower1.stop", "tower2.stop", "tower3.stop")
NAMES = ("cupsster", "danorder factory default", "danorder", "fzechert")


@pytest.fixture(scope="module")
def records(data_folder: Path) -> dict[str, dict]:
    """Records with heights alone, by the names above."""
    found = json.loads(
        (data_folder / "delta_printers" / "real_delta_calibrations.json").read_text("utf-8")
    )
    alone = [r for r in found if not r["distances"]]
    assert len(alone) == len(NAMES)
    return dict(zip(NAMES, alone, strict=True))


def printer(record: dict, stop: float = 0.0) -> Mechanism:
    """The printer with its stored geometry, end stops off by `stop` [m]."""
    stored = record["geometry_stored_in_config"]
    family = LinearDelta(
        name="printer",
        radius=stored["radius"] * MM,
        angles=tuple(a * DEG for a in stored["angles"]),
        arms=tuple(a * MM for a in stored["arms"]),
        stops=tuple(e * MM + stop for e in stored["endstops"]),
        home=PoseRecord(z=0.05),
    )
    robot = build(family.expand(), record=family)
    return replace(robot, parameters=robot.parameters.with_free(FITTED))


def heights(record: dict) -> Measurements:
    """What the probe saw: z at carriages that are `steps * stepdist` below the end stops."""
    rows = record["heights"]
    step = np.array(record["geometry_stored_in_config"]["stepdist"]) * MM
    readings = np.array([row["stable_steps"] for row in rows]) * step
    z = np.array([[row["z_mm"] * MM] for row in rows])
    kind = Component(("z",)).with_tool(np.eye(4))
    return Measurements(
        "printer", readings, (Observations.from_sigma(kind, np.arange(len(rows)), z, PROBE),)
    )


@pytest.mark.parametrize("name", [n for n in NAMES if "factory" not in n])
@pytest.mark.parametrize("off", [0.0, 40 * MM, -40 * MM])
def test_the_answer_of_the_firmware_comes_back_from_starts_far_off(records, name, off):
    record = records[name]
    fit = identify(printer(record, off), heights(record), options=FitOptions(noise="estimated"))
    stored = printer(record)
    assert fit.converged
    assert fit.rank == 6
    for parameter, value in zip(fit.names, fit.estimate, strict=True):
        unit = DEG if "angle" in parameter else MM
        expected = stored.values[stored.parameters.index(parameter)]
        assert abs(value - expected) / unit < 2e-3, parameter


def test_one_degree_of_freedom_gives_intervals_only_with_the_sigma_of_the_probe(records):
    record = records["cupsster"]
    estimated = identify(printer(record), heights(record), options=FitOptions(noise="estimated"))
    assert estimated.residual_test.dof == len(record["heights"]) - 6 == 1
    assert "noise.too-few-degrees" in {finding.code for finding in estimated.findings}
    assert np.isfinite(identify(printer(record), heights(record)).standard_deviations).all()


def test_the_factory_default_is_flagged_as_not_calibrated(records):
    # a stored geometry that was fitted to its heights cannot be improved on them; a factory default
    # can
    for name, record in records.items():
        data = heights(record)
        found = validate(
            identify(printer(record), data, options=FitOptions(noise="estimated")), data
        )
        if "factory" in name:
            assert found.improvement() > 3.0
            refused = validate(printer(record), data, limit_position=0.2 * MM)
            assert refused.failures[0].code == "gates.limit-exceeded"
            assert refused.failures[0].data["error"].value == pytest.approx(0.2617, abs=5e-5)
        else:
            assert found.improvement() == pytest.approx(1.0, abs=1e-3)
