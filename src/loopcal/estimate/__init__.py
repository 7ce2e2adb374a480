# SPDX-License-Identifier: Apache-2.0
"""Estimate the parameters of a robot from measurements."""
