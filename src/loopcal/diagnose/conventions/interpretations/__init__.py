# SPDX-License-Identifier: Apache-2.0
"""Other interpretations of measurements: of their values, readings, zeros and setups."""
