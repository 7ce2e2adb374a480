# SPDX-License-Identifier: Apache-2.0
"""Random numbers in place of measurements: no option makes a calibration of them."""

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.calibration import calibrate
from loopcal.apply.calibration_options import CalibrationOptions
from loopcal.apply.calibration_report import Verdict
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares

TARGETS = ("A", "B", "C")
HEADER = """# format: 1
# kind: position
# targets: [A, B, C]
# places: [[160 mm, 0 mm, 0 mm], [-80 mm, 139 mm, 0 mm], [-80 mm, -139 mm, 0 mm]]
# unknown: [frame, targets]
# noise: {"*": 5 um}
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise", "method"),
    [
        ("estimated", MAP()),
        pytest.param("given", LeastSquares(), marks=pytest.mark.evidence),
        pytest.param("given", MAP(), marks=pytest.mark.evidence),
        pytest.param("estimated", LeastSquares(), marks=pytest.mark.evidence),
    ],
)
def test_random_positions_are_never_a_calibration(tmp_path, method, noise):
    robot = lc.load_robot("hexapod-42")
    stream = np.random.default_rng(7)
    readings = stream.uniform(-30.0, 30.0, (24, 6))  # [mm]
    values = stream.uniform(-300.0, 300.0, (24, 9))
    names = [*(f"q{k}" for k in range(1, 7)), *(f"{t}.{axis}" for t in TARGETS for axis in "xyz")]
    rows = [",".join(("pose", *(f"{name} [mm]" for name in names)))]
    for k, row in enumerate(np.hstack([readings, values]).tolist()):
        rows.append(",".join(map(str, (k + 1, *row))))
    (tmp_path / "random.csv").write_text(HEADER + "\n".join(rows) + "\n", "utf-8")
    data = lc.load_measurements(tmp_path / "random.csv", robot)
    options = CalibrationOptions(
        FitOptions(method, noise=noise), hold_out=0.25, check_conventions=False
    )
    report = calibrate(robot, data, options)
    assert report.verdict is Verdict.NOT_CALIBRATED
    assert report.next_step.code == "workflow.next-check-data"
    lc.save_run(report, tmp_path / "run")
    assert lc.load_run(tmp_path / "run").failure is not None
