# SPDX-License-Identifier: Apache-2.0
"""Kinds that measure the pose of the robot's tool, or some of its coordinates."""
