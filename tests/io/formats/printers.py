# SPDX-License-Identifier: Apache-2.0
"""Records of real delta printers as printer.cfg, with our own lines around their numbers."""

from typing import Any

HEAD = """\
# Our printer ; everything here stays as it is
[include fans.cfg]
[mcu]
serial: /dev/serial/by-id/usb-Klipper   # ends here

[printer]
kinematics: delta
max_velocity: 300
delta_radius: {radius}   # mm

[delta_calibrate]
radius: 70
horizontal_move_z: 30
"""
STEPPER = """
[stepper_{axis}]
step_pin: PE{k}
{step}
homing_speed: 60
"""
SAVED = """
#*# <---------------------- SAVE_CONFIG ---------------------->
#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.
#*#
"""


def format_printer_cfg(record: dict[str, Any], stop_offset: float = 0.0) -> str:
    """Return the text of a printer.cfg without Klipper's defaults.

    The numbers of tower a are in the main part, the others in the saved block.

    Parameters
    ----------
    record : of LOOPCAL_DATA/delta_printers. stop_offset : added to every end stop [mm].
    """
    found = record["geometry_stored_in_config"]
    text = HEAD.format(radius=found["radius"])
    saved = ""
    for k, axis in enumerate("abc"):
        # half of the step by a gear of 2:1, so that all of Klipper's ways to say it are read
        rotation = found["stepdist"][k] * 200 * 16
        step = [
            f"rotation_distance: {rotation!r}\nmicrosteps: 16",
            f"step_distance = {found['stepdist'][k]!r}",
        ][k % 2]
        if k == 2:
            step = f"rotation_distance: {rotation!r}\nmicrosteps: 4\nfull_steps_per_rotation: 400\ngear_ratio: 80:40"  # noqa: E501
        text += STEPPER.format(axis=axis, k=k, step=step)
        stop = f"position_endstop = {found['endstops'][k] + stop_offset:.6f}"
        lines = [f"angle = {found['angles'][k]:.6f}", f"arm_length = {found['arms'][k]:.6f}", stop]
        if k == 0:
            text += "\n".join(line.replace(" = ", ": ") for line in lines) + "\n"
            continue
        if k == 2 and found["angles"][k] == 90.0:
            lines = lines[1:]
        saved += "".join(f"#*# {line}\n" for line in (f"[stepper_{axis}]", *lines)) + "#*#\n"
    return (
        text
        + "gcode: ; not ours\n    G28\n"
        + SAVED
        + saved
        + "#*# [delta_calibrate]\n"
        + _format_probes(record)
    )


def _format_probes(record: dict[str, Any]) -> str:
    lines = []
    for name, rows in (("height", record["heights"]), ("manual_height", record["manual_heights"])):
        for i, row in enumerate(rows):
            lines += [
                f"{name}{i} = {row['z_mm']}",
                f"{name}{i}_pos = {_format_steps(row['stable_steps'])}",
            ]
    for i, row in enumerate(record["distances"]):
        lines.append(f"distance{i} = {row['d_mm']}")
        lines += [f"distance{i}_pos{n} = {_format_steps(row[f'stable_steps_{n}'])}" for n in (1, 2)]
    return "".join(f"#*# {line}\n" for line in lines)


def _format_steps(steps: list[float]) -> str:
    return ",".join(f"{value:.3f}" for value in steps)
