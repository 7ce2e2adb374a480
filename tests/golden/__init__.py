# SPDX-License-Identifier: Apache-2.0
"""Golden results: numbers that loopcal computed before its redesign, and the means to compute them
again.
"""
