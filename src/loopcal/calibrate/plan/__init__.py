# SPDX-License-Identifier: Apache-2.0
"""Planning: which poses to measure, how good they are, and how far from the best possible."""
