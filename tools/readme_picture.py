# SPDX-License-Identifier: Apache-2.0
"""Draw docs/pictures/demo.png, the picture of README.md: the robot of `make demo` in the 3-D view
as its controller computes it before and after calibration, and its errors at held-out poses.

python -m tools.readme_picture
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

import loopcal as lc
from loopcal.diagnose.row_errors import PoseErrors
from loopcal.report.figures.style import COLORS
from loopcal.report.scene.scene import Scene, compute_motion
from tools.rendering import open_renderer, save_picture

ROOT = Path(__file__).resolve().parent.parent
PICTURE = ROOT / "docs" / "pictures" / "demo.png"
EXAMPLE = ROOT / "examples" / "hexapod-42"
BEFORE, AFTER, SOFT = COLORS[1], COLORS[0], "#4b5560"
MAGNIFICATION = 300.0
KEYS = "ArrowUp + ArrowRight"
SIZE, DPI = (12.0, 6.2), 140


def main() -> int:
    """Draw the picture."""
    robot = lc.load_robot("hexapod-42")
    data = lc.load_measurements(EXAMPLE / "measurements.csv", robot)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    validation = report.validation
    truth = lc.load_robot(EXAMPLE / "truth.yaml")
    assert validation
    figure = Figure(figsize=SIZE, facecolor="white")
    before, after = (
        compute_motion(truth, r.values - truth.values, "", "") for r in (robot, report.robot)
    )
    assert before
    assert after
    sides = [
        (word, color, replace(motion, magnification=MAGNIFICATION))
        for word, color, motion in (("before", BEFORE, before), ("after", AFTER, after))
    ]
    with open_renderer() as render:
        for k, (word, color, motion) in enumerate(sides):
            rendering = render(
                Scene(truth, motions=(motion,)), 700, keys=KEYS, names=False, color=color
            )
            axes = figure.add_axes((0.5 * k + 0.005, 0.19, 0.49, 0.79), zorder=-1)
            axes.imshow(rendering)
            axes.set_axis_off()
            write_result(figure, 0.5 * k + 0.25, word, getattr(validation, word), color)
    floor = 1e6 * validation.noise_floor.rms["position"]
    figure.text(
        0.5,
        0.05,
        f"Position error (rms) at {len(validation.poses)} measured poses that the calibration did "
        f"not use; the instrument's noise is {floor:.3g} um.\nIn color: the machine as its "
        f"controller computes it, with errors drawn {MAGNIFICATION:g} times larger.",
        ha="center", va="center", fontsize=12, color=SOFT, linespacing=1.5,
    )  # fmt: skip
    save_picture(PICTURE, figure, DPI)
    print(f"wrote {PICTURE.relative_to(ROOT)}: {PICTURE.stat().st_size / 1024:.0f} kB")
    return 0


def write_result(figure: Figure, x: float, word: str, errors: PoseErrors, color: str) -> None:
    """Write a title above the rendering of one side, and its error below."""
    figure.text(x, 0.94, f"{word} calibration", ha="center", fontsize=20, color=color)
    text = f"{1e6 * errors.statistics('position').rms:.3g} um"
    box = {"boxstyle": "round,pad=0.35,rounding_size=0.6", "fc": color, "ec": "none"}
    style: dict[str, Any] = {"ha": "center", "va": "center", "weight": "bold", "bbox": box}
    figure.text(x, 0.16, text, fontsize=25, color="white", **style)


if __name__ == "__main__":
    sys.exit(main())
