# SPDX-License-Identifier: Apache-2.0
"""Compilation of an assembly into a mechanism, and what is checked on the way."""
