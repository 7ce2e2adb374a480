# SPDX-License-Identifier: Apache-2.0
"""Many rows of a trial are folded by parts, as if they had been written: with the same bits."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from loopcal.engine import TwistRows
from loopcal.io.robot.robot_file import load_robot
from tests.engine.cases import draw_map, make_case
from tests.engine.native.instruction_sets import make_engines

ENGINES = make_engines()


def write_rows(D, rows):
    """Return the rows (t, m, p + 1) by sums in the order of the engine."""
    of_rows = D[:, rows.poses][:, :, None]
    columns = sum(rows.by_twist[..., f, None] * of_rows[..., f, :] for f in range(6))
    whole = np.concatenate([columns, rows.residual[..., None]], axis=-1)
    return whole.reshape(len(whole), -1, whole.shape[-1])


@pytest.mark.parametrize("choose", ["each pose", "no whole block", "poses without rows", "uneven"])
def test_parts_have_the_bits_of_written_rows(choose):
    n, t, rng = 1001, 2, np.random.default_rng(0)
    poses = {
        "each pose": np.arange(n - 1),
        "no whole block": np.arange(n),
        "poses without rows": np.arange(0, n, 2).repeat(2),
        "uneven": np.sort(rng.integers(0, n, n)),
    }[choose]
    for engine in ENGINES.values():
        case = make_case(load_robot("hexapod-42"), t=t, n=n)
        state = engine.solve(case.program, case.e, case.q, case.home)
        T = state.T.copy()
        T[0, 500] = np.nan  # its rows count as zeros
        state = replace(state, T=T)
        inputs = draw_map(case.program, (t, n), True)
        width, m = inputs.pattern.parameters + 1, 3
        shape = t, len(poses), m
        observed = TwistRows(poses, rng.normal(size=(*shape, 6)), rng.normal(size=shape))
        assert len(poses) * m > 32 * width
        arguments = case.program, case.e, case.q, state, inputs
        D, _ = engine.differentiate(*arguments)
        ok = np.asarray(np.isfinite(D).all(axis=(2, 3)))
        assert not ok.all()
        clean = replace(observed, residual=np.where(ok[:, poses, None], observed.residual, 0.0))
        rows = write_rows(np.where(ok[..., None, None], D, 0.0), clean)
        start = engine.fold(np.zeros((t, width, width)), rng.normal(size=(t, width, width)))
        factor, is_finite = engine.fold_poses(start, *arguments, [observed])
        assert_array_equal(factor, engine.fold(start, rows))
        assert_array_equal(is_finite, ok | ~np.isin(np.arange(n), poses))
