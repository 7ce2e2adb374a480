# SPDX-License-Identifier: Apache-2.0
"""Nuisance parameters of measurements: their elimination, and their estimates after a fit."""
