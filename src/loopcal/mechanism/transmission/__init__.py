# SPDX-License-Identifier: Apache-2.0
"""Transmissions: from the reading of an actuator to the value of its joint, and back.

Offsets, scales and harmonics (`terms`), sums of joint values (`sums`), and linear actuators that
turn a joint (`triangle`). These modules know values only, no compiled mechanism.
"""
