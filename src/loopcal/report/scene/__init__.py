# SPDX-License-Identifier: Apache-2.0
"""A robot with its measured poses in space, for pictures and for the interactive 3-D view.

`robot_parts.py` has the parts of a robot, `scene.py` the errors at measured poses, and
`scene_data.py` writes both for the script `viewer.min.js`, which `make viewer` builds from
tools/viewer.
"""
