# SPDX-License-Identifier: Apache-2.0
"""Rows of a problem with columns for all nuisance parameters, poses eliminated (one trial)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from loopcal.estimate.linearization import LeverageRows
from loopcal.estimate.nuisance.elimination import NodeRows, NuisanceElimination
from loopcal.estimate.poses.exact import ExactPoses
from loopcal.typing import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from loopcal.estimate.poses.uncertain import UncertainPoses

AtNodes = Callable[[IntArray], tuple[IntArray, FloatArray, FloatArray]]
"""From nodes (k,) of nuisance parameters to their paths (k, w), roots and slopes; see
`TreeElimination.at_nodes`.
"""


def spread_rows(
    poses: ExactPoses | UncertainPoses,
    rows_of_blocks: Iterable[tuple[list[NodeRows], BoolArray]],
    p: int,
    nuisance: NuisanceElimination | None,
    at_nodes: AtNodes | None,
) -> Iterator[list[LeverageRows]]:
    """Give the rows block by block, with the machine's columns as the nuisance parameters follow.

    Parameters
    ----------
    poses : of the problem. rows_of_blocks : their rows, see `ExactPoses.iterate_rows`.
    p : number of free parameters. nuisance : of the problem. at_nodes : None without any.
    """
    wide = 0 if nuisance is None else len(nuisance)
    for block, (node_rows, _) in zip(poses.blocks, rows_of_blocks, strict=True):
        of_block = []
        for part in node_rows:
            whitened = part.rows[0]
            w = whitened.shape[-1] - p - 1
            rows = np.zeros((*whitened.shape[:2], wide + p + 1))
            rows[..., -p - 1 :] = whitened[..., w:]
            if at_nodes is not None and part.structure >= 0:
                path, root, slope = at_nodes(part.nodes)
                rows[..., -p - 1 : -1] += whitened[..., :w] @ slope
                k, m = (
                    np.arange(len(whitened))[:, None, None],
                    np.arange(whitened.shape[1])[:, None],
                )
                rows[k, m, path[:, None, :]] = whitened[..., :w] @ root
            first = poses.poses_of(block, part)
            of_block.append(LeverageRows(first, rows, part.kind, part.numbers))
        yield of_block
