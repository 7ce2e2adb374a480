# SPDX-License-Identifier: Apache-2.0
"""The five machines in which mistakes are made, with their instruments."""

from pathlib import Path

from loopcal.io.robot.robot_file import find_robot_file
from tests.mistakes.workshop import Machine

HELIOSTAT = """
format: 1
family: limbs
name: heliostat
units: {length: mm, angle: deg}
controlled: [roll, pitch]
actuators:
  west: {reads: length, stroke: [400, 1100], unknown: [offset], length: {sd: 1}}
  south: {reads: length, stroke: [400, 1100], unknown: [offset], length: {sd: 1}}
limbs:
  - name: post
    chain: [{joint: U, name: head, axes: [x, y]}]
    ending: rigid
  - name: west
    chain: []
    tip: [-600, 0, -800]
    ending: distance
    actuated: west
    attach: [-500, 0, -50]
    errors: &errors
      - {of: base, shift: [x, y, z], tolerance: {sd: 1}}
      - {of: platform, shift: [x, y, z], tolerance: {sd: 1}}
  - name: south
    chain: []
    tip: [0, -600, -800]
    ending: distance
    actuated: south
    attach: [0, -500, -50]
    errors: *errors
workspace: {roll: [-25, 25], pitch: [-25, 25]}
"""


def _shipped(name: str) -> str:
    return Path(find_robot_file(name)).read_text("utf-8")


MACHINES = {
    "five-bar": Machine(
        _shipped("five-bar"), "--kind component --components x,y --sigma-position 20um", seed=2
    ),
    "3-rrr": Machine(
        _shipped("3-rrr"),
        "--kind component --orientation euler-zyx --components x,y,a --sigma-position 20um "
        "--sigma-angle 100urad",
    ),
    "6-pus": Machine(_shipped("6-pus"), "--kind pose --sigma-position 5um --sigma-angle 20urad"),
    "rotary-delta": Machine(_shipped("rotary-delta"), "--kind position --sigma-position 20um"),
    "heliostat": Machine(HELIOSTAT, "--kind inclination --sigma-angle 20urad", seed=2),
}
