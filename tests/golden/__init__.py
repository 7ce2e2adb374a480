# SPDX-License-Identifier: Apache-2.0
"""Golden results: numbers that loopcal computed, and the code that computes them again."""
