# SPDX-License-Identifier: Apache-2.0
"""Measurements: kinds, instruments, observations, nuisance parameters, and their simulation."""
