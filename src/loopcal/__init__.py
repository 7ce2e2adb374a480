# SPDX-License-Identifier: Apache-2.0
"""Geometric calibration of parallel robots."""

__version__ = "0.1.0.dev0"
