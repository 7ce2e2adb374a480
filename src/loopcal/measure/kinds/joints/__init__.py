# SPDX-License-Identifier: Apache-2.0
"""Kinds that measure joints: sensors on joints, locked joints, readings of the actuators."""
