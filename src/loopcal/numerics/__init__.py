# SPDX-License-Identifier: Apache-2.0
"""Linear algebra of least squares."""
