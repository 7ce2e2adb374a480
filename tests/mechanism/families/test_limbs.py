# SPDX-License-Identifier: Apache-2.0
"""Mechanisms described limb by limb: the same robot in another description, random structures,
actuators, and files with additions, omissions and typing errors.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.errors import LoopcalError, MechanismError
from loopcal.io.robot.robot_file import find_robot_file, list_shipped_robots, load_robot
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.drives import AngleDrive, LengthDrive, SpoolDrive
from loopcal.mechanism.families.limbs import (
    Copies,
    LimbRecord,
    Limbs,
    Prismatic,
    Revolute,
    RodCone,
    Shifts,
    Tilts,
    Universal,
)
from loopcal.mechanism.families.placement import LengthTolerance, PoseRecord
from loopcal.mechanism.families.prs import ThreePrs
from loopcal.mechanism.families.records import MapEntry, NamedAngle, NamedLength
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import check_limits
from tests.mechanism.families.random_limbs import (
    build_mechanism,
    expected_rank,
    random_mechanism,
    sample_near_home,
)
from tests.mechanism.families.ranks import rank, scale_angles, solve_random_poses

TRIPOD = """
format: 1
family: limbs
name: tripod
units: {length: mm, angle: deg}
controlled: [z, phi, theta]
actuators:
  q: {reads: length, stroke: [0, 450], unknown: [offset], length: {sd: 0.1}}
limbs:
  - name: leg
    chain:
      - {joint: P, name: guide, at: [350, 0, 0], axis: z, actuated: q, start: 220}
      - {joint: R, name: hinge, axis: y, start: -17}
    tip: [0, 0, 500]
    ending: ball
    attach: [200, 0, 0]
    copies: {count: 3}
    errors:
      - {of: guide, shift: [x, y], tolerance: {sd: 0.1}}
      - {of: guide, tilt: [rx, ry], alone: true, tolerance: {sd: 0.02}}
      - {of: hinge, tilt: [rx, rz], tolerance: {sd: 0.02}}
      - {of: tip, shift: [z], tolerance: {sd: 0.1}}
      - {of: platform, shift: [x, y, z], tolerance: {sd: 0.1}}
home: {z: 700}
workspace: {z: [650, 750], phi: [-180, 180], theta: [1, 35]}
"""

TWIN = ThreePrs(
    name="3-prs", platform_radius=0.2, base_radius=0.35, rod=0.5, home=PoseRecord(z=0.7)
)

NAMES = {
    "guide.x": "b{}x", "guide.y": "b{}y", "guide.rx": "thB{}x", "guide.ry": "thB{}y", "hinge.rx": "thC{}x",  # noqa: E501
    "hinge.rz": "thC{}z", "tip.z": "l{}", "platform.x": "a{}x", "platform.y": "a{}y", "platform.z": "a{}z",  # noqa: E501
}  # fmt: skip


def test_tripod_described_by_limbs_equals_the_3_prs(tmp_path: Path) -> None:
    path = tmp_path / "tripod.yaml"
    path.write_text(TRIPOD)
    written, twin = load_robot(path), build(TWIN.expand())
    solution = solve_random_poses(written)
    D = differentiate_pose(
        written, written.values[None], solution.q[None], solution.state
    ).parameters[0]
    other = inverse(twin, np.stack([solution.T[:, 2, 3], *_tilt(solution.T)], axis=1))
    assert_allclose(other.T, solution.T, atol=1e-12)  # [m, 1]
    E = differentiate_pose(twin, twin.values[None], other.q[None], other.state).parameters[0]
    assert len(written.parameters) == len(twin.parameters) == 33
    for i, parameter in enumerate(written.parameters.entries):
        start, _, rest = parameter.name.partition(".")
        name = f"q{start[-1]}" if rest == "offset" else NAMES[rest].format(start[-1])
        j = twin.parameters.index(name)
        assert_allclose(D[..., i], E[..., j], rtol=0, atol=1e-12 * np.abs(E).max())
        assert parameter.nominal == pytest.approx(twin.parameters.nominal[j], abs=1e-15)
        assert parameter.dimension is twin.parameters.dimensions[j]


def _tilt(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.arctan2(T[:, 1, 2], T[:, 0, 2]), np.arctan2(
        np.hypot(T[:, 0, 2], T[:, 1, 2]), T[:, 2, 2]
    )


# --- random structures
# -----------------------------------------------------------------------------------------------
RANDOM = (
    [(6, seed) for seed in range(10)]
    + [(3, 100 + seed) for seed in range(6)]
    + [(2, 200 + seed) for seed in range(3)]
)


@cache
def build_random_robot(limbs: int, seed: int) -> Mechanism:
    return build_mechanism(random_mechanism(seed, limbs))


def test_random_mechanisms_have_at_least_fifty_limbs() -> None:
    assert sum(limbs for limbs, _ in RANDOM) >= 50


@pytest.mark.parametrize(("limbs", "seed"), RANDOM)
def test_rank_of_a_random_complete_model_follows_the_counting_rule(limbs: int, seed: int) -> None:
    """Frames and axes are random, so no perturbation is needed. Nonzero singular values are above
    1e-10 of the largest.
    """
    record, machine = random_mechanism(seed, limbs), build_random_robot(limbs, seed)
    state, q = sample_near_home(machine, 400, seed)
    assert state.T.shape[1] >= 40  # six rows each, for at most 142 parameters
    D = differentiate_pose(machine, machine.values[None], q, state).parameters[0, :150]
    assert rank(scale_angles(machine, D), tolerance=1e-10) == expected_rank(record)
    offsets = len(machine.actuators)
    free = sum(
        j.actuated is None
        for limb in record.limbs
        for j in limb.chain
        if isinstance(j, (Revolute, Prismatic))
    )
    assert (
        len(machine.parameters)
        == expected_rank(record) + free + sum(1 for limb in record.limbs if limb.actuated is None)
        == expected_rank(record)
        + free
        + offsets
        - sum(limb.actuated is not None for limb in record.limbs)
    )


# --- what a file may contain
# ---------------------------------------------------------------------------------------------
SLIDER = Limbs(  # two rods from driven slides to a point in the plane
    name="slider",
    freedoms=("x", "y"),
    controlled=("x", "y"),
    drives={"q": LengthDrive(reads="length", unknown=("offset",))},
    limbs=(
        LimbRecord(
            "rod",
            "distance",
            chain=(Prismatic("P", at=(0.3, 0.0, 0.0), axis="y", actuated="q", start=0.1),),
            length=0.5,
            copies=Copies(2, "z", np.pi / 2),
            errors=(Shifts("rod", ("length",)),),
        ),
    ),
    home=PoseRecord(x=-0.05, y=-0.05),
)


def change_limb(**changes: object) -> Limbs:
    return replace(SLIDER, limbs=(replace(SLIDER.limbs[0], **changes),))  # type: ignore[arg-type]


def test_copies_of_a_limb_are_rotated_and_numbered() -> None:
    machine = build(SLIDER.expand())
    assert [limb.name for limb in machine.assembly.limbs] == ["rod1", "rod2"]
    assert [a.name for a in machine.actuators] == ["q1", "q2"]
    assert machine.parameters.names == ("rod1.length", "rod2.length", "q1.offset", "q2.offset")
    first, second = (limb.links[0].transform for limb in machine.assembly.limbs)
    assert_allclose(first[:3, [2, 3]].T, [[0, 1, 0], [0.3, 0, 0]], atol=1e-15)
    assert_allclose(second[:3, [2, 3]].T, [[-1, 0, 0], [0, 0.3, 0]], atol=1e-15)


def test_spool_length_includes_radius_and_buildup() -> None:
    """length = offset + r q + b q^2 / (4 pi)."""
    spool = SpoolDrive(
        reads="angle",
        radius=0.02,
        buildup=0.001,
        offset=0.05,
        unknown=("offset", "radius", "buildup", "backlash"),
    )
    machine = build(replace(SLIDER, drives={"q": spool}).expand())
    plain = build(SLIDER.expand())
    xy = np.array([[-0.02, -0.08], [-0.06, -0.01]])
    angle, slide = inverse(machine, xy).q, inverse(plain, xy).q
    assert_allclose(0.05 + 0.02 * angle + 0.001 * angle**2 / (4 * np.pi), slide, rtol=0, atol=1e-12)
    values = machine.values.copy()
    values[machine.parameters.index("q1.buildup")] += 0.0005
    thicker = inverse(machine.with_values(values), xy).q
    left = 0.05 + 0.02 * thicker[:, 0] + 0.0015 * thicker[:, 0] ** 2 / (4 * np.pi)
    assert_allclose(left, slide[:, 0], rtol=0, atol=1e-12)  # [m]


def test_named_parameter_changes_all_elements_of_its_maps() -> None:
    """A radius common to both slides, and a rotation of their frame with a lever arm of 0.3 m."""
    radius = NamedLength("radius", 0.3, (MapEntry("rod", "P1", "x"),), LengthTolerance(sd=1e-4))
    turn = NamedAngle(
        "turn", 0.0, (MapEntry("rod", "P1", "y", arm=0.3), MapEntry("rod", "P1", "rz"))
    )
    machine = build(replace(SLIDER, parameters=(radius, turn)).expand())
    assert machine.parameters.names[-2:] == ("radius", "turn")
    values = machine.values.copy()
    values[machine.parameters.index("radius")] = 0.31
    wider = change_limb(chain=(replace(SLIDER.limbs[0].chain[0], at=(0.31, 0.0, 0.0)),))
    xy = np.array([[-0.02, -0.08], [-0.06, -0.01]])
    assert_allclose(
        inverse(machine.with_values(values), xy).q, inverse(build(wider.expand()), xy).q, atol=1e-12
    )
    solution = inverse(machine, xy)
    D = differentiate_pose(
        machine, machine.values[None], solution.q[None], solution.state
    ).parameters[0, :, 3:5]
    # the whole machine turned by da moves the point by da z x (x, y)
    expected = np.stack([-xy[:, 1], xy[:, 0]], axis=1)
    assert_allclose(D[..., machine.parameters.index("turn")], expected, rtol=0, atol=1e-12)


def test_universal_joint_and_slide_equal_a_rod() -> None:
    """A rod described as universal joint, slide and ball has the length between its ends."""
    chain = (
        # along x while both angles are zero; at home it points from (0.3, 0, 0) to (0, 0, 0.4)
        Universal("U", at=(0.3, 0.0, 0.0), axes=("y", "z"), start=(-2.2, 0.0)),
        Prismatic("P", axis="x", actuated="q", start=0.5),
    )
    limb = LimbRecord(
        "leg", "ball", chain=chain, copies=Copies(3), errors=(Shifts("U1", ("x", "y")),)
    )
    record = replace(
        SLIDER,
        limbs=(limb,),
        freedoms=("x", "y", "z"),
        controlled=("x", "y", "z"),
        home=PoseRecord(z=0.4),
    )
    machine = build(record.expand())
    xyz = np.array([[-0.02, -0.08, 0.3], [0.06, -0.01, 0.5]])
    angle = 2 * np.pi / 3 * np.arange(3)
    feet = 0.3 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    distance = np.linalg.norm(xyz[:, None] - feet, axis=2)
    assert_allclose(inverse(machine, xyz).q, distance, rtol=0, atol=1e-12)  # [m]
    assert_allclose(forward(machine, distance).T[:, :3, 3], xyz, rtol=0, atol=1e-12)


def test_exceeded_joint_limits_and_cones_are_reported() -> None:
    chain = (replace(SLIDER.limbs[0].chain[0], limits=(-1.0, 0.45)),)
    machine = build(change_limb(chain=chain, cones=(RodCone("tip", "-x", 0.9),)).expand())
    # the first slide goes up with y, as long as its rod lies across; the rods lean more where the
    # point comes near them
    solution = inverse(machine, np.array([[-0.05, -0.05], [-0.05, 0.1], [0.02, -0.05]]))
    allowed, why = check_limits(machine, machine.values[None], solution.q[None], solution.state)
    assert allowed.tolist() == [[True, False, False]]
    assert why[0, 1].data["name"] == "rod1.P1"
    assert why[0, 1].data["value"] == (pytest.approx(457.071, abs=1e-3), "mm")
    assert (why[0, 1].data["low"], why[0, 1].data["high"]) == ((-1e3, "mm"), (450.0, "mm"))
    assert why[0, 2].data["name"] == "inclination of rod1 at its tip"


INVALID_RECORDS = {
    "branch": (
        replace(SLIDER, limbs=(*SLIDER.limbs, replace(SLIDER.limbs[0], name="branch", on="rod"))),
        "limb 'branch1' names 'rod', which is not a body. Add it to `bodies:`",
    ),
    "end on a limb": (change_limb(to="elbow"), "limb 'rod1' names 'elbow', which is not a body"),
    "idle drive": (
        replace(SLIDER, drives={**SLIDER.drives, "z": LengthDrive(reads="length")}),
        "'z' drives no joint",
    ),
    "wrong drive": (
        replace(SLIDER, drives={"q": AngleDrive(reads="angle")}),
        "drives a joint that slides. Give reads: length",
    ),
    "no such term": (
        replace(SLIDER, drives={"q": LengthDrive(reads="length", unknown=("radius",))}),
        "no term 'radius'. Allowed: offset, gain, curve, backlash",
    ),
    "no period": (
        replace(SLIDER, drives={"q": LengthDrive(reads="length", unknown=("sin1",))}),
        "has sin1, but no period",
    ),
    "no such element": (
        change_limb(errors=(Shifts("hinge", ("x",)),)),
        "'rod1' has no 'hinge'; it has P1, tip, platform",
    ),
    "length of no rod": (
        change_limb(errors=(Shifts("P1", ("length",)),)),
        "'length' belongs to a rod",
    ),
    "rod of a ball": (
        change_limb(ending="ball"),
        "ends ball and has a length, drive or cone of a rod",
    ),
    "tilt alone": (
        change_limb(
            chain=(Revolute("R"),), actuated="q", errors=(Tilts("R1", ("rx",), alone=True),)
        ),
        "which only a slide allows",
    ),
    "axis zero": (
        change_limb(chain=(Prismatic("P", axis=(0.0, 0.0, 0.0), actuated="q"),)),
        "Give a direction",
    ),
    "no copies": (change_limb(copies=Copies(0)), "has 0 copies"),
    "copies about no axis": (
        change_limb(copies=Copies(3, (0.0, 0.0, 0.0))),
        "a copy has the axis [0, 0, 0]. Give a direction",
    ),
    "unknown owner": (
        replace(SLIDER, parameters=(NamedLength("r", 0.1, (MapEntry("arm", "P1", "x"),)),)),
        "'r' maps onto 'arm', which does not exist. Known: rod, q1, q2",
    ),
}


@pytest.mark.parametrize("case", INVALID_RECORDS)
def test_invalid_limb_record_is_refused_in_one_sentence(case: str) -> None:
    record, sentence = INVALID_RECORDS[case]
    if case == "wrong drive":
        record = replace(
            record, limbs=(replace(record.limbs[0], errors=(Shifts("rod", ("length",)),)),)
        )
    with pytest.raises(MechanismError) as result:
        record.expand()
    assert sentence in str(result.value)
    assert "\n" not in str(result.value)


def test_unknown_joint_kind_is_reported_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(TRIPOD.replace("joint: R", "joint: Q"))
    with pytest.raises(LoopcalError, match=r"wrong.yaml:13: .*'Q'"):
        load_robot(path)


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
    """Named parameters keep their names, drives and couplings have one offset, no column is
    duplicated.
    """
    ideal, complete = (
        load_robot(name),
        load_changed_robot(tmp_path, name, more="error_model: complete"),
    )
    assert set(ideal.parameters.names) <= set(complete.parameters.names)
    assert len(complete.parameters) > len(ideal.parameters)
    for row in complete.assembly.rows:
        assert complete.parameters.names.count(f"{row.name}.offset") == 1
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
            "five-bar names no controlled coordinate. Give one for each freedom under controlled:, "
            "of x, y, z, roll, pitch, yaw, phi, theta, psi"
        ),
    ),
    "controlled empty": (
        ("controlled: [x, y]", "controlled: []"),
        "five-bar names no controlled coordinate",
    ),
    "freedoms empty": (
        ("freedoms: [x, y]", "freedoms: []"),
        "five-bar has no freedoms. Give those of its platform, of rx,",
    ),
    "freedoms twice": (
        ("freedoms: [x, y]", "freedoms: [x, x, y]"),
        "duplicate freedom 'x' in x, x, y. Name each once",
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
            "actuator 'q' drives no joint. Write 'actuated: q' at one, or leave it out. "
            "w1, w2, w3 drive joints"
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
    with pytest.raises(LoopcalError, match="w1, w2, w3 drive joints"):
        load_robot(path)


def test_file_without_limbs_is_refused(tmp_path: Path) -> None:
    text = find_robot_file("rotary-delta").read_text()
    path = tmp_path / "none.yaml"
    path.write_text(text[: text.index("limbs:\n")] + "limbs: []\n" + text[text.index("home:") :])
    with pytest.raises(
        LoopcalError,
        match=r"rotary-delta has no limbs. Write those that join the base to the platform",
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
        "parameter 'p' is an angle and x of 'arm' a length. Give an `arm:` [length per radian]",
    ),
    "angle onto rod": (
        ("angle", "limb: arm, element: rod, axis: length"),
        "is an angle and length of 'arm' a length. Give an",
    ),
    "ratio onto x": (
        ("ratio", ON_ARM + "x"),
        "parameter 'p' is a ratio and x of 'arm' a length. Give an `arm:`",
    ),
    "length onto rx": (
        ("length", ON_ARM + "rx"),
        "parameter 'p' is a length and rx of 'arm' an angle. Give it as an angle",
    ),
    "arm of a length": (
        ("length", ON_ARM + "x, arm: 2"),
        "parameter 'p' is a length with an arm. Leave the arm out",
    ),
    "arm onto rx": (
        ("angle", ON_ARM + "rx, arm: 2"),
        "is an angle with an arm and rx of 'arm' an angle. Leave the arm out",
    ),
    "length onto offset": (
        ("length", "limb: q1, element: transmission, axis: offset"),
        "is a length and offset of 'q1' an angle. Give it as an angle",
    ),
    "angle onto gain": (
        ("angle", "limb: q1, element: transmission, axis: gain"),
        "is an angle and gain of 'q1' a ratio. Give it as a ratio",
    ),
    "pitch": (
        ("length", ON_ARM + "pitch"),
        "parameter 'p' maps onto 'pitch'. Use lead, the advance in one turn",
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
