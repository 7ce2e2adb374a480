# SPDX-License-Identifier: Apache-2.0
"""Whole tasks as one call each: what the commands do, for Python users."""
