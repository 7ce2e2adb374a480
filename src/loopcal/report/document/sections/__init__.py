# SPDX-License-Identifier: Apache-2.0
"""The sections of the report of a calibration, one module for each group of them."""
