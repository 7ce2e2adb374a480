# SPDX-License-Identifier: Apache-2.0
"""Mechanisms: records and families of robots, compilation, kinematics and sensitivities."""
