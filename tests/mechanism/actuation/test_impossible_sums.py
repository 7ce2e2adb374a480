# SPDX-License-Identifier: Apache-2.0
"""Sums of joint values that no machine has are refused in one sentence, with file and line."""

from pathlib import Path

import pytest

from loopcal.errors import FileError, MechanismError
from tests.mechanism.actuation.test_summed_drives import CELL, PLATE, WRIST
from tests.robot_texts import load_text

SECOND, THIRD = "q2: {reads: length, sum: {m: 1, k: 2}}", "q3: {reads: length, sum: {n: 1, h: 2}}"


@pytest.mark.parametrize(
    ("old", "new", "sentence", "line"),
    [
        (SECOND, "q2: {reads: length, sum: {m: 1, kk: 2}}", "names 'kk', which no limb", 9),
        (SECOND, "q2: {reads: length, sum: {m: 1, h: 2}}", "'k' of limb 'K' is in no sum", 8),
        (SECOND, "q2: {reads: length, sum: {m: 2, n: 2}}\n  k: {reads: length}",
         "singular: that of actuator 'q2' follows", 9),
        (SECOND, "q2: {reads: length, sum: {m: 0, k: 0}}", "all weights in the sum", 9),
        (SECOND, "q2: {reads: length, sum: {m: 1, k: .inf}}", "is inf; write a finite number", 9),
        (SECOND, "q2: {reads: length, sum: [m, k]}",
         "'actuators.q2.sum' is a list of 2, but a mapping is needed", 9),
        (SECOND, "q2: {reads: lenght, sum: {m: 1, k: 2}}",
         "'lenght' .did you mean 'length'..; allowed: 'length', 'angle'", 9),
        (SECOND, "q2: {reads: length}", "'q2' drives no joint and states no `sum:`", 9),
        ("[weight.n]", "[weight.k]", "no term 'weight.k'", 8),
        ("[weight.n]", "[wait.n]", "no term 'wait.n'", None),
        (f"  {THIRD}\n", "", "'h' of limb 'H' is in no sum", 8),
        (f"  {THIRD}\n", "  h: {reads: length}\n  k: {reads: length}\n",
         "redundant readings cannot be sums", None),
        (THIRD, f"{THIRD}\n  m: {{reads: length}}\n  k: {{reads: length}}",
         "5 readings .* are sums of 4 joints", 12),
        (f"  {SECOND}\n  {THIRD}\n", "  q2: {reads: length, sum: {k: 1, h: 2}}\n",
         "2 readings of 4 driven joints for 3 freedoms", None),
        (THIRD, "q3: {reads: angle, sum: {n: 1, h: 2}}", "drives a joint that slides", None),
        (THIRD, "q3: {triangle: {foot: [1, 0, 0], head: [0, 1, 0]}}", "beside sums", 10),
    ],
)  # fmt: skip
def test_impossible_sums_are_refused_in_one_sentence(tmp_path, old, new, sentence, line):
    assert load_text(tmp_path, PLATE).has_open_sums
    assert old in PLATE
    with pytest.raises((FileError, MechanismError), match=sentence) as error:
        load_text(tmp_path, PLATE.replace(old, new, 1))
    text = str(error.value)
    assert "\n" not in text
    assert "robot.yaml" in text
    assert line is None or f"line {line}" in text or f":{line}" in text


def test_a_sum_of_an_angle_and_a_length_is_refused(tmp_path: Path) -> None:
    text = WRIST.replace("{joint: R, name: b", "{joint: P, name: b").replace(
        "start: 60", "start: 6"
    )
    with pytest.raises(FileError, match="is a sum of the angle 'j3' and the length 'j2'"):
        load_text(tmp_path, text)


def test_sums_that_do_not_hold_the_platform_are_refused(tmp_path: Path) -> None:
    # no cable holds the plate against rotation about the point in which all of them meet
    text = PLATE
    for point in ("[-150, -100, 0]", "[-150, 100, 0]", "[150, -100, 0]", "[150, 100, 0]"):
        text = text.replace(f"attach: {point}", "attach: [0, 0, 0]")
    with pytest.raises((FileError, MechanismError), match=r"can rotate|leave|free|hold"):
        load_text(tmp_path, text)
    symmetric = PLATE.replace(SECOND, "q2: {reads: length, sum: {k: 1, h: 1}}").replace(
        THIRD, "q3: {reads: length, sum: {m: 1, n: 1, k: 1, h: 2}}"
    )
    symmetric = symmetric.replace("-700", "-800").replace("150, 100", "150, 99.999")
    assert load_text(tmp_path, symmetric).has_open_sums


def test_a_drive_of_two_stages_is_refused(tmp_path: Path) -> None:
    text = CELL.replace("joint: {kind: P, axis: z}", "joint: {kind: P, axis: z, drive: q1}")
    with pytest.raises(FileError, match="actuator 'q1' drives the stages 'lift' and 'plate'"):
        load_text(tmp_path, text)
