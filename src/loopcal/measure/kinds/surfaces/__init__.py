# SPDX-License-Identifier: Apache-2.0
"""Kinds that touch a surface with points of the platform: plane, line, sphere."""
