# SPDX-License-Identifier: Apache-2.0
"""Small files of other programs, of machines with our own dimensions."""

REPRAP = """\
; config-override.g, ours ; keep
M665 L269.100:269.200:269.300 R130.250 H301.500 B140.0 X-0.100 Y0.200 Z0.000
G28 ; home
M666 X0.500 Y-0.200 Z-0.300 A0.00 B0.00
M307 H0 A139.0 X9
"""

MARLIN = """\
echo:; Delta settings:
echo:  M665 L269.10 R130.25 H300.00 S100.00 X-0.10 Y0.20 Z0.00 A0.00 B0.10 C-0.10
echo:  M666 X-0.50 Y0.00 Z-0.25
echo:  M851 X0.00 Y0.00 Z-1.50 ; (mm)
"""

_STEPPER = """
[stepper_{axis}]
step_pin: PE{k}
rotation_distance: 40
microsteps: 16
homing_speed: 60
"""

DELTA_PROBES = (
    """\
# A delta printer ; everything here stays as it is
[printer]
kinematics: delta
max_velocity: 300
delta_radius: 105.2   # mm

[delta_calibrate]
radius: 50
"""
    + "".join(_STEPPER.format(axis=axis, k=k) for k, axis in enumerate("abc"))
    + """
#*# <---------------------- SAVE_CONFIG ---------------------->
#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.
#*#
"""
    + "".join(
        f"#*# [stepper_{axis}]\n#*# angle = {angle}\n#*# arm_length = 220.0\n"
        f"#*# position_endstop = {stop}\n#*#\n"
        for axis, angle, stop in (
            ("a", "210.05", "300.1"),
            ("b", "329.9", "299.9"),
            ("c", "90.0", "300.0"),
        )
    )
    + "#*# [delta_calibrate]\n"
    + "".join(
        f"#*# height{i} = {z}\n#*# height{i}_pos = {steps}\n"
        for i, (z, steps) in enumerate(
            [
                (0.01, "8516.000,8480.000,8499.000"),
                (-0.02, "9712.000,8089.000,8106.000"),
                (0.03, "8240.000,9790.000,8022.000"),
                (0.0, "8230.000,8043.000,9790.000"),
                (0.01, "7670.000,8907.000,8930.000"),
                (0.02, "8990.000,7560.000,8960.000"),
                (-0.01, "8960.000,8970.000,7580.000"),
            ]
        )
    )
)


def _list_pins() -> str:
    """Return the joint centers of an octahedral hexapod as lines of a HAL file."""
    base = [
        (120, -140),
        (120, 140),
        (61.24, 173.92),
        (-181.24, 33.92),
        (-181.24, -33.92),
        (61.24, -173.92),
    ]
    platform = [
        (120, -20),
        (120, 20),
        (-42.68, 113.92),
        (-77.32, 93.92),
        (-77.32, -93.92),
        (-42.68, -113.92),
    ]
    return "".join(
        f"setp genhexkins.{of}.{n}.{axis} {value}\n"
        for of, points in (("base", base), ("platform", platform))
        for n, point in enumerate(points)
        for axis, value in zip("xyz", (*point, 0.0), strict=True)
    )


GENHEX = f"# a hexapod\nloadrt genhexkins\n{_list_pins()}net xpos joint.0.motor-pos-cmd\n"


def _joint(name: str, kind: str, parent: str, child: str, xyz: str, rpy: str = "0 0 0") -> str:
    return (
        f'  <link name="{child}"/>\n'
        f'  <joint name="{name}" type="{kind}">\n    <origin xyz="{xyz}" rpy="{rpy}"/>\n'
        f'    <parent link="{parent}"/>\n    <child link="{child}"/>\n'
        '    <axis xyz="0 0 1"/>\n  </joint>\n'
    )


URDF = (
    '<?xml version="1.0"?>\n<robot name="five-bar">\n  <link name="base"/>\n'
    + _joint("mot1", "revolute", "base", "arm1", "-0.075 0 0", "0 0 2.3")
    + _joint("elbow1", "revolute", "arm1", "rod1", "0.2 0 0", "0 0 -1.2")
    + _joint("closedloop1_A", "revolute", "rod1", "pin1", "0.3 0 0")
    + _joint("mot2", "revolute", "base", "arm2", "0.075 0 0", "0 0 0.84")
    + _joint("elbow2", "revolute", "arm2", "rod2", "0.2 0 0", "0 0 1.2")
    + _joint("closedloop1_B", "revolute", "rod2", "pin2", "0.3 0 0")
    + _joint("tip_frame", "fixed", "rod1", "tip", "0.3 0 0")
    + "</robot>\n"
)

CONSTRAINED = URDF.replace(
    "</robot>",
    '  <constraint name="brace" type="spherical">\n    <parent link="rod1"/>\n'
    '    <parent_origin xyz="0.3 0 0"/>\n    <child link="rod2"/>\n'
    '    <child_origin xyz="0.3 0 0"/>\n  </constraint>\n'
    '  <transmission name="t1"><joint name="mot1"/></transmission>\n'
    '  <transmission name="t2"><joint name="mot2"/></transmission>\n</robot>\n',
)

CLOSURES = "closed_loop: [[closedloop1_A, closedloop1_B]]\ntype: ['6d']\nname_mot: [mot1, mot2]\n"

SDF = (
    '<sdf version="1.8"><model name="five-bar">\n<link name="base"/>\n'
    + "".join(
        f'<link name="{link}"><pose>{pose}</pose></link>\n'
        for link, pose in (
            ("arm1", "-0.075 0 0 0 0 2.3"),
            ("rod1", "-0.208 0.149 0 0 0 0.3"),
            ("arm2", "0.075 0 0 0 0 0.84"),
            ("rod2", "0.208 0.149 0 0 0 2.8"),
        )
    )
    + "".join(
        f'<joint name="{name}" type="revolute"><parent>{a}</parent><child>{b}</child>\n'
        f"<pose>{x} 0 0 0 0 0</pose><axis><xyz>0 0 1</xyz></axis></joint>\n"
        for name, a, b, x in (
            ("mot1", "base", "arm1", 0),
            ("elbow1", "arm1", "rod1", 0),
            ("mot2", "base", "arm2", 0),
            ("elbow2", "arm2", "rod2", 0),
            ("tip", "rod1", "rod2", 0.22),
        )
    )
    + '<link name="tool"><pose relative_to="rod1">0.22 0 0 0 0 0</pose></link>\n'
    '<joint name="flange" type="fixed"><parent>rod1</parent><child>tool</child></joint>\n'
    '<plugin name="c"><joint_name>mot1</joint_name><joint_name>mot2</joint_name></plugin>\n'
    "</model></sdf>\n"
)

MJCF = """<mujoco><worldbody>
<body name="arm1" pos="-0.075 0 0" euler="0 0 131.8"><joint name="mot1"/>
<body name="rod1" pos="0.2 0 0" euler="0 0 -114.6"><joint name="elbow1"/>
<body name="tool" pos="0.22 0 0"/></body></body>
<body name="arm2" pos="0.075 0 0" quat="0.913 0 0 0.408"><joint name="mot2"/>
<body name="rod2" pos="0.2 0 0" axisangle="0 0 1 112.3"><joint name="elbow2"/></body></body>
</worldbody>
<equality><connect name="tip" body1="rod1" body2="rod2" anchor="0.22 0 0"/></equality>
<actuator><motor joint="mot1"/><motor joint="mot2"/></actuator></mujoco>
"""

ROTARY = """\
[printer]
kinematics: rotary_delta
shoulder_radius: 33.9
shoulder_height: 412.9
[stepper_a]
gear_ratio: 107.000:16, 60:16
microsteps: 16
position_endstop: 252
upper_arm_length: 170
lower_arm_length: 320
[stepper_b]
gear_ratio: 107.000:16, 60:16
microsteps: 16
[stepper_c]
gear_ratio: 107.000:16, 60:16
microsteps: 16
angle: 270.3
#*# <---------------------- SAVE_CONFIG ---------------------->
#*# [delta_calibrate]
#*# height0 = 0.003
#*# height0_pos = 20774.917,20864.322,20800.461
"""

SOURCES = {
    "printer.cfg": DELTA_PROBES,
    "rotary.cfg": ROTARY,
    "robot.g": REPRAP,
    "marlin.g": MARLIN,
    "hexapod.hal": GENHEX,
    "robot.urdf": URDF,
    "constrained.urdf": CONSTRAINED,
    "robot.sdf": SDF,
    "robot.xml": MJCF,
    "loops.yaml": CLOSURES,
}
"""Files by name."""
