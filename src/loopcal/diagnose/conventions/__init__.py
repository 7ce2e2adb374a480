# SPDX-License-Identifier: Apache-2.0
"""Check conventions: units, orders, signs, columns and setup parameters of measurements."""
