# SPDX-License-Identifier: Apache-2.0
"""Golden results: numbers computed by loopcal before its redesign, and the code that computes them
again.
"""
