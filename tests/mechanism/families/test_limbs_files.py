# SPDX-License-Identifier: Apache-2.0
"""Changes to files of the family `limbs`: additions, omissions and typing errors."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.errors import LoopcalError
from loopcal.io.robot.robot_file import find_robot_file, list_shipped_robots, load_robot
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import inverse

LIMBS = tuple(
    name for name in list_shipped_robots() if "\nfamily: limbs" in find_robot_file(name).read_text()
)


def load_changed_robot(
    tmp_path: Path, name: str, *changes: tuple[str, str], more: str = ""
) -> Mechanism:
    """Load a shipped robot with replaced and added text."""
    text = find_robot_file(name).read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / f"{name}.yaml"
    path.write_text(f"{text}\n{more}\n")
    return load_robot(path)


# --- the complete model beside named unknowns
# ------------------------------------------------------------------------
@pytest.mark.parametrize("name", LIMBS)
def test_shipped_limbs_files_load_with_the_complete_model(tmp_path: Path, name: str) -> None:
    """Named parameters keep their names, actuators have one offset, no column is duplicated."""
    ideal, complete = (
        load_robot(name),
        load_changed_robot(tmp_path, name, more="error_model: complete"),
    )
    assert set(ideal.parameters.names) <= set(complete.parameters.names)
    assert len(complete.parameters) > len(ideal.parameters)
    for actuator in complete.actuators:
        assert complete.parameters.names.count(f"{actuator.name}.offset") == 1
    matrix = complete.slots.matrix / np.linalg.norm(complete.slots.matrix, axis=0)
    assert np.linalg.matrix_rank(matrix) == len(complete.parameters)


def test_named_error_about_another_axis_keeps_the_error_of_that_name(tmp_path: Path) -> None:
    """A motor about y has the joint axes z, x, y: `motor.x` of the file is its second axis, so the
    first stays as `.own`.
    """
    machine = load_changed_robot(
        tmp_path, "rotary-delta", ("shift: [x, y, z]", "shift: [x]"), more="error_model: complete"
    )
    moved = {
        m.parameter: m.address.axis
        for m in machine.assembly.maps
        if m.parameter.startswith("arm1.motor.")
    }
    assert moved == {
        "arm1.motor.x": "y", "arm1.motor.x.own": "x", "arm1.motor.rx": "rx", "arm1.motor.ry": "ry"
    }  # fmt: skip


# --- omitted or misspelled
# --------------------------------------------------------------------------------------------
def read_refusal(tmp_path: Path, name: str, *changes: tuple[str, str], more: str = "") -> str:
    """Return the message with which a changed file is refused."""
    with pytest.raises(LoopcalError) as result:
        load_changed_robot(tmp_path, name, *changes, more=more)
    assert "\n" not in str(result.value)
    return str(result.value)


FREEDOMS = {
    "controlled left out": (
        ("controlled: [x, y]\n", ""),
        (
            "five-bar names no controlled coordinate; state one for each freedom, of x, y, z, "
            "roll, "
            "pitch, yaw, phi, theta, psi"
        ),
    ),
    "controlled empty": (
        ("controlled: [x, y]", "controlled: []"),
        "five-bar names no controlled coordinate",
    ),
    "freedoms empty": (
        ("freedoms: [x, y]", "freedoms: []"),
        "five-bar has no freedoms; state those of its platform, of rx,",
    ),
    "freedoms twice": (
        ("freedoms: [x, y]", "freedoms: [x, x, y]"),
        "duplicate freedom 'x' in x, x, y; name each once",
    ),
}


@pytest.mark.parametrize("case", FREEDOMS)
def test_missing_or_duplicate_freedoms_and_coordinates_are_refused(tmp_path, case):
    change, sentence = FREEDOMS[case]
    assert sentence in read_refusal(tmp_path, "five-bar", change)


INVALID_VALUES = {
    "rod without length": (
        ("    length: 480\n", ""),
        "limb 'arm' ends in a rod that no drive moves, of length 0 m; it needs a positive `length:`",  # noqa: E501
    ),
    "rod of no length": (("length: 480", "length: 0"), "it needs a positive `length:`"),
    "rod of negative length": (
        ("length: 480", "length: -480"),
        "of length -0.48 m; it needs a positive `length:`",
    ),
    "stroke reversed": (
        ("stroke: [-45, 95]", "stroke: [90, 10]"),
        "the stroke of q1 runs from 1.5708 to 0.174533 rad; the first value must be smaller",
    ),
    "limits reversed": (
        ("start: 30}", "start: 30, limits: [95, -45]}"),
        (
            "the limits of arm1.motor run from 1.65806 to -0.785398 rad; the first value must be "
            "smaller"
        ),
    ),
    "drive mistyped": (
        ("actuated: q", "actuated: w"),
        (
            "actuator 'q' drives no joint; write 'actuated: q' at one, or leave it out; joints are "
            "driven by w1, w2, w3"
        ),
    ),
}


@pytest.mark.parametrize("case", INVALID_VALUES)
def test_invalid_lengths_ranges_and_actuators_are_refused_in_one_sentence(tmp_path, case):
    change, sentence = INVALID_VALUES[case]
    assert sentence in read_refusal(tmp_path, "rotary-delta", change)


def test_misspelled_actuator_is_reported_before_missing_parameters(tmp_path: Path) -> None:
    text = find_robot_file("rotary-delta").read_text().replace("actuated: q", "actuated: w")
    start, end = text.index("    errors:"), text.index("home:")
    path = tmp_path / "silent.yaml"
    path.write_text(text[:start] + text[end:])
    with pytest.raises(LoopcalError, match="joints are driven by w1, w2, w3"):
        load_robot(path)


def test_file_without_limbs_is_refused(tmp_path: Path) -> None:
    text = find_robot_file("rotary-delta").read_text()
    path = tmp_path / "none.yaml"
    path.write_text(text[: text.index("limbs:\n")] + "limbs: []\n" + text[text.index("home:") :])
    with pytest.raises(
        LoopcalError,
        match="rotary-delta has no limbs; write those that join the base to the platform",
    ):
        load_robot(path)


# --- named parameters and their maps
# ---------------------------------------------------------------------------------
def parameter_text(kind: str, onto: str) -> str:
    """Return the text of a parameter `p` of a kind with one map."""
    return f"parameters: [{{name: p, {kind}: 1, tolerance: {{sd: 1}}, maps: [{{{onto}}}]}}]"


ON_ARM = "limb: arm, element: motor, axis: "
MAPS = {
    "angle onto x": (
        ("angle", ON_ARM + "x"),
        "parameter 'p' is an angle and x of 'arm' a length; state an `arm:` [length per radian]",
    ),
    "angle onto rod": (
        ("angle", "limb: arm, element: rod, axis: length"),
        "is an angle and length of 'arm' a length; state an",
    ),
    "ratio onto x": (
        ("ratio", ON_ARM + "x"),
        "parameter 'p' is a ratio and x of 'arm' a length; state an `arm:`",
    ),
    "length onto rx": (
        ("length", ON_ARM + "rx"),
        "parameter 'p' is a length and rx of 'arm' an angle; state it as an angle",
    ),
    "arm of a length": (
        ("length", ON_ARM + "x, arm: 2"),
        "parameter 'p' is a length with an arm; leave the arm out",
    ),
    "arm onto rx": (
        ("angle", ON_ARM + "rx, arm: 2"),
        "is an angle with an arm and rx of 'arm' an angle; leave the arm out",
    ),
    "length onto offset": (
        ("length", "limb: q1, element: transmission, axis: offset"),
        "is a length and offset of 'q1' an angle; state it as an angle",
    ),
    "angle onto gain": (
        ("angle", "limb: q1, element: transmission, axis: gain"),
        "is an angle and gain of 'q1' a ratio; state it as a ratio",
    ),
    "pitch": (
        ("length", ON_ARM + "pitch"),
        "parameter 'p' is mapped onto 'pitch'; use lead, the advance in one turn",
    ),
}


@pytest.mark.parametrize("case", MAPS)
def test_map_between_incompatible_units_is_refused(tmp_path: Path, case: str) -> None:
    (kind, onto), sentence = MAPS[case]
    assert sentence in read_refusal(tmp_path, "rotary-delta", more=parameter_text(kind, onto))


@pytest.mark.parametrize(
    ("kind", "onto"),
    [
        ("length", ON_ARM + "x"),
        ("angle", ON_ARM + "x, arm: 2"),
        ("angle", ON_ARM + "rx"),
        ("ratio", ON_ARM + "rx"),  # a slope
        ("angle", "limb: q1, element: transmission, axis: offset"),
        ("ratio", "limb: q1, element: transmission, axis: gain"),
    ],
)
def test_map_between_compatible_units_is_accepted(tmp_path: Path, kind: str, onto: str) -> None:
    assert (
        "p"
        in load_changed_robot(
            tmp_path, "rotary-delta", more=parameter_text(kind, onto)
        ).parameters.names
    )


def test_spool_radius_can_be_a_named_parameter(tmp_path: Path) -> None:
    """The gain of an angle that moves a length is a length, per radian."""
    more = parameter_text("length", "limb: a, element: transmission, axis: gain")
    assert "p" in load_changed_robot(tmp_path, "cable-4", more=more).parameters.names


def test_mapped_lead_is_the_advance_per_turn(tmp_path: Path) -> None:
    """A lead that grows by a parameter is the lead that the joint states."""
    machine = load_changed_robot(
        tmp_path, "rotary-delta", more=parameter_text("length", ON_ARM + "lead")
    )
    values = machine.values.copy()
    values[machine.parameters.index("p")] += 0.003  # [m], in one turn
    stated = load_changed_robot(tmp_path, "rotary-delta", ("axis: y,", "axis: y, lead: 3,"))
    xyz = np.array([[0.05, -0.08, -0.45], [-0.1, 0.02, -0.5]])
    solution, twin = inverse(machine.with_values(values), xyz), inverse(stated, xyz)
    assert_allclose(solution.q, twin.q, rtol=0, atol=1e-12)  # [rad]
    assert abs(solution.q - inverse(machine, xyz).q).max() > 1e-5
