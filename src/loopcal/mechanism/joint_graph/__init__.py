# SPDX-License-Identifier: Apache-2.0
"""Mechanisms given as bodies and joints, such as a URDF with closures, divided into limbs."""
