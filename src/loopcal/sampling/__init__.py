# SPDX-License-Identifier: Apache-2.0
"""Uncertainty beyond the linear interval: block bootstrap, sampled posterior, joint regions."""
