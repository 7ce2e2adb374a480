# SPDX-License-Identifier: Apache-2.0
"""Draw docs/pictures/demo.png, the picture of README.md: the robot of `make demo`, its errors.

python -m tools.readme_picture
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import loopcal as lc
from loopcal.apply.validation import Validation
from loopcal.report.scene.scene import PoseErrors, compute_pose_errors, list_parts

ROOT = Path(__file__).resolve().parent.parent
PICTURE = ROOT / "docs" / "pictures" / "demo.png"
BEFORE, AFTER, ROBOT, PALE = "#d55e00", "#0072b2", "#303030", "#909090"


def main() -> int:
    """Draw the picture."""
    robot = lc.load_robot("hexapod-42")
    data = lc.load_measurements(ROOT / "examples" / "hexapod-42" / "measurements.csv", robot)
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    assert report.validation
    labels = tuple(str(i) for i in range(len(data.readings)))
    poses = compute_pose_errors(report.robot, robot, data.readings, labels)
    figure = Figure(figsize=(9.6, 3.7), layout="constrained", facecolor="white")
    parts: Any = figure.subfigures(1, 2, width_ratios=(1.0, 1.25))
    left, right = parts
    draw_errors_in_space(left.add_subplot(projection="3d"), report.robot, poses)
    draw_errors_by_pose(right.add_subplot(), report.validation)
    PICTURE.parent.mkdir(exist_ok=True)
    figure.savefig(
        PICTURE, dpi=130, bbox_inches="tight", pad_inches=0.15, metadata={"Software": None}
    )
    print(f"wrote {PICTURE.relative_to(ROOT)}: {PICTURE.stat().st_size / 1024:.0f} kB")
    return 0


def draw_errors_in_space(axes: Any, robot: lc.Mechanism, poses: PoseErrors) -> None:
    """Draw the robot at home, the measured poses, and the errors there before calibration."""
    for part in list_parts(robot, robot.home_state):
        if part.role in ("rod", "base", "platform"):
            color, width = (PALE, 1.0) if part.role == "base" else (ROBOT, 2.0)
            axes.plot(*(1e3 * part.points[0].T), color=color, lw=width, solid_capstyle="round")
    ends = 1e3 * np.stack([poses.tool, poses.tool + poses.magnification * poses.error], axis=1)
    for line in ends:
        axes.plot(*line.T, color=BEFORE, lw=1.5)
    axes.plot(*(1e3 * poses.tool.T), "o", color=AFTER, ms=3.0)
    axes.set_title(
        f"{len(poses.tool)} measured poses; errors before calibration, x {poses.magnification:g}",
        fontsize=10,
    )
    spans = [np.ptp(axis()) for axis in (axes.get_xlim, axes.get_ylim, axes.get_zlim)]
    axes.set_box_aspect(spans, zoom=1.2)
    axes.view_init(elev=22, azim=-55)
    axes.set_axis_off()


def draw_errors_by_pose(axes: Any, validation: Validation) -> None:
    """Draw the position errors at held-out poses before and after calibration."""
    names = tuple(dict.fromkeys(validation.poses))
    for errors, color, word in (
        (validation.before, BEFORE, "before calibration"),
        (validation.after, AFTER, "after calibration"),
    ):
        of_position = errors["position"]
        places = [names.index(validation.poses[row]) for row in of_position.rows]
        rms = 1e6 * errors.statistics("position").rms
        axes.plot(
            places, 1e6 * of_position.size, "o", color=color, label=f"{word}: rms {rms:.3g} um"
        )
        axes.axhline(rms, color=color, lw=1.2)
    floor = 1e6 * validation.noise_floor.rms["position"]
    axes.axhline(floor, color=PALE, lw=1.2, ls="--", label=f"noise floor: {floor:.3g} um")
    axes.set_yscale("log")
    axes.set_yticks([0.3, 1, 3, 10, 30, 100, 300], minor=False)
    axes.set_yticks([], minor=True)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_ylim(0.2, 1200)
    axes.set_xticks(range(len(names)), names)
    axes.set_xlabel("held-out pose")
    axes.set_ylabel("position error [um]")
    axes.set_title("errors at poses that were not used in the fit", fontsize=10)
    axes.grid(visible=True, color="#dddddd", lw=0.6)
    axes.set_axisbelow(True)
    axes.legend(loc="upper center", ncols=1, fontsize=8.5, framealpha=1.0, edgecolor="none")


if __name__ == "__main__":
    sys.exit(main())
