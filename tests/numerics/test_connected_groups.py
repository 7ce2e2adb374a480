# SPDX-License-Identifier: Apache-2.0
"""Items are in one group where links join them."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from loopcal.numerics.elimination import find_connected_groups


@pytest.mark.parametrize("seed", range(20))
def test_groups_are_those_of_a_library_numbered_by_first_items(seed: int) -> None:
    draw = np.random.default_rng(seed)
    count = int(draw.integers(1, 60))
    links = draw.integers(0, count, (int(draw.integers(0, 80)), 2))
    groups = find_connected_groups(links, count)
    graph = coo_array((np.ones(len(links)), links.T), shape=(count, count))
    member = connected_components(graph, directed=False)[1]
    same = groups[:, None] == groups
    np.testing.assert_array_equal(same, member[:, None] == member)
    _, first = np.unique(groups, return_index=True)
    assert (np.diff(first) > 0).all()  # numbered by first items
    assert groups.dtype == np.int64


def test_a_long_chain_in_any_order_is_one_group() -> None:
    order = np.random.default_rng(0).permutation(20_000)
    links = np.column_stack([order[:-1], order[1:]])
    assert not find_connected_groups(links, len(order)).any()


def test_items_without_links_are_groups_of_their_own() -> None:
    assert find_connected_groups(np.zeros((0, 2), dtype=np.int64), 3).tolist() == [0, 1, 2]
