# SPDX-License-Identifier: Apache-2.0
"""Nested elimination of setup parameters equals dense elimination, at a cost linear in the number
of groups.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.testing import assert_allclose

import loopcal.estimate.pose_rows as blocks_module
from loopcal.engine import BlockRows
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.information import observe_poses, observe_rows
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.problem import problem_of
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.surfaces import Plane
from loopcal.measure.simulation import simulate
from loopcal.numerics.decomposition import NUISANCE_TOLERANCE, NULL_COMPONENT
from loopcal.numerics.elimination import (
    EliminationTree,
    NodeFactors,
    UnknownRoot,
    build_tree,
    eliminate_tree,
    fill_rows,
)
from tests import zoo
from tests.estimate.problems import hexapod, hexapod_poses

PROBE = Plane(
    unknown=("surface", "targets"), targets=("probe",), places=np.array([[0.0, 0.0, 0.06]])
)


@dataclass(frozen=True, eq=False)
class Problem:
    """Rows [F | A | r] of U unknowns, (N, U), (N, p + 1), and the set of unknowns (N,) that each
    row may use.
    """

    free: np.ndarray
    scopes: list[str]
    sets: list[list[int]]
    F: np.ndarray
    right: np.ndarray
    of: np.ndarray

    @property
    def tree(self) -> EliminationTree:
        pairs = [(i, x) for i, some in enumerate(self.sets) for x in some]
        return build_tree(self.free, self.scopes, np.array(pairs, dtype=np.int64).reshape(-1, 2))


def random_problem(rng, unseen):
    """Draw up to three sessions of up to four groups that share unknowns of the machine.

    `unseen` directions over all of them are unobservable.
    """
    scopes, sets = ["machine"] * int(rng.integers(0, 4)), []
    shared = list(range(len(scopes)))
    for _ in range(int(rng.integers(1, 4))):
        day = list(range(len(scopes), len(scopes) + int(rng.integers(0, 4))))
        scopes += ["session"] * len(day)
        for _ in range(int(rng.integers(1, 5))):
            group = list(range(len(scopes), len(scopes) + int(rng.integers(0, 4))))
            scopes += ["group"] * len(group)
            sets.append(shared + day + group)
        sets.append(day)
    U, p = len(scopes), int(rng.integers(0, 5))
    free = rng.random(U) > 0.1
    of = np.repeat(np.arange(len(sets)), rng.integers(1, 12, len(sets)))
    F, hidden = np.zeros((len(of), U)), rng.normal(size=(U, unseen)) * (rng.random((U, 1)) > 0.3)
    for i, some in enumerate(sets):
        used = [x for x in some if free[x]]
        rows = rng.normal(size=(int((of == i).sum()), len(used)))
        if unseen and used:
            rows = rows - rows @ hidden[used] @ np.linalg.pinv(hidden[used])
        if used and rng.random() < 0.2:
            rows[:, int(rng.integers(len(used)))] = 0.0
        F[np.ix_(of == i, used)] = rows
    return Problem(
        free, scopes, sets, F * 10.0 ** rng.uniform(-3, 3, U), rng.normal(size=(len(of), p + 1)), of
    )


def fold_problem(problem, tree):
    """Fold the rows of a problem in two blocks, without the rows that use no unknown."""
    factors = NodeFactors(tree, 1, problem.right.shape[1] - 1)
    for half in (slice(0, None, 2), slice(1, None, 2)):
        F, right, of = problem.F[half], problem.right[half], problem.of[half]
        for i in np.unique(of):
            used = np.array([x for x in problem.sets[i] if problem.free[x]], dtype=np.int64)
            if len(used):
                node, some = tree.node[used].max(), of == i
                columns = tree.columns(np.array([node]), used[None])
                own, place = F[np.ix_(some, used)], tree.place[[node]]
                at = int(tree.structure[node]), place, columns
                factors.add(BlockRows(*at, own[None, None], right[some][None, None]))
    return factors


def eliminate_dense(problem, tree):
    """Return best values, variances, unobservable unknowns, rank and remaining rows, by one
    pseudo-inverse for each cluster.
    """
    U = len(problem.free)
    best, variance, unobservable, rank = (
        np.zeros((U, problem.right.shape[1])),
        np.zeros(U),
        np.zeros(U, dtype=bool),
        0,
    )
    left = []
    for c in range(int(tree.cluster.max()) + 1):
        inside = np.flatnonzero(tree.cluster == c)
        sets = [i for i, some in enumerate(problem.sets) if set(some) & set(inside.tolist())]
        rows = np.isin(problem.of, sets)
        F, right = problem.F[np.ix_(rows, inside)], problem.right[rows]
        norm = np.linalg.norm(F, axis=0)
        norm = np.where(norm > 0.0, norm, 1.0)
        u, s, vt = np.linalg.svd(F / norm)
        seen = int((s > NUISANCE_TOLERANCE * s[0]).sum())
        inverse = (vt[:seen].T / s[:seen]) @ u[:, :seen].T / norm[:, None]
        best[inside], variance[inside] = -inverse @ right, (inverse**2).sum(axis=1)
        unobservable[inside] = np.linalg.norm(vt[seen:], axis=0) > NULL_COMPONENT
        left.append(right - u[:, :seen] @ (u[:, :seen].T @ right))
        rank += seen
    return best, variance, unobservable, rank, np.concatenate(left)


@pytest.mark.slow
@pytest.mark.parametrize("unseen", [0, 1, 2])
def test_nested_elimination_equals_dense_elimination_with_unobservable_directions(unseen):
    deep = 0
    for seed in range(25):
        problem = random_problem(np.random.default_rng(seed), unseen)
        if not problem.free.any():
            continue
        tree = problem.tree
        best, variance, unobservable, rank, left = eliminate_dense(problem, tree)
        result, rest = eliminate_tree(fold_problem(problem, tree))
        assert result.rank[0] == rank, seed
        assert (result.is_unobservable[0] == unobservable).all(), seed
        # each unknown in the unit of its own column: 1e-9 is rounding times the worst condition of
        # 25 problems
        scale = np.maximum(np.linalg.norm(problem.F, axis=0), 1e-3)[:, None]
        values = np.column_stack([result.slope[0], result.shift[0]])
        assert_allclose(
            values * scale,
            best * scale,
            rtol=0,
            atol=1e-9 * max(1.0, np.abs(best * scale).max()),
            err_msg=f"{seed}",
        )
        assert_allclose(
            (result.list_root().values ** 2).sum(axis=1)[~unobservable],
            variance[~unobservable],
            rtol=1e-8,
            err_msg=f"{seed}",
        )
        squares = (problem.right**2).sum()
        assert_allclose(
            rest[0].T @ rest[0], left.T @ left, rtol=0, atol=1e-10 * squares, err_msg=f"{seed}"
        )
        deep += len({structure.parent for structure in tree.structures}) > 1
    assert deep > 12, "too few of the problems are nested at all"


def test_whitened_nuisance_columns_are_orthonormal():
    problem = random_problem(np.random.default_rng(8), 0)
    tree = problem.tree
    result, _ = eliminate_tree(fold_problem(problem, tree))
    assert len(tree.structures) > 2
    assert not result.is_unobservable.any()
    whitened = np.zeros_like(problem.F)
    for row, i in enumerate(problem.of):
        used = [x for x in problem.sets[i] if problem.free[x]]
        if used:
            path, root, _ = result.at_nodes(np.array([tree.node[used].max()]))
            whitened[row, path[0]] = problem.F[row, path[0]] @ root[0]
    free = problem.free
    assert_allclose(
        whitened[:, free].T @ whitened[:, free], np.eye(int(free.sum())), rtol=0, atol=1e-9
    )


def test_offset_absorbed_by_leaf_unknowns_is_unobservable():
    # ten groups with a height each and one offset that all of them share: only sums of the two are
    # measured
    rng, G = np.random.default_rng(0), 10
    F = np.zeros((5 * G, G + 1))
    F[np.arange(5 * G), np.repeat(np.arange(G), 5)] = F[:, G] = 1.0
    sets = [[i, G] for i in range(G)]
    problem = Problem(np.ones(G + 1, dtype=bool), ["group"] * G + ["machine"], sets, F, rng.normal(size=(5 * G, 3)),  # noqa: E501
                      np.repeat(np.arange(G), 5))  # fmt: skip
    result, rest = eliminate_tree(fold_problem(problem, problem.tree))
    assert result.rank[0] == G
    assert result.is_unobservable.all()
    best, _, _, _, left = eliminate_dense(problem, problem.tree)
    assert_allclose(result.shift[0], best[:, -1], rtol=0, atol=1e-12)
    assert_allclose(
        rest[0].T @ rest[0], left.T @ left, rtol=0, atol=1e-12 * np.abs(left.T @ left).max()
    )


def nest_groups(scopes, sets):
    return build_tree(
        np.ones(len(scopes), dtype=bool),
        scopes,
        np.array([(i, x) for i, some in enumerate(sets) for x in some]),
    )


def test_groups_are_nested_in_sessions_and_sessions_in_the_machine():
    scopes = ["machine"] + 2 * (["session"] * 2 + ["group"] * 3)
    sets = [
        [0, 1 + 5 * day, 2 + 5 * day, 3 + 5 * day + group] for day in range(2) for group in range(3)
    ]
    result = nest_groups(scopes, sets)
    assert [(len(structure), *structure.path.shape[1:]) for structure in result.structures] == [
        (1, 1),
        (2, 3),
        (6, 4),
    ]
    assert result.structures[2].path[4].tolist() == [9, 6, 7, 0]
    assert (result.cluster == 0).all()
    assert result.columns(result.node[[9]], np.array([[0, 6, 7, 9]])).tolist() == [[3, 1, 2, 0]]


def test_targets_are_nested_in_the_frame_that_measures_them():
    scopes = ["session"] * 6 + ["machine"] * 60
    result = nest_groups(scopes, [[*range(6), *range(6 + 3 * i, 9 + 3 * i)] for i in range(20)])
    assert [structure.path.shape for structure in result.structures] == [(1, 6), (20, 9)]


def test_unknowns_of_two_scopes_used_by_every_row_share_a_node():
    result = nest_groups(["session"] * 6 + ["machine"] * 3, [list(range(9))])
    assert [structure.path.tolist() for structure in result.structures] == [[list(range(9))]]


def test_elimination_tree_without_free_unknowns_is_empty():
    result = build_tree(np.zeros(3, dtype=bool), ["group"] * 3, np.array([[0, 0], [0, 1], [0, 2]]))
    assert result.structures == ()
    eliminated, rest = eliminate_tree(NodeFactors(result, 2, 4))
    assert eliminated.slope.shape == (2, 3, 4)
    assert not rest.any()


def simulate_probed_planes(groups, per_group=6, seed=1):
    """Simulate a hexapod that probes planes in turn with a probe of one offset."""
    n = groups * per_group
    group = np.array([f"plate{i % groups}" for i in range(n)])
    sensor = Sensor(PROBE, Gaussian(np.full(1, 5e-6)), group=group)
    truth = zoo.hexapod().with_values(zoo.hexapod_truth())
    return simulate(
        truth,
        hexapod_poses(n),
        Instrument((sensor,)),
        seed,
        nuisance_values={"probe.x": 2e-3, "probe.z": 0.0615},
    )


def linearize_nominal(data):
    """Return the factor at the nominal machine and stated setup values, and the estimates."""
    free = select_free_parameters(hexapod())
    problem = problem_of(free, data)
    z = free.deviation(hexapod().values[None])
    at = problem.linearize(z, problem.start(z, seek=False))
    return at.factor[0], at.nuisance


def test_cost_of_planes_that_share_a_probe_is_linear_in_their_number(monkeypatch):
    counted, add = {"rows": 0, "kept": 0, "widest": 0}, NodeFactors.add

    def counting(self, rows):
        add(self, rows)
        if self.parameters:
            filled, kept = fill_rows(rows, self.tree), sum(factor.size for factor in self.arrays())
            widest = max(counted["widest"], filled.shape[2])
            counted.update(rows=counted["rows"] + filled.size, kept=kept, widest=widest)

    monkeypatch.setattr(NodeFactors, "add", counting)
    result = []
    for groups in (5, 10, 20):
        counted.update(rows=0, kept=0, widest=0)
        _, own = linearize_nominal(simulate_probed_planes(groups))
        # three numbers of a plane, three of the probe, the machine, the residual; dense it were 3 *
        # groups + 46
        assert counted["widest"] == 3 + 3 + 42 + 1
        assert own is not None
        assert int(own.elimination.tree.width.max()) == 6
        root = own.elimination.list_root()
        assert root.values.shape == (3 * groups + 3, 6)  # no plane has a part in another one
        assert_allclose(
            root.fill(np.arange(3 * groups + 3)),
            own.elimination.move_unknowns(np.eye(3 * groups + 3)),
        )
        result.append((counted["rows"], counted["kept"]))
    one, two, four = np.array(result)
    assert (four - two == 2 * (two - one)).all()
    assert (four <= 4 * one).all()


@pytest.mark.parametrize("held", [False, True])
def test_planes_that_share_a_probe_give_the_joint_solution(held):
    data = simulate_probed_planes(6, per_group=15)
    free = select_free_parameters(hexapod())
    local = (
        data.nuisance_parameters.with_prior("plate[0-3].*", 1e-3).with_prior("probe.x", 1e-4)
        if held
        else data.nuisance_parameters
    )
    local = local.with_fixed("plate5.plane.u")
    problem = problem_of(free, data, local)
    z = free.deviation(hexapod().values[None])
    at = problem.linearize(z, problem.start(z, seek=False))
    assert at.nuisance is not None
    factor, values, table = at.factor[0], at.nuisance.values[0], local.table
    F = observe_rows(observe_poses(free, data.readings), data, local, values)[0]
    F[:, : len(local)][:, ~table.free] = 0.0
    priors = np.flatnonzero(table.free & ~np.isnan(table.tolerance))
    weight = np.zeros((len(priors), F.shape[1]))
    weight[np.arange(len(priors)), priors] = 1.0 / table.tolerance[priors]
    weight[:, -1] = (values - table.nominal)[priors] / table.tolerance[priors]
    F = np.concatenate([F, weight])
    used, right = F[:, : len(local)][:, table.free], F[:, len(local) :]
    q = np.linalg.svd(used / np.linalg.norm(used, axis=0), full_matrices=False)[0]
    left = right - q @ (q.T @ right)
    assert_allclose(
        factor.T @ factor, left.T @ left, rtol=0, atol=1e-10 * np.abs(left.T @ left).max()
    )
    assert at.equations[0] == len(F) - used.shape[1]
    assert len(at.nuisance.elimination.tree.structures) > 1


def test_groups_split_over_row_blocks_give_the_same_factor(monkeypatch):
    data = simulate_probed_planes(7)
    whole = linearize_nominal(data)[0]
    monkeypatch.setattr(blocks_module, "EXACT_BLOCK", 5)
    parts = linearize_nominal(data)[0]
    assert_allclose(
        parts.T @ parts, whole.T @ whole, rtol=0, atol=1e-10 * np.abs(whole.T @ whole).max()
    )


def test_fit_of_planes_that_share_a_probe_converges():
    data = simulate_probed_planes(12, per_group=10)
    fit = identify(hexapod(), data, LeastSquares())
    assert fit.converged
    assert fit.residual_test.p_value > 1e-3
    assert (
        fit.rank == 30
    )  # of 42, less the frames of the base and of the tool: the probe and the planes are free


def test_unknowns_that_a_root_lacks_are_known_also_where_it_has_none():
    """A fit without setup parameters is validated by measurements that have some."""
    for root in (UnknownRoot.make_empty(0), UnknownRoot.of(np.array([[0]]), np.array([[2.0]]))):
        taken = root.take(np.array([-1, *range(len(root.columns))]))
        assert not taken.values[0].any()
        assert (taken.columns[0] == -1).all()
        np.testing.assert_array_equal(taken.values[1:], root.values)
