# SPDX-License-Identifier: Apache-2.0
"""The engine in NumPy: always present, and the specification of every other engine.

Its functions are put together in `loopcal.engine.selection`, where it is chosen: another engine
imports a few of them, and leaves the others.
"""
