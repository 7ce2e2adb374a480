# SPDX-License-Identifier: Apache-2.0
"""Held-out errors of stored runs: those of every quantity that they measured."""

import numpy as np
import pytest

import loopcal as lc
from loopcal.report.validation_view import view_comparison
from tests.estimate.problems import hexapod_poses

UM = 1e-6
POINTS = np.array([[60.0, 0.0, 20.0], [-30.0, 50.0, 20.0], [-30.0, -50.0, 20.0]]) * 1e-3
KINDS = {
    "gap": lc.Plane(places=POINTS[:1], unknown=("surface",), surface="bed"),
    "length": lc.Distance(anchor=np.array([0.5, -0.4, 0.6])),
    "orientation": lc.Inclination(),
    "position": lc.Position(targets=("a", "b", "c"), places=POINTS),
}


def simulate(robot: lc.Mechanism, quantities: tuple[str, ...], seed: int) -> lc.Measurements:
    """Return poses and other quantities at 16 poses."""
    kinds = [lc.Pose(), *(KINDS[name] for name in quantities)]
    sensors = [lc.Sensor(kind, lc.Gaussian(np.full(len(kind.columns), 10 * UM))) for kind in kinds]
    return lc.simulate(robot, hexapod_poses(16, seed), lc.Instrument(tuple(sensors)), seed=seed)


@pytest.mark.parametrize("quantities", [("gap",), ("length", "orientation")])
def test_errors_of_all_quantities_are_those_of_the_validation(quantities, tmp_path) -> None:
    """At the stored poses of each run, at those that are common, and at other measurements."""
    robot = lc.load_robot("hexapod-42")
    data, file = simulate(robot, quantities, 1), tmp_path / "measured.csv"
    file.touch()
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    assert report.validation is not None
    after = report.validation.after.quantities
    assert {"position", "orientation", *quantities} == set(after)
    for name in ("first", "second"):
        lc.save_run(report, tmp_path / name, {"data": file})
    runs = [lc.load_run(tmp_path / name) for name in ("first", "second")]
    others = lc.compare_runs(runs, simulate(robot, quantities, 2))
    comparison = lc.compare_runs(runs)
    for errors, of_others in zip(comparison.errors, others.errors, strict=True):
        assert set(errors.own) == set(errors.common) == set(of_others.common) == set(after)
        for name, of_quantity in after.items():
            assert errors.own[name] == pytest.approx(of_quantity.statistics, rel=1e-12)
            assert errors.common[name] == errors.own[name]
            assert of_others.common[name].count == of_quantity.statistics.count * 4
    for each in (comparison, others):
        page = "\n".join(map(str, view_comparison(each)))
        assert all(name in page for name in after)
