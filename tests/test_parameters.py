# SPDX-License-Identifier: Apache-2.0
"""The parameter table: names, columns, read-only arrays."""

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


def test_parameter_table_lists_its_columns_in_order():
    assert len(TABLE) == 3
    assert TABLE.names == ("leg1.base.x", "leg1.base.y", "tower1.angle")
    assert TABLE.dimensions == (Dimension.LENGTH, Dimension.LENGTH, Dimension.ANGLE)
    assert_array_equal(TABLE.nominal, [0.12, -0.14, 0.5])
    assert_array_equal(TABLE.tolerance, [1e-4, np.nan, 1e-3])
    assert_array_equal(TABLE.free, [True, True, False])


def test_parameter_table_arrays_are_read_only():
    for array in (TABLE.nominal, TABLE.tolerance, TABLE.free):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_index_of_a_parameter_is_its_place():
    assert TABLE.index("leg1.base.y") == 1


def test_unknown_parameter_is_refused_with_similar_names():
    with pytest.raises(
        MechanismError, match=r"unknown parameter 'leg1.base.z' \(did you mean 'leg1.base.[xy]'"
    ):
        TABLE.index("leg1.base.z")


def test_duplicate_parameter_is_refused():
    with pytest.raises(MechanismError, match=r"duplicate parameter 'leg1\.base\.x'"):
        ParameterTable((TABLE.entries[0], TABLE.entries[0]))


def test_with_free_frees_only_the_named_parameters():
    chosen = TABLE.with_free(["tower1.angle"])
    assert_array_equal(chosen.free, [False, False, True])
    assert_array_equal(TABLE.free, [True, True, False])
    with pytest.raises(MechanismError, match="unknown parameter"):
        TABLE.with_free(["leg2.length"])
