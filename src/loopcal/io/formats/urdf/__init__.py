# SPDX-License-Identifier: Apache-2.0
"""URDF with loop closures: read as a robot file, written with corrected joint origins."""
