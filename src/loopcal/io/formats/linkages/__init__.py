# SPDX-License-Identifier: Apache-2.0
"""URDF, SDF and MJCF with closed loops: read as a robot file, written with corrected origins."""
