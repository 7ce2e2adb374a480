# SPDX-License-Identifier: Apache-2.0
"""Use a calibration: validation, accuracy over the workspace, compensation."""
