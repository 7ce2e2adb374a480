# SPDX-License-Identifier: Apache-2.0
"""Ten realistic mistakes on each of five machines, and the right answers."""

import math
from dataclasses import replace

import numpy as np

from loopcal import geometry
from tests.mistakes.workshop import (
    CALIBRATE,
    DATA,
    ROBOT,
    Mistake,
    change_values,
    empty_cell,
    keep_files,
    read_sheet,
    replace_text,
    shift_rows,
    swap_columns,
    take_rows,
    write_sheet,
)

UNIT = "Correct the unit in the header"

FIVE_BAR = {
    "the encoders are written into each other's columns": Mistake(
        swap_columns("left", "right"),
        1,
        (
            "52 readings of left and right are outside",
            r"data\.csv:19.* right reads 164.2099 deg, 29.2 deg outside",
            "With readings of left and right swapped all readings are inside, and the data fit",
            "Swap their headers",
        ),
    ),
    "one encoder counts the other way": Mistake(
        change_values(lambda x: -x, "right"),
        1,
        ("readings of right with the opposite sign all readings are inside", "Reverse the sign"),
        ("left",),
    ),
    "the controller writes radians under deg": Mistake(
        change_values(math.radians, "left", "right"),
        1,
        (r"readings 57.3 times larger \(rad written as deg\) all readings are inside", "unit"),
    ),
    "the camera measures in inches under mm": Mistake(
        change_values(lambda x: x / 25.4, "x", "y"),
        1,
        (r"lengths 25.4 times larger \(inches written as mm\) they fit", UNIT),
    ),
    "the y axis of the camera points down": Mistake(
        change_values(lambda x: -x, "y"), 1, ("With y with the opposite sign they fit", "sign of y")
    ),
    "a decimal point is one place off": Mistake(
        change_values(lambda x: x / 10.0, "y", rows=slice(6, 7)),
        2,
        ("Outliers: 1 of 30 poses", "Check the measurements of pose 7", "--drop 7"),
        ("sigma is stated too small",),
    ),
    "the pictures are one row late": Mistake(
        shift_rows("x", "y"), 1, ("readings taken from the row above they fit", "by one row")
    ),
    "the belt of one motor has the ratio 3:2": Mistake(
        change_values(lambda x: 1.5 * x, "right"),
        1,
        ("With 0.67 times the written readings of right they fit", "pulleys of right"),
    ),
    "a rod length is mistyped in the robot file": Mistake(
        replace_text(ROBOT, "length: 300", "length: 330"),
        0,
        (
            "Calibrated with reservations",
            r"expected spreads suggest.*west\.length -29\d",
            "dimensions of the robot",
        ),
        ("they fit",),
    ),
    "sigma is stated a thousand times too small": Mistake(
        replace_text(DATA, "noise: {x: 20 um, y: 20 um}", "noise: {x: 20 nm, y: 20 nm}"),
        2,
        (r"exceed the given noise by a factor of 9\d\d", "--noise estimated"),
        ("Outliers: [1-9]",),
    ),
}

THREE_RRR = {
    "yaw is in radians under deg": Mistake(
        change_values(math.radians, "a"),
        1,
        (r"angles 57.3 times larger \(rad written as deg\) they fit", UNIT),
    ),
    "yaw counts clockwise": Mistake(
        change_values(lambda x: -x, "a"), 1, ("With a with the opposite sign they fit",)
    ),
    "the motors are numbered clockwise": Mistake(
        swap_columns("q2", "q3"),
        1,
        ("readings of q2 and q3 swapped they fit", "Swap their headers"),
    ),
    "a header has no unit": Mistake(
        replace_text(DATA, "x [mm]", "x"), 1, (r"data\.csv:8: column 'x' has no unit",)
    ),
    "a column name is misspelled": Mistake(
        replace_text(DATA, "q2 [deg]", "p2 [deg]"),
        1,
        (r"data\.csv:8: column 'p2' is unknown. Allowed: .*q2",),
    ),
    "a cell has a decimal comma": Mistake(
        lambda files: files | {DATA: _with_decimal_comma(files[DATA])},
        1,
        (r"data\.csv:48: .*decimal",),
    ),
    "the limit has no unit": Mistake(
        keep_files,
        1,
        ("'--limit-position': '0.02' has no unit.*for example 0.02mm",),
        command=f"{CALIBRATE} --limit-position 0.02",
    ),
    "a share is given in percent": Mistake(
        keep_files,
        1,
        ("'--hold-out': it is 25, .* share .* Write 0.25 for 25 %",),
        command=CALIBRATE.replace("0.25", "25"),
    ),
    "one reading is missing": Mistake(
        empty_cell("q2", 4), 1, (r"data\.csv:13: column 'q2' is empty. Write its value",)
    ),
    "the controller zeroes a motor elsewhere": Mistake(
        change_values(lambda x: x + 90.0, "q1"),
        1,
        (
            r"readings of q1 counted from another zero \(-(89\.\d|90\.?\d?) deg added",
            "all readings are inside",
            "Correct the readings, or the zero of these actuators",
        ),
    ),
}

SIX_PUS = {
    "rotation vectors are called Euler angles": Mistake(
        lambda files: files | {DATA: _with_euler_settings(files[DATA])},
        1,
        ("rotations as rotation-vector they fit", "Write 'orientation: rotation-vector'"),
    ),
    "the tracker's frame is not declared unknown": Mistake(
        lambda files: files | {DATA: _in_another_frame(files[DATA])},
        1,
        (r"With 'unknown: \[frame\]' in the settings they fit", "state the true frame"),
    ),
    "the carriages are counted from the top": Mistake(
        change_values(lambda x: 400.0 - x, "a1", "a2", "a3", "b1", "b2", "b3"),
        1,
        (
            "in the opposite direction from another zero",
            r"\((399\.\d|400) mm minus the written reading\) they fit",
        ),
    ),
    "two carriages are swapped": Mistake(
        swap_columns("a1", "b1"),
        1,
        ("readings of a1 and b1 swapped they fit", "Swap their headers"),
    ),
    "lengths are in meters under mm": Mistake(
        change_values(lambda x: x / 1000.0, "x", "y", "z"),
        1,
        (r"lengths 1000 times larger \(m written as mm", UNIT),
    ),
    "a row is pasted twice": Mistake(
        lambda files: files | {DATA: files[DATA] + files[DATA].splitlines()[-1] + "\n"},
        1,
        ("poses '40' and '40'", "data.csv:47 and data.csv:48", "Remove the copies"),
    ),
    "only six poses are measured": Mistake(
        take_rows(slice(6)), 1, ("equations cannot determine 54 parameters", "more poses")
    ),
    "a planned sheet is calibrated before it is filled in": Mistake(
        change_values(lambda x: None, "rx", "ry", "rz", "x", "y", "z"), 1, ("no measured value",)
    ),
    "the data belong to another robot": Mistake(
        keep_files,
        1,
        ("data.csv names the robot '6-pus', but you calibrate 'hexapod-42'",),
        command=CALIBRATE.replace(ROBOT, "hexapod-42"),
    ),
    "one rotation is in radians": Mistake(
        change_values(math.radians, "rx", rows=slice(3, 4)),
        2,
        ("Check the measurements of pose 4", "--drop 4"),
    ),
}

ROTARY_DELTA = {
    "z points up": Mistake(
        change_values(lambda x: -x, "z"), 1, ("With z with the opposite sign they fit",)
    ),
    "the gears are stated with twice their ratio": Mistake(
        change_values(lambda x: 2.0 * x, "q1", "q2", "q3"),
        1,
        (
            "With 0.5 times the written readings of q1, q2 and q3 all readings are inside",
            "Check microsteps, gears and pulleys",
        ),
    ),
    "the target is beside the tool": Mistake(
        change_values(lambda x: x + 60.0, "x"),
        0,
        (
            "Calibrated with reservations",
            r"With 'unknown: \[frame\]' in the settings they fit",
            r"cannot distinguish this from 'unknown: \[targets\]' in the settings",
        ),
    ),
    "z is typed from the drawing": Mistake(
        change_values(lambda x: -450.0, "z"),
        1,
        ("column 'z' of kind 'position' is -450 mm in every row, but the robot changes it by 1",),
    ),
    "two arms are cabled the wrong way round": Mistake(
        swap_columns("q1", "q2"),
        1,
        ("readings of q1 and q2 swapped they fit", "Swap their headers"),
    ),
    "the robot file states the arm of a larger model": Mistake(
        replace_text(ROBOT, "tip: [200, 0, 0]", "tip: [240, 0, 0]"),
        0,
        (
            "Calibrated with reservations",
            r"expected spreads suggest.*arm\d\.tip\.x -400",
            "dimensions of the robot",
        ),
        ("they fit",),
    ),
    "x and y are in the columns of each other": Mistake(
        swap_columns("x", "y"), 1, ("columns x and y swapped they fit", "Swap their headers")
    ),
    "a pose is bumped by half a millimeter": Mistake(
        change_values(lambda x: x + 0.5, "x", rows=slice(9, 10)),
        0,  # a sigma known to 25 % allows these residuals, so that the pose is a warning
        ("Pose 10 does not fit the others", "Exclude pose 10, .* and repeat", "--drop 10"),
        ("share errors",),
    ),
    "angles are in radians under deg": Mistake(
        change_values(math.radians, "q1", "q2", "q3"),
        1,
        (r"readings 57.3 times larger \(rad written as deg\) they fit", UNIT),
    ),
    "the angles of the robot file have a unit of length": Mistake(
        replace_text(ROBOT, "units: {length: mm, angle: deg}", "units: {length: mm, angle: mm}"),
        1,
        (r"robot\.yaml:6: 'units\.angle' is 'mm'. Allowed: 'rad'",),
    ),
}

HELIOSTAT = {
    "the inclinometer is in radians under deg": Mistake(
        change_values(math.radians, "tilt_x", "tilt_y"),
        1,
        (r"angles 57.3 times larger \(rad written as deg\) they fit", UNIT),
    ),
    "its axes are swapped": Mistake(
        swap_columns("tilt_x", "tilt_y"), 1, ("columns tilt_x and tilt_y swapped they fit",)
    ),
    "it is mounted upside down": Mistake(
        change_values(lambda x: -x, "tilt_x", "tilt_y"),
        1,
        ("all angles with the opposite sign they fit", "Reverse the sign of the angles"),
    ),
    "the struts are swapped": Mistake(
        swap_columns("west", "south"), 1, ("readings of west and south swapped they fit",)
    ),
    "one strut is in inches": Mistake(
        change_values(lambda x: x / 25.4, "west"),
        1,
        (
            "40 readings of west are outside the stroke",
            r"readings of west 25.4 times larger \(inches written as mm\) all readings are inside",
        ),
    ),
    "the readings start at zero": Mistake(
        change_values(lambda x: x - 756.6, "west", "south"),
        1,
        (r"readings of west and south counted from another zero \(75[67]\.?\d* mm added",),
    ),
    "the stroke of a larger strut is missing in the robot file": Mistake(
        replace_text(ROBOT, "stroke: [400, 1100]", "stroke: [700, 1100]"),
        1,
        (
            "readings of west are outside the stroke in the robot file",
            "The data fit the robot as written, so correct the stroke",
        ),
    ),
    "a number is not a number": Mistake(
        change_values(lambda x: float("nan"), "tilt_x", rows=slice(2, 3)),
        1,
        (r"data\.csv:9: column 'tilt_x' is 'nan', which is not finite",),
    ),
    "everything is held out": Mistake(
        keep_files,
        1,
        ("with 39 poses held out. Hold out fewer",),
        command=CALIBRATE.replace("0.25", "0.99"),
    ),
    "the run folder is the working folder": Mistake(
        keep_files,
        1,
        ("it is the working folder", "Name a new folder"),
        command=CALIBRATE.replace("-o run", "-o ."),
    ),
}

CASES = {
    "five-bar": FIVE_BAR,
    "3-rrr": THREE_RRR,
    "6-pus": SIX_PUS,
    "rotary-delta": ROTARY_DELTA,
    "heliostat": HELIOSTAT,
}


def _with_decimal_comma(text: str) -> str:
    """Return the data with a decimal comma in the first number of the last row."""
    *lines, last = text.splitlines()
    return "\n".join([*lines, last.replace(".", ",", 1)]) + "\n"


def _with_euler_settings(text: str) -> str:
    """Return rotation vectors under the headers of Euler angles."""
    text = text.replace("orientation: rotation-vector", "orientation: euler-xyz")
    for axis, name in zip("xyz", "abc", strict=True):
        text = text.replace(f"r{axis}", name)
    return text


def _in_another_frame(text: str) -> str:
    """Return poses in a frame that is 1 m beside the robot, rotated by 90 degrees about z."""
    sheet = read_sheet(text)
    R = geometry.exp_so3(np.array([0.0, 0.0, np.pi / 2]))
    rows = []
    for cells in sheet.rows:
        angles, position = np.radians([float(c) for c in cells[-6:-3]]), np.array(cells[-3:], float)
        rotated = np.degrees(geometry.log_so3(R @ geometry.exp_so3(angles)))
        moved = R @ position + [1000.0, 200.0, 0.0]
        rows.append((*cells[:-6], *(repr(float(x)) for x in (*rotated, *moved))))
    return write_sheet(replace(sheet, rows=tuple(rows)))
