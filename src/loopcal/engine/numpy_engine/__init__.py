# SPDX-License-Identifier: Apache-2.0
"""The engine in NumPy: always present, and the specification of every other engine."""
