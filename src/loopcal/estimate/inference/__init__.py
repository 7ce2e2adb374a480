# SPDX-License-Identifier: Apache-2.0
"""Draw conclusions from a fit: residual test, posterior, prior of the next fit, null space."""
