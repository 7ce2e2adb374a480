# SPDX-License-Identifier: Apache-2.0
"""What people add to a file of the family `limbs`, or leave out of it, or mistype."""

from pathlib import Path

import numpy as np
import pytest

from loopcal.errors import LoopcalError
from loopcal.io.robot_file import load_robot, robot_path, shipped_robots
from loopcal.mechanism import Mechanism

LIMBS = tuple(name for name in shipped_robots() if "family: limbs" in robot_path(name).read_text())


def changed(tmp_path: Path, name: str, *changes: tuple[str, str], more: str = "") -> Mechanism:
    """A shipped robot with pieces of its text replaced, and more of it."""
    text = robot_path(name).read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / f"{name}.yaml"
    path.write_text(f"{text}\n{more}\n")
    return load_robot(path)


# --- the complete model beside named unknowns ------------------------------------------------------------------------
@pytest.mark.parametrize("name", LIMBS)
def test_every_shipped_file_also_loads_with_the_complete_model(tmp_path: Path, name: str) -> None:
    """What the file names keeps its name and tolerance; a drive has one offset; nothing stands there twice."""
    ideal, complete = load_robot(name), changed(tmp_path, name, more="error_model: complete")
    assert set(ideal.parameters.names) <= set(complete.parameters.names)
    assert len(complete.parameters) > len(ideal.parameters)
    for actuator in complete.actuators:
        assert complete.parameters.names.count(f"{actuator.name}.offset") == 1
    matrix = complete.slots.matrix / np.linalg.norm(complete.slots.matrix, axis=0)
    assert np.linalg.matrix_rank(matrix) == len(complete.parameters)


def test_a_named_error_about_another_axis_than_the_one_of_its_name_takes_none_away(tmp_path: Path) -> None:
    """A motor about y has the own axes z, x, y: `motor.x` of the file is its second, so the first stays, as `.own`."""
    machine = changed(tmp_path, "rotary-delta", ("shift: [x, y, z]", "shift: [x]"), more="error_model: complete")
    moved = {m.parameter: m.address.axis for m in machine.assembly.maps if m.parameter.startswith("arm1.motor.")}
    assert moved == {
        "arm1.motor.x": "y", "arm1.motor.x.own": "x", "arm1.motor.rx": "rx", "arm1.motor.ry": "ry"
    }  # fmt: skip


# --- left out or mistyped --------------------------------------------------------------------------------------------
def refused(tmp_path: Path, name: str, *changes: tuple[str, str], more: str = "") -> str:
    """The one sentence that a changed file is refused with."""
    with pytest.raises(LoopcalError) as found:
        changed(tmp_path, name, *changes, more=more)
    assert "\n" not in str(found.value)
    return str(found.value)


FREEDOMS = {
    "controlled left out": (
        ("controlled: [x, y]\n", ""),
        "five-bar names no controlled coordinate; state one for each freedom, of x, y, z, roll, pitch, yaw, phi, theta, psi",
    ),
    "controlled empty": (("controlled: [x, y]", "controlled: []"), "five-bar names no controlled coordinate"),
    "freedoms empty": (("freedoms: [x, y]", "freedoms: []"), "five-bar has no freedoms; state those its platform has, of rx,"),
    "freedoms twice": (
        ("freedoms: [x, y]", "freedoms: [x, x, y]"),
        "the freedom 'x' is named twice in x, x, y; name each once",
    ),
}


@pytest.mark.parametrize("case", FREEDOMS)
def test_freedoms_and_coordinates_are_named_once_and_not_left_out(tmp_path: Path, case: str) -> None:
    change, sentence = FREEDOMS[case]
    assert sentence in refused(tmp_path, "five-bar", change)
