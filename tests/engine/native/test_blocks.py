# SPDX-License-Identifier: Apache-2.0
"""Blocks of unknowns are eliminated, and points located, as in NumPy, with the same bits for every
instruction set.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from benchmarks.bench_engine import use_engine
from loopcal import geometry
from loopcal.engine import BlockRows
from loopcal.measure.kinds.position import Position
from loopcal.numerics.elimination import NodeFactors, TreeElimination, build_tree, eliminate_tree
from tests.engine.native.instruction_sets import make_engines
from tests.engine.native.test_agreement import assert_same_bits

ENGINES = make_engines()
P, SESSIONS, GROUPS = 5, 3, 4
ROTATION = ("frame.rx", "frame.ry", "frame.rz")


def draw_rows(t: int, open_trial: int | None = None, more: int = 0) -> NodeFactors:
    """Return rows of two unknowns of the machine, two of each session, and three of each of its
    groups, in t trials; in one of them the last unknown of a group has no row. With `more` rows of
    each group, those of the machine are dealt to parts.
    """
    scopes, sets, rng = ["machine"] * 2, [], np.random.default_rng(t)
    for _ in range(SESSIONS):
        session = [len(scopes), len(scopes) + 1]
        scopes += ["session"] * 2
        for _ in range(GROUPS):
            sets.append([0, 1, *session, *range(len(scopes), len(scopes) + 3)])
            scopes += ["group"] * 3
    free = np.ones(len(scopes), dtype=bool)
    free[1] = False  # a known one
    pairs = [(i, x) for i, some in enumerate(sets) for x in some]
    tree = build_tree(free, scopes, np.array(pairs))
    factors = NodeFactors(tree, t, P)
    size = 10.0 ** rng.uniform(-3, 3, len(scopes))
    for k, some in enumerate(sets):
        used, count = np.array(some), int(rng.integers(2, 20))  # two rows do not fill three columns
        count += more + (5 if k % GROUPS else 0)
        F = rng.normal(size=(t, 1, count, len(used))) * size[used]
        if open_trial is not None and k == 1:
            F[open_trial, ..., -1] = 0.0
        node = np.array([tree.node[used].max()])
        place = int(tree.structure[node[0]]), tree.place[node], tree.columns(node, used[None])
        factors.add(BlockRows(*place, F, rng.normal(size=(t, 1, count, P + 1))))
    return factors


def list_variances(done: TreeElimination) -> np.ndarray:
    """Return the variance (t, U) of each unknown at a known machine."""
    trials = [done.take(np.array([i])).list_root().values for i in range(len(done.shift))]
    return np.array([(values**2).sum(axis=1) for values in trials])


def list_results(factors: NodeFactors) -> list[np.ndarray]:
    """Return what no choice of signs changes, unknowns in units of the lengths of their columns."""
    done, rest = eliminate_tree(factors)
    variance = list_variances(done) * done.length**2
    gram = np.swapaxes(rest, 1, 2) @ rest
    values = done.slope * done.length[..., None], done.shift * done.length
    return [gram, *values, variance, done.explained, done.rank, done.is_unobservable]


@pytest.mark.parametrize("more", [0, 30])
@pytest.mark.parametrize("open_trial", [None, 1])
def test_blocks_are_eliminated_as_in_numpy(open_trial, more):
    factors, results = draw_rows(3, open_trial, more), []
    for name in ("numpy", "native"):
        with use_engine(name):
            results.append(list_results(factors))
    for theirs, mine in zip(*results, strict=True):
        # rounding times the condition of the blocks
        assert_allclose(mine, theirs, rtol=1e-9, atol=1e-11 * np.abs(theirs).max())


@pytest.mark.parametrize("t", [1, 3])
def test_priors_of_one_row_each_are_read_where_their_memory_has_other_steps(t):
    """Along an axis of length one the step in memory is arbitrary: an array with new axes has 0."""
    rng, results = np.random.default_rng(4), []
    scopes, sizes = ["session"] * 6, rng.uniform(1.0, 9.0, 6)
    tree = build_tree(np.ones(6, dtype=bool), scopes, np.array([(i, i) for i in range(6)]))
    node, unknown = tree.node, np.arange(6)
    machine = rng.normal(size=(t, 6, 1, P + 1))
    view = np.broadcast_to(sizes[:, None, None], (t, 6, 1, 1))
    for rows in (view, view.tolist()):
        factors, columns = NodeFactors(tree, t, P), tree.column[unknown][:, None]
        places = int(tree.structure[node[0]]), tree.place[node], columns
        factors.add(BlockRows(*places, np.asarray(rows), machine))
        with use_engine("native"):
            results.append(list_results(factors))
    for mine, expected in zip(*results, strict=True):
        assert_array_equal(mine, expected)
    assert_allclose(results[0][3], np.ones((t, 6)))  # variances over lengths


@pytest.mark.parametrize("more", [0, 30])
@pytest.mark.parametrize("t", [1, 3])
def test_blocks_have_the_same_bits_for_every_instruction_set_and_alone(t, more):
    factors = draw_rows(t, more=more)
    shape = t, len(factors.tree.node), P
    functions = [e.eliminate_blocks for e in ENGINES.values() if e.eliminate_blocks is not None]
    assert len(functions) == len(ENGINES)
    given = factors.tree.structures, factors.list_rows()
    done = [eliminate(*given, shape, 1e-10) for eliminate in functions]
    assert done[0].is_regular.all()
    assert_same_bits([(*each[:5], *sum(each.solutions, ())) for each in done])
    with use_engine("native"):
        together, rest = eliminate_tree(draw_rows(3, 0, more))
        regular, its_rest = eliminate_tree(draw_rows(3, more=more))
    for trial in (1, 2):  # whatever the rows of the first trial leave open
        assert_array_equal(together.shift[trial], regular.shift[trial])
        assert_array_equal(rest[trial], its_rest[trial])


@pytest.mark.parametrize("wrong", ["place", "column", "rows", "path"])
def test_blocks_of_wrong_shape_are_refused(wrong):
    factors = draw_rows(1)
    rows, unknowns = factors.list_rows(), len(factors.tree.node)
    first = rows[0]
    changed = {
        "place": first._replace(places=first.places + 1000),
        "column": first._replace(columns=first.columns - 100),
        "rows": first._replace(machine=first.machine[..., :-1]),
        "path": first,
    }[wrong]
    shape = 1, unknowns - 5 * (wrong == "path"), P
    eliminate = next(iter(ENGINES.values())).eliminate_blocks
    assert eliminate is not None
    with pytest.raises(ValueError, match="the native engine expects"):
        eliminate(factors.tree.structures, [changed, *rows[1:]], shape, 1e-10)


@pytest.mark.parametrize("unknown", [(), ("frame",), ("targets", "frame"), ("targets",)])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, 3.0])
def test_points_are_located_as_in_numpy_with_the_same_bits(unknown, angle):
    rng = np.random.default_rng(1)
    stated = geometry.make_pose(geometry.exp_so3(rng.normal(size=3)), rng.normal(size=3))
    places = rng.normal(size=(2, 3))
    kind = Position(targets=("a", "b"), places=places, T_base_frame=stated, unknown=unknown)
    T = geometry.make_pose(
        geometry.exp_so3(rng.normal(size=(3, 11, 3))), rng.normal(size=(3, 11, 3))
    )
    values = np.tile(kind.nominal_values, (3, 1, 1))
    values[..., [p.name in ROTATION for p in kind.nuisance_parameters]] += angle / np.sqrt(3.0)
    found = []
    for name in ("numpy", *(f"native:{name}" for name in ENGINES)):
        with use_engine(name):
            found.append(kind.locate_targets(T, values))
    for theirs, mine in zip(*found[:2], strict=True):
        assert_allclose(mine, theirs, rtol=0, atol=1e-14)  # [m] rounding of a few products
        assert mine.shape == theirs.shape
    assert_same_bits(found[1:])


@pytest.mark.parametrize("columns", [(5, -1, 20), (6, 12, 17), (-1, 6, 11), (6, -1, 11)])
def test_points_of_wrong_shape_are_refused(columns):
    locate = next(iter(ENGINES.values())).locate_points
    assert locate is not None
    with pytest.raises(ValueError, match="the native engine expects"):
        locate(np.ones((1, 3, 4, 4)), np.eye(4), np.ones((1, 3, 6)), np.ones((1, 1, 2, 3)), columns)
    with pytest.raises(ValueError, match="the native engine expects"):
        locate(np.ones((1, 3, 4, 4)), np.eye(4), None, np.ones((1, 2, 2, 3)), (-1, -1, 6))
