# SPDX-License-Identifier: Apache-2.0
"""Tests mirror the modules of the package; tests/zoo.py holds the small robots they share."""
