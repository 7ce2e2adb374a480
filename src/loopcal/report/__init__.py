# SPDX-License-Identifier: Apache-2.0
"""Results as people look at them: pictures."""

from loopcal.report.robot_drawing import draw as draw
from loopcal.report.robot_drawing import save_picture as save_picture
