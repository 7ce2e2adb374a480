# SPDX-License-Identifier: Apache-2.0
"""Kinds that measure points of the platform: positions, angles, distances."""
