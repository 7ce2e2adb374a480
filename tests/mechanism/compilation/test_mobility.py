# SPDX-License-Identifier: Apache-2.0
"""Mechanisms that cannot work are refused when they are built, with the correction to make."""

from dataclasses import replace

import numpy as np
import pytest

from loopcal import load_robot
from loopcal.errors import MechanismError
from loopcal.mechanism.assembly import Actuator, Address, Joint, Limb, LinearMap, Link
from loopcal.mechanism.compilation import build
from loopcal.parameters import Parameter
from loopcal.units import Dimension
from tests import zoo


def strip_parameters(assembly, **changes):
    """Return the assembly without parameters and with these changes."""
    return replace(assembly, parameters=(), maps=(), shared=(), **changes)


HEXAPOD = strip_parameters(zoo.hexapod().assembly)
PRS = strip_parameters(zoo.three_prs().assembly)


def change_limb(assembly, i, **changes):
    limbs = list(assembly.limbs)
    limbs[i] = replace(limbs[i], **changes)
    return replace(assembly, limbs=tuple(limbs))


def make_five_legs():
    return replace(HEXAPOD, limbs=HEXAPOD.limbs[:5], actuators=HEXAPOD.actuators[:5])


def add_fixed_rod():
    """Return a hexapod with a seventh rod of fixed length."""
    rod = replace(
        HEXAPOD.limbs[0], name="rod", actuator=None, attachment=HEXAPOD.limbs[3].attachment
    )
    gap = HEXAPOD.home @ rod.attachment.transform[:, 3] - rod.links[0].transform[:, 3]
    return replace(HEXAPOD, limbs=(*HEXAPOD.limbs, replace(rod, length=float(np.linalg.norm(gap)))))


def make_singular_hexapod():
    """Return a hexapod whose platform is similar and parallel to the base: it is singular."""
    base = zoo.HEXAPOD_BASE * zoo.MM
    limbs = tuple(
        replace(
            limb,
            links=(Link("base", zoo.place(b)),),
            attachment=Link("platform", zoo.place(0.6 * b)),
        )
        for limb, b in zip(HEXAPOD.limbs, base, strict=True)
    )
    return replace(HEXAPOD, limbs=limbs)


INVALID_ASSEMBLIES = {
    "five legs": (
        make_five_legs,
        (
            r"hexapod: at home the platform can still move with every actuator locked "
            r"\((rotation|translation) .*5 of 6 freedoms"
        ),
    ),
    "similar base and platform": (make_singular_hexapod, r"at home the platform can still move"),
    "a rod too many": (
        add_fixed_rod,
        r"hexapod is over-constrained: it has 6 actuators, but .* only 5 of 6 freedoms",
    ),
    "a coordinate too few": (
        lambda: replace(PRS, controlled=("z",)),
        r"3-PRS can be moved in 3 freedoms or more, but names only 1 controlled coordinates",
    ),
    "a coordinate that cannot be controlled": (
        lambda: replace(PRS, controlled=("z", "x", "psi")),
        r"cannot be set independently at home",
    ),
    "an unknown coordinate": (
        lambda: replace(PRS, controlled=("z", "tilt", "x")),
        r"'tilt' is not a platform coordinate; allowed are x, y, z",
    ),
    "an unknown freedom": (
        lambda: replace(PRS, freedoms=("x", "w")),
        r"'w' is not a freedom of a platform; allowed are rx, ry",
    ),
    "two rotations": (
        lambda: replace(PRS, freedoms=("rx", "ry", "z")),
        r"3-PRS has the freedoms rx and ry, which define no pose: .* add a limb with the joint",
    ),
    "an unknown ending": (
        lambda: change_limb(PRS, 0, ending="magnet"),
        r"limb 'limb1' ends in 'magnet'; allowed endings are rigid, ball, distance",
    ),
    "a link too few": (
        lambda: change_limb(PRS, 0, links=PRS.limbs[0].links[:2]),
        r"limb 'limb1' has 2 joints and 2 links; give one link more than joints",
    ),
    "two limbs of one name": (
        lambda: change_limb(PRS, 1, name="limb1"),
        r"two limbs are called 'limb1'; give each its own name",
    ),
    "an actuator twice": (
        lambda: replace(HEXAPOD, actuators=HEXAPOD.actuators[:1] * 2),
        r"two actuators are called 'q1'",
    ),
    "an actuator without a joint": (
        lambda: replace(
            HEXAPOD, actuators=(*HEXAPOD.actuators, Actuator("spare", Dimension.LENGTH))
        ),
        r"actuator 'spare' drives 0 joints; let it drive one",
    ),
    "a joint with an unknown actuator": (
        lambda: change_limb(HEXAPOD, 2, actuator="q9"),
        r"(actuator 'q3' drives 0 joints|driven by 'q9')",
    ),
    "an actuator that is not listed": (
        lambda: replace(HEXAPOD, actuators=HEXAPOD.actuators[:5]),
        r"a joint is driven by 'q6', which is not among the actuators; add it or correct the name",
    ),
    "legs that are too short": (
        lambda: replace(
            change_limb(HEXAPOD, 0, actuator=None, length=0.01),
            actuators=HEXAPOD.actuators[1:],
            controlled=("x", "y", "z", "phi", "theta"),
        ),
        r"the loops of hexapod cannot be closed at its home pose: .* mm stay open",
    ),
}


def test_singular_home_is_called_singular_and_its_actuators_are_named(root, tmp_path) -> None:
    """Arm and rod of every limb are in one line: 300 mm - 75 mm = 112.5 mm + 112.5 mm."""
    text = (root / "src" / "loopcal" / "robots" / "3-rrr.yaml").read_text("utf-8")
    stretched = text.replace("tip: [180, 0, 0]", "tip: [112.5, 0, 0]")
    stretched = stretched.replace("length: 180", "length: 112.5").replace(
        "start: 129", "start: 180"
    )
    (tmp_path / "robot.yaml").write_text(stretched, "utf-8")
    sentence = "home pose is singular: there, q1, q2 and q3 do not move the platform"
    with pytest.raises(MechanismError, match=sentence) as error:
        load_robot(tmp_path / "robot.yaml")
    assert "stay open" not in str(error.value)


@pytest.mark.parametrize("case", INVALID_ASSEMBLIES)
def test_invalid_mechanism_is_refused_in_one_sentence(case):
    make, sentence = INVALID_ASSEMBLIES[case]
    with pytest.raises(MechanismError, match=sentence) as error:
        build(make())
    assert "\n" not in str(error.value)


def test_parameter_with_an_unknown_address_is_refused():
    parameter = Parameter("a", Dimension.LENGTH, 0.0)
    for address in (
        Address("leg1", "knee", "x"),
        Address("leg1", "rod", "pitch"),
        Address("q1", "transmission", "tooth"),
        Address("leg9", "base", "x"),
    ):
        wrong = replace(HEXAPOD, parameters=(parameter,), maps=(LinearMap("a", address),))
        with pytest.raises(
            MechanismError, match=f"mapped onto {address}, which this mechanism does not have"
        ):
            build(wrong)


def test_serial_arm_is_a_valid_mechanism():
    limb = Limb(
        "arm", (Link("base", np.eye(4)), Link("upper", zoo.place((0.3, 0, 0))), Link("lower", zoo.place((0.2, 0, 0)))),  # noqa: E501
        (Joint("a", "R", "q1", start=0.3), Joint("b", "R", "q2", start=0.8)), "ball", Link("hand", np.eye(4)),  # noqa: E501
    )  # fmt: skip
    robot = build(
        zoo.assemble("arm", (limb,), ("x", "y"), ("x", "y"), zoo.place((0.35, 0.25, 0.0)))
    )
    assert robot.home_state.status[0, 0] == 0
