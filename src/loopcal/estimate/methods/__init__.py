# SPDX-License-Identifier: Apache-2.0
"""Estimation methods as small values: penalties, rules that choose them, and losses."""
