# SPDX-License-Identifier: Apache-2.0
"""The 42-parameter hexapod: errors assumed, poses simulated, parameters identified leg by leg."""
