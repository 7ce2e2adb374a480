# SPDX-License-Identifier: Apache-2.0
"""The table of unknowns knows its names and keeps its numbers to itself."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from loopcal.errors import MechanismError
from loopcal.parameters import Parameter, ParameterTable
from loopcal.units import Dimension

TABLE = ParameterTable(
    (
        Parameter("leg1.base.x", Dimension.LENGTH, 0.12, 1e-4),
        Parameter("leg1.base.y", Dimension.LENGTH, -0.14),
        Parameter("tower1.angle", Dimension.ANGLE, 0.5, 1e-3, free=False),
    )
)


def test_a_table_lists_its_columns_in_order():
    assert len(TABLE) == 3
    assert TABLE.names == ("leg1.base.x", "leg1.base.y", "tower1.angle")
    assert TABLE.dimensions == (Dimension.LENGTH, Dimension.LENGTH, Dimension.ANGLE)
    assert_array_equal(TABLE.nominal, [0.12, -0.14, 0.5])
    assert_array_equal(TABLE.tolerance, [1e-4, np.nan, 1e-3])
    assert_array_equal(TABLE.free, [True, True, False])


def test_arrays_of_a_table_are_read_only():
    for array in (TABLE.nominal, TABLE.tolerance, TABLE.free):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_a_parameter_is_found_by_name():
    assert TABLE.index("leg1.base.y") == 1


def test_a_wrong_name_is_answered_with_the_nearest():
    with pytest.raises(
        MechanismError, match=r"unknown parameter 'leg1.base.z'; similar names are leg1.base.[xy]"
    ):
        TABLE.index("leg1.base.z")


def test_a_name_used_twice_is_refused():
    with pytest.raises(MechanismError, match=r"duplicate parameter 'leg1\.base\.x'"):
        ParameterTable((TABLE.entries[0], TABLE.entries[0]))


def test_only_frees_the_chosen_and_fixes_the_rest():
    chosen = TABLE.with_free(["tower1.angle"])
    assert_array_equal(chosen.free, [False, False, True])
    assert_array_equal(TABLE.free, [True, True, False])
    with pytest.raises(MechanismError, match="unknown parameter"):
        TABLE.with_free(["leg2.length"])
