# SPDX-License-Identifier: Apache-2.0
"""Kinematics: poses from readings and readings from poses, in the mode of a start."""
