# SPDX-License-Identifier: Apache-2.0
"""The compiled engine of loopcal.

It has the interface and the tests of the engine in NumPy, which stays its specification. loopcal
uses it where it is installed; the environment variable LOOPCAL_ENGINE can name another engine, or
an instruction set of this one (`native:v3`).
"""

from loopcal_native.engine import make_engine as make_engine
from loopcal_native.library import list_instruction_sets as list_instruction_sets
